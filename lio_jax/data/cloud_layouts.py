"""The point layouts, topics and frames of real LiDAR drivers, as FAST-LIO2 and LIO-SAM expect them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.data.sequence import LidarScan

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
"""Tag of a point with one return and no doubt about it."""


@dataclass(frozen=True)
class Layout:
    """How one make of LiDAR appears in a bag."""

    points: Callable[[LidarScan], NDArray[Any]]
    """Packs a scan into the driver's structured array, (n,)."""
    cloud_topic: str
    imu_topic: str
    lidar_frame: str
    imu_frame: str
    custom: bool = False
    """True where the driver publishes Livox's CustomMsg instead of a PointCloud2."""


def layout_named(name: str) -> Layout:
    """Return a driver's layout.

    Raises:
        UsageError: the name is unknown.
    """
    if name not in LAYOUTS:
        raise UsageError(f"point layout '{name}' is unknown; choose one of: {', '.join(LAYOUTS)}.")
    return LAYOUTS[name]


def velodyne_points(scan: LidarScan) -> NDArray[Any]:
    """Pack as velodyne_pointcloud does: ring uint16, time float32 s, 22 bytes a point."""
    cloud = _with_positions(_VELODYNE, scan)
    cloud["intensity"], cloud["ring"], cloud["time"] = scan.intensity, scan.ring, scan.time
    return cloud


def ouster_points(scan: LidarScan) -> NDArray[Any]:
    """Pack as ouster_ros does: t uint32 ns, range in mm, 48 bytes a point.

    ``ring`` has 8 bits, as FAST-LIO2 and LIO-SAM declare it (PCL leaves a field of another type empty). The
    cloud is not organised: firings without a return are left out.
    """
    cloud = _with_positions(_OUSTER, scan)
    cloud["intensity"], cloud["t"], cloud["ring"] = scan.intensity, _nanoseconds(scan.time), scan.ring
    cloud["reflectivity"] = np.clip(np.round(scan.intensity), 0, 65535)
    cloud["range"] = np.round(np.linalg.norm(scan.points.astype(np.float64), axis=1) * 1000.0)
    return cloud


def livox_points(scan: LidarScan) -> NDArray[Any]:
    """Pack as the elements of Livox's CustomMsg: offset_time uint32 ns, reflectivity rounded to 8 bits."""
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
"""By make, as a simulated sensor names its own."""


def _with_positions(layout: np.dtype[Any], scan: LidarScan) -> NDArray[Any]:
    cloud = np.zeros(len(scan.points), layout)
    for axis, name in enumerate("xyz"):
        cloud[name] = scan.points[:, axis]
    return cloud


def _nanoseconds(time: NDArray[np.float32]) -> NDArray[np.float64]:
    return np.round(time.astype(np.float64) * 1e9)
