"""A short simulated drive, small enough for tests, ray cast once: its scans, truth, folders and bags."""

from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from lio_jax.data import write_native
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, SequenceInfo
from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.sequence import SimulatedSequence
from tests.data import bags

COUNT = 12
PERIOD_NS = 100_000_000
_STANDING, _MOVING = 0, 30
"""The drive stands at first; from the second number on it pulls away, 0.9 to 3.5 m/s: 2.5 m in 12 scans."""


@cache
def drive() -> SimulatedSequence:
    return SimulatedSequence(beams=16, columns=512, duration_s=4.2, seed=1)


@cache
def moving() -> tuple[LidarScan, ...]:
    return tuple(drive().scans(_MOVING, COUNT))


@cache
def standing() -> tuple[LidarScan, ...]:
    return tuple(drive().scans(_STANDING, COUNT))


@cache
def truth() -> Trajectory:
    return drive().truth()


class Replay:
    """A Sequence of given scans, in memory."""

    def __init__(self, scans: Iterable[LidarScan]) -> None:
        self._scans = list(scans)
        self.info = SequenceInfo("replay", "memory", "memory", len(self._scans), drive().info.T_imu_lidar)
        self.warnings_so_far: tuple[str, ...] = ()

    def scans(self, start: int = 0, count: int | None = None):
        yield from self._scans[start : None if count is None else start + count]

    def imu(self) -> ImuData | None:
        return None

    def gps(self) -> GpsData | None:
        return None

    def truth(self) -> Trajectory | None:
        return truth()


def without_points(scan: LidarScan) -> LidarScan:
    none = slice(0, 0)
    return replace(
        scan,
        points=scan.points[none],
        time=scan.time[none],
        ring=scan.ring[none],
        intensity=scan.intensity[none],
    )


def shifted(scan: LidarScan, by_ns: int) -> LidarScan:
    return replace(scan, stamp_ns=scan.stamp_ns + by_ns)


def write_folder(path: Path, scans: Iterable[LidarScan], with_truth: bool = True) -> Path:
    """Write a native folder."""
    known = truth() if with_truth else None
    write_native(path, scans, T_imu_lidar=drive().info.T_imu_lidar, truth=known, sensor="simulated")
    return path


def bag_messages(scans: Iterable[LidarScan], ros2: bool, topic: str = "/points") -> list[bags.Message]:
    """Return the scans as a Velodyne driver publishes them: stamped at their start, received at their end."""
    messages = []
    for scan in scans:
        seen = bags.Sweep(scan.points, scan.time, scan.ring, scan.intensity)
        cloud = bags.cloud_message(scan.stamp_ns, bags.fill(bags.VELODYNE, seen, scan.time), ros2)
        messages.append((topic, scan.end_ns + 3_000_000, cloud))
    return messages


def extrinsics() -> list[str]:
    """Return the assignments that give a bag, which holds no calibration, the drive's T_imu_lidar."""
    T = drive().info.T_imu_lidar
    assert T is not None
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
    return [
        f"params.extrinsics.rotation={quaternion}".replace(" ", ""),
        f"params.extrinsics.translation={T[:3, 3].tolist()}".replace(" ", ""),
    ]


def write_kitti(path: Path, scans: Iterable[LidarScan]) -> Path:
    """Write a KITTI odometry sequence folder without calibration or poses."""
    (path / "velodyne").mkdir(parents=True)
    stamps = []
    for number, scan in enumerate(scans):
        rows = np.column_stack([scan.points, scan.intensity]).astype(np.float32)
        rows.tofile(path / "velodyne" / f"{number:06d}.bin")
        stamps.append(f"{number * 0.1:e}")
    (path / "times.txt").write_text("\n".join(stamps) + "\n")
    return path


def write_kitti_raw(path: Path, scans: Iterable[LidarScan]) -> Path:
    """Write a KITTI raw drive folder without OXTS packets."""
    data = path / "velodyne_points" / "data"
    data.mkdir(parents=True)
    starts, ends = [], []
    for number, scan in enumerate(scans):
        rows = np.column_stack([scan.points, scan.intensity]).astype(np.float32)
        rows.tofile(data / f"{number:010d}.bin")
        starts.append(f"2011-09-26 13:02:{number * 0.1:012.9f}")
        ends.append(f"2011-09-26 13:02:{number * 0.1 + 0.1:012.9f}")
    (data.parent / "timestamps_start.txt").write_text("\n".join(starts) + "\n")
    (data.parent / "timestamps_end.txt").write_text("\n".join(ends) + "\n")
    (data.parent / "timestamps.txt").write_text("\n".join(starts) + "\n")
    return path
