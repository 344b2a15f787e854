"""Write ROS 1 and ROS 2 bags."""

import heapq
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data import static_transforms
from lio_jax.data.enu import enu_to_geodetic
from lio_jax.data.ros_messages import Message, RosMessages
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.data.whole_output import written_whole

if TYPE_CHECKING:
    from rosbags.interfaces import Qos

BagFormat = Literal["ros1", "ros2-sqlite3", "ros2-mcap"]

FORMAT_OF_ENDING: dict[str, BagFormat] = {".bag": "ros1", ".db3": "ros2-sqlite3", ".mcap": "ros2-mcap"}
"""Bag format that belongs to each ending of a bag's name."""

_ENDINGS: dict[str, tuple[str, ...]] = {
    "ros1": (".bag",),
    "ros2-sqlite3": (".db3", ""),
    "ros2-mcap": (".mcap", ""),
}
"""Endings of the paths that each format may be written to; "" stands for a folder."""

_RECORDING = "recording"
"""Name of the storage file in a ROS 2 bag; it is constant, so that the bytes do not depend on the path."""

_ROS2_VERSION: Literal[8] = 8
"""Newest metadata version that ROS 2 Humble and its successors can read."""


def check_ending(path: Path, bag_format: BagFormat) -> None:
    """Refuse a path whose ending makes readers expect another format.

    Raises:
        UsageError: the ending belongs to another format, or ROS 1 is asked for without ".bag".
    """
    endings = _ENDINGS[bag_format]
    known = {ending for of_format in _ENDINGS.values() for ending in of_format if ending}
    ending = path.suffix if path.suffix in known else ""
    if ending not in endings:
        wanted = " or ".join(ending or "a folder without an ending" for ending in endings)
        raise UsageError(f"{path}: a {bag_format} recording is {wanted}; choose another path or format.")
    if bag_format == "ros2-sqlite3" and set(str(path.resolve())) & set("?#%"):
        raise UsageError(f"{path}: sqlite3 cannot write to a path with '?', '#' or '%'; choose another.")


@contextmanager
def new_bag(
    path: Path, bag_format: BagFormat, typestore: Any, overwrite: bool
) -> Iterator[Callable[[Message], None]]:
    """Yield a function that stores a message; the complete bag appears when the block ends without error.

    Args:
        path: path of the file, or of the folder of a ROS 2 bag with its metadata.yaml.
        bag_format: format of the bag.
        typestore: rosbags' definitions of the messages.
        overwrite: whether an existing bag is replaced.

    Raises:
        UsageError: ``path`` is taken or does not fit the format.
        LioJaxError: the disk is full or cannot be written.
    """
    check_ending(path, bag_format)
    is_file = bool(path.suffix) and path.suffix in _ENDINGS[bag_format]
    with written_whole(path, overwrite, "" if is_file else "metadata.yaml") as made:
        if bag_format == "ros1":
            with _ros1_writer(made, typestore) as store:
                yield store
            return
        folder = made.parent / _RECORDING
        with _ros2_writer(folder, bag_format, typestore) as store:
            yield store
        # the file describes itself: it can be played without the folder's metadata.yaml
        os.replace(folder / f"{_RECORDING}{path.suffix}" if is_file else folder, made)


@contextmanager
def _ros1_writer(path: Path, typestore: Any) -> Iterator[Callable[[Message], None]]:
    from rosbags.rosbag1 import Writer

    with Writer(path) as writer:

        def connect(topic: str, kind: str) -> Any:
            latching = 1 if kind == static_transforms.TYPE else None
            return writer.add_connection(topic, kind, typestore=typestore, latching=latching)

        yield _storing(writer, connect)


@contextmanager
def _ros2_writer(folder: Path, bag_format: BagFormat, typestore: Any) -> Iterator[Callable[[Message], None]]:
    from rosbags.rosbag2 import StoragePlugin, Writer

    plugin = StoragePlugin.MCAP if bag_format == "ros2-mcap" else StoragePlugin.SQLITE3
    with Writer(folder, version=_ROS2_VERSION, storage_plugin=plugin) as writer:

        def connect(topic: str, kind: str) -> Any:
            offered = [_latched()] if kind == static_transforms.TYPE else []
            return writer.add_connection(topic, kind, typestore=typestore, offered_qos_profiles=offered)

        yield _storing(writer, connect)


def _storing(writer: Any, connect: Callable[[str, str], Any]) -> Callable[[Message], None]:
    connections: dict[tuple[str, str], Any] = {}

    def store(message: Message) -> None:
        key = (message.topic, message.type)
        if key not in connections:
            connections[key] = connect(*key)
        writer.write(connections[key], message.received_ns, message.raw)

    return store


def _latched() -> "Qos":
    """Return the quality of service of /tf_static: a later subscriber still gets the message."""
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    unlimited = QosTime(0, 0)
    return Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        unlimited,
        unlimited,
        QosLiveliness.AUTOMATIC,
        unlimited,
        False,
    )


