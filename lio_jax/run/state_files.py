"""The files of a run's trajectory and states, written from what was kept of every scan."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.files import atomic_path
from lio_jax.core.types import NavState
from lio_jax.data.sequence import ImuData
from lio_jax.data.trajectory import Trajectory, pose_matrices, tum_lines, write_kitti_poses, write_tum
from lio_jax.imu.imu_odometry import imu_rate_trajectory
from lio_jax.pose_graph.g2o import write_g2o
from lio_jax.run.folder import write_text
from lio_jax.run.keyframes import keyframe_indices, odometry_edges
from lio_jax.run.logs import TrajectoryLog
from lio_jax.run.sinks import RunResult, Sink
from lio_jax.settings.settings import Settings


class StateFiles(Sink):
    """Writes trajectory.tum, trajectory_kitti.txt, states.npz, keyframes.g2o and config.yaml at the end."""

    def __init__(self, out: Path, settings: Settings, log: TrajectoryLog) -> None:
        """Write into a folder later.

        Args:
            out: the run folder.
            settings: of the run.
            log: of the same run; it takes the results.
        """
        self._out, self._settings, self._log = out, settings, log

    def finish(self, run: RunResult) -> None:
        """Write the files, of the trajectory as the odometry has it."""
        out, log, output = self._out, self._log, self._settings.run.output
        odometry = log.trajectory()
        self.write_trajectory(odometry)
        log.write_npz(out / "states.npz")
        chosen = keyframe_indices(odometry.poses, output.keyframe_distance, output.keyframe_angle)
        poses = odometry.poses[chosen]
        write_g2o(out / "keyframes.g2o", poses, odometry_edges(poses, log.match_covariances()[chosen]))
        write_text(out / "config.yaml", self._settings.to_yaml())

    def write_trajectory(self, trajectory: Trajectory) -> None:
        """Write trajectory.tum and trajectory_kitti.txt, over earlier ones.

        Args:
            trajectory: T_world_imu of all scans.
        """
        with atomic_path(self._out / "trajectory.tum") as aside:
            write_tum(aside, trajectory)
        with atomic_path(self._out / "trajectory_kitti.txt") as aside:
            write_kitti_poses(aside, trajectory.poses @ self._log.column("extrinsic"))


class ImuRateFile(Sink):
    """Writes imu_rate.tum at the end."""

    def __init__(self, path: Path, imu: ImuData, log: TrajectoryLog) -> None:
        """Write a file later.

        Args:
            path: of the file.
            imu: the run's inertial samples, stamps ascending strictly.
            log: of the same run; it takes the results.
        """
        self._path, self._imu, self._log = path, imu, log

    def finish(self, run: RunResult) -> None:
        """Write the file; see :func:`write_imu_rate`."""
        write_imu_rate(self._path, self._log, self._imu)


_SCANS_AT_ONCE = 256
"""Bounds the memory that a long run needs."""


def write_imu_rate(path: Path, log: TrajectoryLog, imu: ImuData) -> None:
    """Write T_world_imu at each inertial sample after the first scan's end and up to the last one's.

    Poses follow the samples from the last corrected state on, so that they step where a scan corrects them; a
    sample at a scan's end has that scan's pose. Stamps are on the lidar's clock.

    Args:
        path: TUM file.
        log: of the run.
        imu: stamps ascending strictly.
    """
    # a stream whose time steps back has no samples in between
    stamps, poses = log.column("stamps_ns"), log.column("poses")
    kept = np.flatnonzero(stamps > np.concatenate([[-1], np.maximum.accumulate(stamps)[:-1]]))
    with atomic_path(path) as aside, aside.open("w") as file:
        for first in range(0, len(kept) - 1, _SCANS_AT_ONCE):
            chosen = kept[first : first + _SCANS_AT_ONCE + 1]
            states = [log.nav(index) for index in chosen]
            file.write(tum_lines(_between(stamps[chosen], poses[chosen], states, imu)))


def _between(
    stamps: NDArray[np.int64], poses: NDArray[np.float64], states: list[NavState], imu: ImuData
) -> Trajectory:
    times, rows = imu_rate_trajectory(stamps, states, imu.stamp_ns, imu.gyro, imu.accel)
    found = pose_matrices(rows[:, 4:], rows[:, [1, 2, 3, 0]]) if len(rows) else np.zeros((0, 4, 4))
    at = np.searchsorted(stamps, times).clip(max=len(stamps) - 1)
    found = np.where((stamps[at] == times)[:, None, None], poses[at], found)
    return Trajectory(times, found)
