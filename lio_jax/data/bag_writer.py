"""Write any Sequence as a ROS bag that other systems can replay."""

import heapq
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from lio_jax.core.errors import LioJaxError
from lio_jax.data.bag_storage import BagFormat, new_bag
from lio_jax.data.cloud_layouts import Layout, layout_named
from lio_jax.data.enu import enu_to_geodetic
from lio_jax.data.ros_messages import Message, RosMessages
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, Sequence
from lio_jax.data.trajectory import Trajectory

TRUTH_TOPIC = "/ground_truth"
GPS_TOPIC = "/gps/fix"

_LATENCY_NS = 5_000_000
"""From a scan's end to its receipt."""


def write_bag(
    path: Path,
    sequence: Sequence,
    *,
    bag_format: BagFormat,
    layout: str,
    scans: Iterable[LidarScan] | None = None,
    overwrite: bool = False,
) -> int:
    """Write a bag and return its number of scans; scans are streamed, never held together.

    Clouds and inertial samples lie on the topics of the LiDAR's driver, fixes on /gps/fix, the truth
    (PoseStamped of T_world_imu) on /ground_truth and T_imu_lidar on /tf_static. A cloud is stamped with its
    scan's start and received after its end. Messages lie in the order of receipt; the same input gives the
    same bytes.

    Args:
        path: of the .bag, .db3 or .mcap file, or of the folder of a ROS 2 bag.
        sequence: what to write; fixes need a geodetic origin.
        bag_format: container.
        layout: make of the LiDAR: velodyne, ouster or livox.
        scans: in place of the sequence's own, such as the same under a progress bar.
        overwrite: replace a bag that is there.

    Raises:
        UsageError: ``path`` is taken or does not fit the format, or the layout is unknown.
        LioJaxError: there are no scans, or the disk takes no more.
    """
    driver = layout_named(layout)
    messages = RosMessages(ros2=bag_format != "ros1")
    count = 0
    with new_bag(Path(path), bag_format, messages.typestore, overwrite) as store:
        streamed = iter(sequence.scans() if scans is None else scans)
        first = next(streamed, None)
        if first is None:
            raise LioJaxError(f"{path}: there are no scans to write, the bag was not made.")
        imu, gps, truth = sequence.imu(), sequence.gps(), sequence.truth()
        begin_ns = min(
            [first.stamp_ns, *(int(x.stamp_ns[0]) for x in (imu, gps, truth) if x and len(x.stamp_ns))]
        )
        extrinsic = sequence.info.T_imu_lidar
        if extrinsic is not None:
            store(messages.static_transform(driver.imu_frame, driver.lidar_frame, begin_ns, extrinsic))
        merged = heapq.merge(
            _clouds(messages, driver, chain([first], streamed)),
            _imu(messages, driver, imu) if imu else (),
            _fixes(messages, gps) if gps else (),
            _poses(messages, truth) if truth else (),
            key=_received,
        )
        for message in merged:
            store(message)
            count += message.topic == driver.cloud_topic
    return count


def _received(message: Message) -> int:
    return message.received_ns


def _clouds(messages: RosMessages, driver: Layout, scans: Iterable[LidarScan]) -> Iterator[Message]:
    cloud = messages.custom_cloud if driver.custom else messages.cloud
    for scan in scans:
        received_ns = scan.end_ns + _LATENCY_NS
        yield cloud(driver.cloud_topic, driver.lidar_frame, scan.stamp_ns, driver.points(scan), received_ns)


def _imu(messages: RosMessages, driver: Layout, imu: ImuData) -> Iterator[Message]:
    for number, stamp_ns in enumerate(imu.stamp_ns.tolist()):
        orientation = None if imu.orientation is None else imu.orientation[number]
        values = imu.gyro[number], imu.accel[number], orientation
        yield messages.imu(driver.imu_topic, driver.imu_frame, stamp_ns, *values)


def _fixes(messages: RosMessages, gps: GpsData) -> Iterator[Message]:
    if not np.isfinite(gps.origin).all():
        raise LioJaxError(
            "the GPS positions have no geodetic origin, so they cannot be written as NavSatFix."
        )
    geodetic = enu_to_geodetic(gps.position, gps.origin)
    for stamp_ns, position, covariance in zip(gps.stamp_ns.tolist(), geodetic, gps.covariance, strict=True):
        yield messages.fix(GPS_TOPIC, stamp_ns, position, covariance)


def _poses(messages: RosMessages, truth: Trajectory) -> Iterator[Message]:
    for stamp_ns, pose in zip(truth.stamp_ns.tolist(), truth.poses, strict=True):
        yield messages.pose(TRUTH_TOPIC, "world", stamp_ns, pose)
