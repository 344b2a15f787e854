"""Write small synthetic bags with the rosbags writers: point clouds of every layout, IMU, GPS."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START_NS = 1_700_000_000_123_456_789
PERIOD_NS = 100_000_000
RINGS, COLUMNS = 16, 90

CLOUD = "sensor_msgs/msg/PointCloud2"
IMU = "sensor_msgs/msg/Imu"
FIX = "sensor_msgs/msg/NavSatFix"
ODOMETRY = "nav_msgs/msg/Odometry"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
LIVOX = tuple(f"{package}/msg/CustomMsg" for package in ("livox_ros_driver", "livox_ros_driver2"))

_LIVOX_POINT = """uint32 offset_time
float32 x
float32 y
float32 z
uint8 reflectivity
uint8 tag
uint8 line
"""
_LIVOX_MESSAGE = """std_msgs/Header header
uint64 timebase
uint32 point_num
uint8 lidar_id
uint8[3] rsvd
CustomPoint[] points
"""

VELODYNE = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)
OUSTER = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "u1", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
        "itemsize": 48,
    }
)
HESAI = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "timestamp", "ring"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<f8", "<u2"],
        "offsets": [0, 4, 8, 16, 24, 32],
        "itemsize": 48,
    }
)
ROBOSENSE = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "timestamp"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f8"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 26,
    }
)
LIVOX_CLOUD = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "tag", "line", "timestamp"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "u1", "u1", "<f8"],
        "offsets": [0, 4, 8, 12, 16, 17, 18],
        "itemsize": 26,
    }
)
LIVOX_OFFSET_CLOUD = np.dtype(
    {
        "names": ["x", "y", "z", "reflectivity", "tag", "line", "offset_time"],
        "formats": ["<f4", "<f4", "<f4", "u1", "u1", "u1", "<u4"],
        "offsets": [0, 4, 8, 12, 13, 14, 15],
        "itemsize": 19,
    }
)
PLAIN = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")])

_DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


@dataclass(frozen=True)
class Sweep:
    """Scan of a 16-beam sensor in a round room, ring after ring; it turns clockwise once in 0.1 s."""

    points: np.ndarray
    time: np.ndarray
    """(n,) s from the sweep's start, float64."""
    ring: np.ndarray
    intensity: np.ndarray


def sweep(rings: int = RINGS, columns: int = COLUMNS) -> Sweep:
    column, ring = (grid.ravel() for grid in np.meshgrid(np.arange(columns), np.arange(rings)))
    azimuth = -2 * np.pi * column / columns
    elevation = np.radians(-15.0 + 30.0 * ring / (rings - 1))
    radius = 10.0 + ring
    points = radius[:, None] * np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1
    )
    return Sweep(points.astype(np.float32), 0.1 * column / columns, ring, (column % 200).astype(np.float32))


def fill(layout: np.dtype, seen: Sweep, time: np.ndarray | None = None) -> np.ndarray:
    """Put a sweep into a structured array; ``time`` in the layout's own unit."""
    cloud = np.zeros(len(seen.points), layout)
    for axis, name in enumerate("xyz"):
        cloud[name] = seen.points[:, axis]
    for name in layout.names or ():
        if name in ("intensity", "reflectivity"):
            cloud[name] = seen.intensity
        elif name in ("ring", "line"):
            cloud[name] = seen.ring
        elif name in ("t", "time", "timestamp", "offset_time") and time is not None:
            cloud[name] = time
    return cloud


@cache
def store(ros2: bool) -> Any:
    types = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    for name in LIVOX:
        types.register(get_types_from_msg(_LIVOX_POINT, name.replace("CustomMsg", "CustomPoint")))
        types.register(get_types_from_msg(_LIVOX_MESSAGE, name))
    if TRANSFORMS not in types.types:
        types.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", TRANSFORMS))
    return types


def header(stamp_ns: int, ros2: bool, frame: str = "lidar") -> Any:
    types = store(ros2).types
    stamp = types["builtin_interfaces/msg/Time"](stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)
    make = types["std_msgs/msg/Header"]
    return make(stamp, frame) if ros2 else make(7, stamp, frame)


def cloud_message(
    stamp_ns: int,
    cloud: np.ndarray,
    ros2: bool = True,
    *,
    height: int = 1,
    row_padding: int = 0,
    big_endian: bool = False,
) -> Any:
    """Pack a structured array into a PointCloud2, rows followed by ``row_padding`` bytes of 0xff."""
    types = store(ros2).types
    make_field = types["sensor_msgs/msg/PointField"]
    if big_endian:
        swapped = {
            "names": list(cloud.dtype.names),
            "formats": [cloud.dtype[name].newbyteorder(">") for name in cloud.dtype.names],
            "offsets": [cloud.dtype.fields[name][1] for name in cloud.dtype.names],
            "itemsize": cloud.dtype.itemsize,
        }
        converted = np.zeros(cloud.shape, np.dtype(swapped))
        for name in cloud.dtype.names:
            converted[name] = cloud[name]
        cloud = converted
    fields = [
        make_field(name, cloud.dtype.fields[name][1], _DATATYPES[cloud.dtype[name].str[1:]], 1)
        for name in cloud.dtype.names
    ]
    width, step = cloud.size // height, cloud.dtype.itemsize
    rows = np.frombuffer(cloud.tobytes(), np.uint8).reshape(height, width * step)
    data = np.pad(rows, ((0, 0), (0, row_padding)), constant_values=255).ravel()
    return types[CLOUD](
        header(stamp_ns, ros2),
        height,
        width,
        fields,
        big_endian,
        step,
        width * step + row_padding,
        data,
        False,
    )


