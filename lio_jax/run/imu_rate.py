"""imu_rate.tum: the pose at every inertial sample, from the corrected states at the scans' ends."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.files import atomic_path
from lio_jax.core.types import NavState
from lio_jax.data.sequence import ImuData
from lio_jax.data.trajectory import Trajectory, pose_matrices, tum_lines
from lio_jax.imu.imu_odometry import imu_rate_trajectory
from lio_jax.run.trajectory_log import TrajectoryLog

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
