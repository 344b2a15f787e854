"""Which topics of a bag are read: the clouds, the inertial samples and the fixes."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from lio_jax.core.errors import LioJaxError
from lio_jax.data import navigation_messages, pointcloud2
from lio_jax.data.bag_files import Topic, listed
from lio_jax.data.config import DataConfig

_LIDAR_TYPES = dict.fromkeys((pointcloud2.TYPE, *sorted(pointcloud2.LIVOX_TYPES)), "a point cloud")
_IMU_TYPES = {navigation_messages.TYPE: "an Imu"}
_GPS_TYPES = {navigation_messages.FIX_TYPE: "a NavSatFix", navigation_messages.ODOMETRY_TYPE: "an Odometry"}
_GPS_NAMES = ("gps", "gnss", "rtk")


class TopicsToRead(NamedTuple):
    """The topics of a bag that are read."""

    lidar: Topic
    imu: Topic | None
    gps: Topic | None
    notes: list[str]
    """One sentence for each topic that could have been another one."""


def topics_to_read(path: Path, topics: tuple[Topic, ...], config: DataConfig) -> TopicsToRead:
    """Choose the topics that the settings name, else those with the most messages.

    Args:
        path: path of the bag, for messages.
        topics: all topics of the bag.
        config: names of topics.

    Raises:
        LioJaxError: a topic that is named is not in the bag or is of another type, or no clouds are there.
    """
    lidar, lidar_note = _chosen(path, topics, "lidar_topic", config.lidar_topic, _LIDAR_TYPES)
    if lidar is None:
        raise LioJaxError(
            f"{path}: no topic holds point clouds (PointCloud2 or Livox CustomMsg); "
            f"its topics are {listed(topics) or 'none'}."
        )
    if not lidar.count:
        raise LioJaxError(f"{path}: topic {lidar.name} holds no messages; record or choose another.")
    imu, imu_note = _chosen(path, topics, "imu_topic", config.imu_topic, _IMU_TYPES)
    fitting, hint = (topics, "") if config.gps_topic else _gps_topics(topics)
    gps, gps_note = _chosen(path, fitting, "gps_topic", config.gps_topic, _GPS_TYPES)
    notes = [("lidar", lidar_note), ("imu", imu_note), ("gps", hint), ("gps", gps_note)]
    return TopicsToRead(lidar, imu, gps, [f"{sensor}: {note}" for sensor, note in notes if note])


def _gps_topics(topics: tuple[Topic, ...]) -> tuple[tuple[Topic, ...], str]:
    """Return the topics that may hold fixes, and a note if there are none but an Odometry.

    An Odometry is GPS only if it is asked for or named so: most are the output of an estimator.
    """
    fixes = tuple(topic for topic in topics if topic.type == navigation_messages.FIX_TYPE)
    odometry = tuple(topic for topic in topics if topic.type == navigation_messages.ODOMETRY_TYPE)
    named = tuple(topic for topic in odometry if any(word in topic.name.lower() for word in _GPS_NAMES))
    if odometry and not (fixes or named):
        return (), (
            f"none; {odometry[0].name} (Odometry) is used as GPS with "
            f"--set config.data.gps_topic={odometry[0].name}"
        )
    return fixes or named, ""


def _chosen(
    path: Path, topics: tuple[Topic, ...], key: str, wanted: str, types: Mapping[str, str]
) -> tuple[Topic | None, str]:
    """Return the topic to read, and a note if other topics could have been read.

    Args:
        path: path of the bag, for messages.
        topics: all topics of the bag.
        key: key of the setting that names the topic, for example "lidar_topic".
        wanted: value of that setting; "" takes the topic with the most messages among those of the right
            type.
        types: name in messages of each accepted message type.

    Raises:
        LioJaxError: ``wanted`` is not in the bag, or is of another type.
    """
    fitting = [topic for topic in topics if topic.type in types]
    if wanted:
        named = [topic for topic in topics if topic.name.strip("/") == wanted.strip("/")]
        if not named:
            raise LioJaxError(
                f"{path}: config.data.{key}={wanted!r} is not in the bag; its topics are {listed(topics)}."
            )
        chosen = next((topic for topic in named if topic.type in types), None)
        if chosen is None:
            expected = " or ".join(dict.fromkeys(types.values()))
            raise LioJaxError(
                f"{path}: config.data.{key}={wanted!r} is {named[0].type}, not {expected}; "
                f"topics of that kind are {listed(fitting) or 'not in the bag'}."
            )
        return chosen, ""
    if not fitting:
        return None, ""
    chosen = max(fitting, key=lambda topic: topic.count)
    others = [topic for topic in fitting if topic is not chosen]
    if not others:
        return chosen, ""
    return chosen, (
        f"topic {chosen.name} was taken ({chosen.count} messages); there is also {listed(others)}: "
        f"choose with --set config.data.{key}={others[0].name}"
    )