def custom_message(stamp_ns: int, cloud: np.ndarray, ros2: bool, name: str = LIVOX[0]) -> Any:
    """Pack a structured array of the LIVOX_OFFSET_CLOUD layout into a CustomMsg."""
    types = store(ros2).types
    make_point = types[name.replace("CustomMsg", "CustomPoint")]
    points = [
        make_point(
            *(int(row["offset_time"]), float(row["x"]), float(row["y"]), float(row["z"])),
            *(int(row["reflectivity"]), int(row["tag"]), int(row["line"])),
        )
        for row in cloud
    ]
    return types[name](header(stamp_ns, ros2), stamp_ns, len(points), 1, np.zeros(3, np.uint8), points)


def imu_message(
    stamp_ns: int,
    ros2: bool = True,
    gyro: tuple[float, float, float] = (0.01, -0.02, 0.03),
    accel: tuple[float, float, float] = (0.1, 0.2, 9.8),
    orientation: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0),
    orientation_covariance: float = -1.0,
) -> Any:
    types = store(ros2).types
    vector, covariance = types["geometry_msgs/msg/Vector3"], np.zeros(9)
    stated = covariance.copy()
    stated[0] = orientation_covariance
    return types[IMU](
        header(stamp_ns, ros2, "imu_link"),
        types["geometry_msgs/msg/Quaternion"](*orientation),
        stated,
        vector(*gyro),
        covariance,
        vector(*accel),
        covariance,
    )


def fix_message(
    stamp_ns: int,
    latitude: float,
    longitude: float,
    altitude: float = 100.0,
    *,
    ros2: bool = True,
    status: int = 0,
    variance: float = 4.0,
) -> Any:
    types = store(ros2).types
    return types[FIX](
        header(stamp_ns, ros2, "gps"),
        types["sensor_msgs/msg/NavSatStatus"](status, 1),
        latitude,
        longitude,
        altitude,
        np.diag([variance] * 3).ravel(),
        2 if variance else 0,
    )


def odometry_message(stamp_ns: int, position: tuple[float, float, float], ros2: bool = True) -> Any:
    types = store(ros2).types
    kind = {
        name: types[f"geometry_msgs/msg/{name}"]
        for name in ("Point", "Quaternion", "Pose", "Vector3", "Twist")
    }
    covariance = np.diag([0.5, 0.5, 2.0, 9.0, 9.0, 9.0]).ravel()
    pose = types["geometry_msgs/msg/PoseWithCovariance"](
        kind["Pose"](kind["Point"](*position), kind["Quaternion"](0.0, 0.0, 0.0, 1.0)), covariance
    )
    twist = types["geometry_msgs/msg/TwistWithCovariance"](
        kind["Twist"](kind["Vector3"](0.0, 0.0, 0.0), kind["Vector3"](0.0, 0.0, 0.0)), covariance
    )
    return types[ODOMETRY](header(stamp_ns, ros2, "map"), "base", pose, twist)


def transform_message(
    stamp_ns: int, transforms: dict[tuple[str, str], tuple[tuple[float, ...], tuple[float, ...]]], ros2: bool
) -> Any:
    """Return a TFMessage of (parent, child) -> (translation, quaternion xyzw)."""
    types = store(ros2).types
    kind = {name: types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion", "Transform")}
    return types[TRANSFORMS](
        [
            types["geometry_msgs/msg/TransformStamped"](
                header(stamp_ns, ros2, parent),
                child,
                kind["Transform"](kind["Vector3"](*position), kind["Quaternion"](*quaternion)),
            )
            for (parent, child), (position, quaternion) in transforms.items()
        ]
    )


Message = tuple[str, int, Any]
"""Topic, receipt ns, message."""


def is_ros2(path: Path) -> bool:
    return path.suffix != ".bag"


def write_bag(path: Path, messages: Iterable[Message], *, compressed: bool = False) -> Path:
    """Write ``*.bag`` (ROS 1), ``*.mcap`` as a ROS 2 folder of that storage, or a ROS 2 sqlite3 folder.

    Returns:
        the .bag file or the folder.
    """
    ros2 = is_ros2(path)
    types = store(ros2)
    if ros2:
        plugin = StoragePlugin.MCAP if path.suffix == ".mcap" else StoragePlugin.SQLITE3
        writer: Any = Writer2(path.with_suffix(""), version=9, storage_plugin=plugin)
        if compressed:
            mode = CompressionMode.STORAGE if plugin is StoragePlugin.MCAP else CompressionMode.MESSAGE
            writer.set_compression(mode, CompressionFormat.ZSTD)
    else:
        writer = Writer1(path)
        if compressed:
            writer.set_compression(Writer1.CompressionFormat.LZ4)
    with writer:
        connections: dict[tuple[str, str], Any] = {}
        for topic, received_ns, message in messages:
            kind = message.__msgtype__
            if (topic, kind) not in connections:
                connections[topic, kind] = writer.add_connection(topic, kind, typestore=types)
            raw = types.serialize_cdr(message, kind) if ros2 else types.serialize_ros1(message, kind)
            writer.write(connections[topic, kind], received_ns, raw)
    return path.with_suffix("") if ros2 else path


def velodyne_messages(
    count: int = 3, ros2: bool = True, *, topic: str = "/points", first: int = 0
) -> list[Message]:
    """Return sweeps as a Velodyne driver publishes them, each received when it is over."""
    seen = sweep()
    return [
        (
            topic,
            START_NS + (number + 1) * PERIOD_NS + 5_000_000,
            cloud_message(START_NS + number * PERIOD_NS, fill(VELODYNE, seen, seen.time), ros2),
        )
        for number in range(first, first + count)
    ]
