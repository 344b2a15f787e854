"""What a run keeps of every scan: the navigation state and its covariance, small enough for any length."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.files import atomic_path
from lio_jax.data.trajectory import Trajectory
from lio_jax.run.track import Tracked, pose_matrix


class TrajectoryLog:
    """States in the order of the scans."""

    def __init__(self) -> None:
        self._rows: list[dict[str, NDArray]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, tracked: Tracked) -> None:
        """Keep one result."""
        nav = tracked.nav
        self._rows.append(
            {
                "stamps_ns": np.int64(tracked.stamp_ns),
                "poses": tracked.T_world_imu,
                "velocity": nav.velocity,
                "gyro_bias": nav.gyro_bias,
                "accel_bias": nav.accel_bias,
                "gravity": nav.gravity,
                "extrinsic": pose_matrix(nav.T_imu_lidar.wxyz_xyz),
                "covariance": _covariance(np.asarray(tracked.output.registration.information)),
            }
        )

    def column(self, name: str) -> NDArray:
        """Return one quantity of all scans, stacked."""
        return np.stack([row[name] for row in self._rows])

    def trajectory(self) -> Trajectory:
        """Return T_world_imu at the scans' ends."""
        return Trajectory(self.column("stamps_ns"), self.column("poses"))

    def lidar_poses(self) -> NDArray[np.float64]:
        """Return (n, 4, 4) T_world_lidar at the scans' ends."""
        return self.column("poses") @ self.column("extrinsic")

    def write_npz(self, path: Path) -> None:
        """Write every column; ``covariance`` is that of rotation and position (rad, m), NaN where unknown."""
        with atomic_path(path) as aside:
            np.savez_compressed(aside, **{name: self.column(name) for name in self._rows[0]})


def _covariance(information: NDArray[np.float64]) -> NDArray[np.float64]:
    """Invert a scan match's information; NaN where a direction is unobserved."""
    try:
        root = np.linalg.inv(np.linalg.cholesky(information))
    except np.linalg.LinAlgError:
        return np.full((6, 6), np.nan)
    return root.T @ root
