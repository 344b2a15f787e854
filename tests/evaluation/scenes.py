"""Trajectories with known errors."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.data.trajectory import Trajectory, pose_matrices

PERIOD_NS = 100_000_000
EPOCH_NS = 1_317_000_000_000_000_000


def stamped(poses: NDArray[np.float64], start_ns: int = EPOCH_NS) -> Trajectory:
    return Trajectory(start_ns + PERIOD_NS * np.arange(len(poses), dtype=np.int64), poses)


def winding_drive(count: int = 400, step_m: float = 1.0) -> NDArray[np.float64]:
    """Return poses that face along a winding, gently hilly road."""
    yaw = 0.8 * np.sin(np.arange(count) * 0.03)
    pitch = 0.05 * np.sin(np.arange(count) * 0.05)
    rotation = Rotation.from_euler("zy", np.stack([yaw, pitch], axis=1))
    steps = rotation.apply([step_m, 0.0, 0.0])
    positions = np.concatenate([np.zeros((1, 3)), np.cumsum(steps[:-1], axis=0)])
    return pose_matrices(positions, rotation.as_quat())


def straight_drive(count: int = 100, step_m: float = 1.0) -> NDArray[np.float64]:
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = step_m * np.arange(count)
    return poses


def transform(
    rotvec: tuple[float, float, float], translation: tuple[float, float, float]
) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rotvec).as_matrix()
    pose[:3, 3] = translation
    return pose
