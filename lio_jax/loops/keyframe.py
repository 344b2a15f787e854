"""Keyframes of the back end, and the local cloud that several of them make up."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A pose of the odometry and what was seen there."""

    index: int
    """Its place among the keyframes."""
    stamp_ns: int
    """Of the scan's end."""
    T_odom_imu: NDArray[np.float64]
    """(4, 4) by the smooth odometry, z up."""
    points: NDArray[np.float32]
    """(n, 3) m, in the IMU frame at the stamp, thinned."""
    covariance: NDArray[np.float64]
    """(6, 6) of the pose's error since the keyframe before, right perturbation, rotation (rad) first."""


def level_points(
    keyframes: Sequence[Keyframe],
    poses: NDArray[np.float64],
    centre: int,
    members: Iterable[int],
    reach: float,
) -> NDArray[np.float32]:
    """Return the points of some keyframes in the world's axes from one keyframe's position, (n, 3) m.

    Args:
        keyframes: all of them.
        poses: (k, 4, 4) T_world_imu.
        centre: the one that is the origin.
        members: those whose points are wanted.
        reach: points farther than this from the origin in plan are left out, m.
    """
    clouds = []
    for k in members:
        rotation = poses[k, :3, :3].astype(np.float32)
        offset = (poses[k, :3, 3] - poses[centre, :3, 3]).astype(np.float32)
        cloud = keyframes[k].points @ rotation.T + offset
        clouds.append(cloud[np.abs(cloud[:, :2]).max(axis=1, initial=0) < reach])
    return np.concatenate(clouds) if clouds else np.zeros((0, 3), np.float32)


def thinned(points: NDArray[np.float32], spacing: float) -> NDArray[np.float32]:
    """Return one point of each cube, in an order that is the same wherever the points are cut off.

    Args:
        points: (n, 3) m.
        spacing: edge of a cube, m.
    """
    cube = np.floor(points / spacing).astype(np.int64) & 0x1FFFFF
    key = (cube[:, 0] << 42) | (cube[:, 1] << 21) | cube[:, 2]
    # a multiplier scatters the keys: a prefix of the sorted ones is spread over all of space
    _, first = np.unique(key * np.int64(0x9E3779B97F4A7C15 - (1 << 64)), return_index=True)
    return points[first]


def padded(points: NDArray[np.float32], capacity: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return as many of the points as there is room for, zeros after them, and which rows are points."""
    rows = np.zeros((capacity, 3), np.float32)
    count = min(len(points), capacity)
    rows[:count] = points[:count]
    return rows, np.arange(capacity) < count
