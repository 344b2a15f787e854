"""Small made-up places, poses and keyframes."""

import numpy as np
from scipy.spatial.transform import Rotation

from lio_jax.loops.keyframe import Keyframe

SECOND = 1_000_000_000


def pose(x=0.0, y=0.0, z=0.0, yaw=0.0):
    """Return T_world_imu, (4, 4); m and rad."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    matrix[:3, 3] = [x, y, z]
    return matrix


def pillars(seed, count=40, reach=50.0, between=(3.0, 12.0)):
    """Return points on square pillars of different heights, (n, 3) m in world."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-reach, reach, (count, 2))
    tops = rng.uniform(*between, count)
    points = []
    for place, top in zip(places, tops, strict=True):
        height = np.arange(-1.5, top, 0.4)
        around = rng.uniform(-0.5, 0.5, (len(height), 2))
        points.append(np.column_stack([place + around, height]))
    return np.concatenate(points)


def seen_from(T_world_imu, points):
    """Return world points in the IMU frame, (n, 3) f32."""
    return ((points - T_world_imu[:3, 3]) @ T_world_imu[:3, :3]).astype(np.float32)


def keyframe(index, T_odom_imu, points=None, seconds=None):
    """Return a keyframe ``seconds`` after the epoch, ten for each index if not given."""
    points = np.zeros((1, 3), np.float32) if points is None else points
    stamp = round((10.0 * index if seconds is None else seconds) * SECOND)
    return Keyframe(index, stamp, T_odom_imu, points, np.eye(6))
