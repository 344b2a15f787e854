"""What a run keeps of every scan: the navigation state and its covariance, small enough for any length."""

from pathlib import Path
from typing import Any

import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.files import atomic_path
from lio_jax.core.pose_covariance import carried, covariance_of
from lio_jax.core.types import NavState
from lio_jax.data.trajectory import Trajectory
from lio_jax.run.track import Tracked, pose_matrix


class TrajectoryLog:
    """States in the order of the scans."""

    def __init__(self) -> None:
        self._rows: list[dict[str, Any]] = []
        self._matches: list[NDArray[np.float64]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, tracked: Tracked) -> None:
        """Keep one result."""
        nav, state = tracked.nav, tracked.output.covariance
        match = _covariance(tracked) if self._rows else np.zeros((6, 6))
        self._matches.append(match)
        # copies: a view would keep the device's memory around it
        whole = {} if state is None else {"state_covariance": np.array(state)}
        pose = whole["state_covariance"][:6, :6] if whole else match
        self._rows.append(
            {
                "stamps_ns": np.int64(tracked.stamp_ns),
                "poses": tracked.T_world_imu,
                "velocity": nav.velocity,
                "biases": np.concatenate([nav.gyro_bias, nav.accel_bias]),
                "gravity": nav.gravity,
                "extrinsic": pose_matrix(nav.T_imu_lidar.wxyz_xyz),
                "time_offset": nav.time_offset,
                "covariance": pose,
                "nis": np.array(tracked.output.nis),
                "nis_dof": np.array(tracked.output.nis_dof),
                **whole,
            }
        )

    def nav(self, index: int) -> NavState:
        """Return one scan's navigation state, numpy leaves."""
        row = self._rows[index]
        biases: Any = row["biases"]
        return NavState(
            T_world_imu=_se3(row["poses"], row["velocity"].dtype),
            velocity=row["velocity"],
            gyro_bias=biases[:3],
            accel_bias=biases[3:],
            gravity=row["gravity"],
            T_imu_lidar=_se3(row["extrinsic"], row["velocity"].dtype),
            time_offset=row["time_offset"],
        )

    def column(self, name: str) -> NDArray:
        """Return one quantity of all scans, stacked."""
        return np.stack([row[name] for row in self._rows])

    def match_covariances(self) -> NDArray[np.float64]:
        """Return (n, 6, 6) covariances of the poses by the matches with the map alone."""
        return np.stack(self._matches)

    def trajectory(self) -> Trajectory:
        """Return T_world_imu at the scans' ends."""
        return Trajectory(self.column("stamps_ns"), self.column("poses"))

    def lidar_poses(self) -> NDArray[np.float64]:
        """Return (n, 4, 4) T_world_lidar at the scans' ends."""
        return self.column("poses") @ self.column("extrinsic")

    def write_npz(self, path: Path) -> None:
        """Write every column, one row a scan, at the scans' ends.

        - ``stamps_ns`` (n,) int64;
        - ``poses`` (n, 4, 4) T_world_imu;
        - ``velocity`` (n, 3) of the IMU origin in world, m/s;
        - ``biases`` (n, 6) gyroscope rad/s, then accelerometer m/s^2, IMU frame;
        - ``gravity`` (n, 3) in world, m/s^2;
        - ``extrinsic`` (n, 4, 4) T_imu_lidar;
        - ``time_offset`` (n,) s: a scan stamped t was taken at IMU time t + time_offset;
        - ``covariance`` (n, 6, 6) of the pose's right perturbation (rotation rad, position m): the filter's,
          which in the recipe default holds the drift of the map, too; in LiDAR odometry that of the match
          with the map alone, NaN where unknown;
        - ``state_covariance`` (n, 24, 24) of the whole error state, from filters only;
        - ``nis``, ``nis_dof`` (n,) normalised innovation squared and its degrees of freedom, 0 without.
        """
        with atomic_path(path) as aside:
            columns: dict[str, Any] = {name: self.column(name) for name in self._rows[0]}
            np.savez_compressed(aside, **columns)


def _se3(pose: NDArray[np.float64], dtype: np.dtype) -> jaxlie.SE3:
    wxyz = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    leaf: Any = np.concatenate([wxyz, pose[:3, 3]]).astype(dtype)
    return jaxlie.SE3(leaf)


def _covariance(tracked: Tracked) -> NDArray[np.float64]:
    """Carry the scan match's covariance from the lidar to the IMU at the scan's end."""
    registration = tracked.output.registration
    T_world_lidar = pose_matrix(np.asarray(registration.T_world_lidar.wxyz_xyz))
    T_imu_lidar = np.linalg.inv(tracked.T_world_imu) @ T_world_lidar
    return carried(covariance_of(np.asarray(registration.information)), T_imu_lidar)
