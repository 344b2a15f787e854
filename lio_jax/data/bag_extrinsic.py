"""The pose of the lidar in the IMU frame, from the transforms that a bag holds."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lio_jax.data import static_transforms
from lio_jax.data.bag_files import Topic, read_frame, until_damage, why
from lio_jax.data.static_transforms import Transforms, constant, frame_name, gathered, transform_between

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_STATIC = (static_transforms.TOPIC, static_transforms.TYPE)
_REPEATS_LOOKED_AT = 200
"""Number of messages of /tf that are looked at in each third of a bag."""


class BagExtrinsic(NamedTuple):
    """The pose of the lidar, where a bag's transforms state it."""

    T_imu_lidar: NDArray[np.float64] | None
    """(4, 4); None where it is not stated."""
    note: str
    """A sentence on its source or on what is missing; "" without transforms."""


def bag_extrinsic(
    reader: "AnyReader",
    topics: tuple[Topic, ...],
    imu: Topic | None,
    lidar: Topic,
    damaged: Callable[[str, str], None],
) -> BagExtrinsic:
    """Return the lidar's pose in the IMU frame if the bag's static or constant transforms state it.

    Args:
        reader: of the open bag.
        topics: all topics of the bag.
        imu, lidar: topics whose frames are tied; None where there are no inertial samples.
        damaged: takes the name of a damaged topic and the reason.
    """
    static = [topic for topic in topics if (topic.name, topic.type) == _STATIC]
    repeated = [topic for topic in topics if topic.name == static_transforms.REPEATED_TOPIC]
    repeated = [topic for topic in repeated if topic.type in static_transforms.REPEATED_TYPES]
    if imu is None or not (static or repeated):
        return BagExtrinsic(None, "")
    frames = [_frame(reader, topic) for topic in (imu, lidar)]
    if None in frames or frames[0] == frames[1]:
        # drivers with default settings share one frame name
        return BagExtrinsic(None, "")
    imu_frame, lidar_frame = map(str, frames)

    known: Transforms = {}
    for topic in [*static, *repeated]:
        known = _transforms(reader, topic, damaged) | known
        T_imu_lidar = transform_between(known, imu_frame, lidar_frame)
        if T_imu_lidar is not None:
            stated = f"T_imu_lidar: {topic.name} states the pose of {lidar_frame} in {imu_frame}"
            return BagExtrinsic(T_imu_lidar, stated)
    looked_at = " and ".join(topic.name for topic in [*static, *repeated])
    do = "does" if len(static) + len(repeated) == 1 else "do"
    return BagExtrinsic(None, f"T_imu_lidar: {looked_at} {do} not tie {lidar_frame} to {imu_frame}")


def _transforms(reader: "AnyReader", topic: Topic, damaged: Callable[[str, str], None]) -> Transforms:
    """Return the transforms that a topic states for the whole recording."""

    def broken(reason: str) -> None:
        damaged(topic.name, reason)

    is_static = topic.name == static_transforms.TOPIC
    messages = _messages(reader, topic) if is_static else _spread(reader, topic)
    decoded = (reader.deserialize(raw, topic.type) for _, _, raw in until_damage(messages, broken))
    try:
        return gathered(decoded) if is_static else constant(decoded)
    # The generated decoders raise exceptions of many kinds on damaged bytes.
    except Exception as error:
        broken(why(error))
        return {}


def _messages(
    reader: "AnyReader", topic: Topic, start: int | None = None
) -> Iterator[tuple[Any, int, bytes]]:
    connections = [c for c in reader.connections if (c.topic, c.msgtype) == (topic.name, topic.type)]
    return reader.messages(connections, start=start)


def _spread(reader: "AnyReader", topic: Topic) -> Iterator[tuple[Any, int, bytes]]:
    """Yield messages from three parts of the bag: what stands still at first may move later."""
    for part in range(3):
        start = reader.start_time + part * (reader.end_time - reader.start_time) // 3
        yield from islice(_messages(reader, topic, start), _REPEATS_LOOKED_AT)


def _frame(reader: "AnyReader", topic: Topic) -> str | None:
    for _, _, raw in until_damage(_messages(reader, topic), lambda reason: None):
        with suppress(ValueError):
            return frame_name(read_frame(raw, reader.is2))
    return None
