"""The systems under comparison behind one small protocol: peers with the settings their authors recommend."""

from collections.abc import Callable
from typing import Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.sequence import LidarScan

Pose = NDArray[np.float64]


class System(Protocol):
    """One odometry run; a new instance starts at the identity."""

    name: ClassVar[str]
    instant: ClassVar[float]
    """Instant of a sweep to which the poses refer: 0 is the start, 1 the end."""
    instant_reason: ClassVar[str]
    """One sentence on the reason for that instant."""

    def warm_up(self, scans: list[LidarScan]) -> None:
        """Do the work that is needed once (compile, start threads); this instance is not used afterwards."""
        ...

    def prepare(self, scan: LidarScan) -> Any:
        """Return what the system's own reader would return; not timed, because it counts as decoding."""
        ...

    def register(self, prepared: Any) -> Pose:
        """Return T_world_lidar (4, 4) on the host; this call is timed."""
        ...


class KissIcp:
    """KISS-ICP with its defaults; it deskews where the scan has times."""

    name: ClassVar[str] = "kiss-icp"
    instant: ClassVar[float] = 1.0
    instant_reason: ClassVar[str] = "1.3 deskews every point to the time of the scan's last one"

    def __init__(self, threads: int) -> None:
        from kiss_icp.config.parser import load_config
        from kiss_icp.kiss_icp import KissICP

        config = load_config(None)
        config.registration.max_num_threads = threads
        self._odometry = KissICP(config)

    def warm_up(self, scans: list[LidarScan]) -> None:
        for scan in scans[:2]:
            self.register(self.prepare(scan))

    def prepare(self, scan: LidarScan) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        # times are normalised by their range, and a zero range aborts the process; without times no deskewing
        has_times = scan.duration > 0 and np.ptp(scan.time) > 0
        times = scan.time.astype(np.float64) if has_times else np.empty(0)
        return scan.points.astype(np.float64), times

    def register(self, prepared: tuple[NDArray[np.float64], NDArray[np.float64]]) -> Pose:
        self._odometry.register_frame(*prepared)
        pose: Pose = self._odometry.last_pose
        return pose


class KissIcpNoDeskew(KissIcp):
    """KISS-ICP without deskewing: at low speed its deskewing can carry jitter of one pose into the next."""

    name: ClassVar[str] = "kiss-icp-no-deskew"
    instant: ClassVar[float] = 0.5
    instant_reason: ClassVar[str] = (
        "no deskewing: a moving sensor's points fit best at the middle of the scan"
    )

    def prepare(self, scan: LidarScan) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return scan.points.astype(np.float64), np.empty(0)


class SmallGicp:
    """small_gicp's scan-to-model odometry with a Gaussian voxel map, with the settings of its own example."""

    name: ClassVar[str] = "small_gicp"
    instant: ClassVar[float] = 0.5
    instant_reason: ClassVar[str] = (
        "no deskewing: a moving sensor's points fit best at the middle of the scan"
    )

    def __init__(self, threads: int) -> None:
        import small_gicp

        self._library = small_gicp
        self._threads = threads
        self._map = small_gicp.GaussianVoxelMap(1.0)
        self._map.set_lru(horizon=100, clear_cycle=10)
        self._pose = np.eye(4)
        self._motion = np.eye(4)

    def warm_up(self, scans: list[LidarScan]) -> None:
        for scan in scans[:2]:
            self.register(self.prepare(scan))

    def prepare(self, scan: LidarScan) -> NDArray[np.float64]:
        return scan.points.astype(np.float64)

    def register(self, prepared: NDArray[np.float64]) -> Pose:
        cloud, _ = self._library.preprocess_points(prepared, 0.25, num_threads=self._threads)
        if self._map.size() == 0:
            self._map.insert(cloud)
            return self._pose
        guess = self._pose @ self._motion
        pose = self._library.align(self._map, cloud, guess, num_threads=self._threads).T_target_source
        self._motion = np.linalg.inv(self._pose) @ pose
        self._pose = pose
        self._map.insert(cloud, pose)
        return self._pose


class EvalioLoam:
    """The LOAM that evalio contains, with its defaults: it matches with three scans and does not deskew."""

    name: ClassVar[str] = "evalio-loam"
    instant: ClassVar[float] = 0.5
    instant_reason: ClassVar[str] = (
        "no deskewing: a moving sensor's points fit best at the middle of the scan"
    )
    _COLUMNS = 2048

    def __init__(self, threads: int) -> None:
        from evalio import pipelines
        from evalio.types import SE3, ImuParams

        self._pose: Pose = np.eye(4)
        self._pipeline = pipelines.LOAM()
        self._pipeline.set_params(self._pipeline.default_params())
        self._pipeline.set_imu_params(ImuParams())
        self._pipeline.set_imu_T_lidar(SE3.identity())
        self._beams = 0

    def warm_up(self, scans: list[LidarScan]) -> None:
        for scan in scans[:2]:
            self.register(self.prepare(scan))

    def prepare(self, scan: LidarScan) -> Any:
        from inertial_peers import measurement

        if not self._beams:
            from evalio.types import LidarParams

            self._beams = 16 * (int(scan.ring.max()) // 16 + 1)
            self._pipeline.set_lidar_params(
                LidarParams(num_rows=self._beams, num_columns=self._COLUMNS, min_range=1.0, max_range=200.0)
            )
            self._pipeline.initialize()
        azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0]).astype(np.float64)
        column = np.floor((0.5 - azimuth / (2 * np.pi)) * self._COLUMNS).astype(np.intp)
        kept = scan.ring >= 0
        return measurement(scan, column, kept, self._beams, self._COLUMNS)

    def register(self, prepared: Any) -> Pose:
        self._pipeline.add_lidar(prepared)
        for _, pose in self._pipeline.saved_estimates():
            self._pose = pose.to_mat()
        return self._pose


PEERS: dict[str, Callable[[int], System]] = {
    system.name: system for system in (KissIcp, KissIcpNoDeskew, SmallGicp, EvalioLoam)
}
"""Factories by name: ``factory(threads)``."""