_VELODYNE = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
_OUSTER = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "u1", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
        "itemsize": 48,
    }
)
_LIVOX = np.dtype(
    [
        ("offset_time", "<u4"),
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("reflectivity", "u1"),
        ("tag", "u1"),
        ("line", "u1"),
    ]
)

_LIVOX_SINGLE_RETURN = 0x10
"""Tag of a point with one certain return."""


@dataclass(frozen=True)
class Layout:
    """How the messages of one make of LiDAR appear in a bag."""

    points: Callable[[LidarScan], NDArray[Any]]
    """Function that packs a scan into the driver's structured array, (n,)."""
    cloud_topic: str
    """Topic of the point clouds."""
    imu_topic: str
    """Topic of the inertial samples."""
    lidar_frame: str
    """Name of the lidar's frame."""
    imu_frame: str
    """Name of the IMU's frame."""
    custom: bool = False
    """True where the driver publishes Livox's CustomMsg instead of a PointCloud2."""


def layout_named(name: str) -> Layout:
    """Return the layout of a driver.

    Raises:
        UsageError: the name is unknown.
    """
    if name not in LAYOUTS:
        raise UsageError(f"point layout '{name}' is unknown; choose one of: {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]


def velodyne_points(scan: LidarScan) -> NDArray[Any]:
    """Pack a scan as velodyne_pointcloud does: ring uint16, time float32 s, 22 bytes a point."""
    cloud = _with_positions(_VELODYNE, scan)
    cloud["intensity"], cloud["ring"], cloud["time"] = scan.intensity, scan.ring, scan.time
    return cloud


def ouster_points(scan: LidarScan) -> NDArray[Any]:
    """Pack a scan as ouster_ros does: t uint32 ns, range in mm, 48 bytes a point.

    ``ring`` has 8 bits, as FAST-LIO2 and LIO-SAM declare it (PCL leaves a field of another type empty). The
    cloud is not organised: it holds no firings without a return.
    """
    cloud = _with_positions(_OUSTER, scan)
    cloud["intensity"], cloud["t"], cloud["ring"] = scan.intensity, _nanoseconds(scan.time), scan.ring
    cloud["reflectivity"] = np.clip(np.round(scan.intensity), 0, 65535)
    cloud["range"] = np.round(np.linalg.norm(scan.points.astype(np.float64), axis=1) * 1000.0)
    return cloud


def livox_points(scan: LidarScan) -> NDArray[Any]:
    """Pack a scan as Livox's CustomMsg does: offset_time uint32 ns, reflectivity rounded to 8 bits."""
    cloud = _with_positions(_LIVOX, scan)
    cloud["offset_time"], cloud["line"], cloud["tag"] = (
        _nanoseconds(scan.time),
        scan.ring,
        _LIVOX_SINGLE_RETURN,
    )
    cloud["reflectivity"] = np.clip(np.round(scan.intensity), 0, 255)
    return cloud


LAYOUTS = {
    "velodyne": Layout(velodyne_points, "/velodyne_points", "/imu/data", "velodyne", "imu_link"),
    "ouster": Layout(ouster_points, "/os_cloud_node/points", "/os_cloud_node/imu", "os_sensor", "os_imu"),
    "livox": Layout(livox_points, "/livox/lidar", "/livox/imu", "livox_frame", "livox_imu", custom=True),
}
"""Layouts by the name of the make, as simulated sensors state it."""


def _with_positions(layout: np.dtype[Any], scan: LidarScan) -> NDArray[Any]:
    cloud = np.zeros(len(scan.points), layout)
    for axis, name in enumerate("xyz"):
        cloud[name] = scan.points[:, axis]
    return cloud


def _nanoseconds(time: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.round(time.astype(np.float64) * 1e9)


TRUTH_TOPIC = "/ground_truth"
GPS_TOPIC = "/gps/fix"

_LATENCY_NS = 5_000_000
"""Time from a scan's end to its receipt, ns."""


def write_bag(
    path: Path,
    sequence: Sequence,
    *,
    bag_format: BagFormat,
    layout: str,
    scans: Iterable[LidarScan] | None = None,
    overwrite: bool = False,
) -> int:
    """Write a bag and return its number of scans (scans are streamed).

    Clouds and inertial samples go to the topics of the LiDAR's driver, fixes to /gps/fix, the truth
    (PoseStamped of T_world_imu) to /ground_truth, and T_imu_lidar to /tf_static. A cloud is stamped with its
    scan's start and received after its end. Messages are in order of receipt. The same input gives the
    same bytes.

    Args:
        path: path of the .bag, .db3 or .mcap file, or of the folder of a ROS 2 bag.
        sequence: the recording to write; fixes need a geodetic origin.
        bag_format: format of the bag.
        layout: make of the LiDAR: velodyne, ouster or livox.
        scans: scans to write in place of the sequence's own, for example the same scans with a progress bar.
        overwrite: whether an existing bag is replaced.

    Raises:
        UsageError: ``path`` is taken or does not fit the format, or the layout is unknown.
        LioJaxError: there are no scans, or the disk is full or cannot be written.
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
