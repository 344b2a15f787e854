"""Keyframes of the back end, and local clouds from the points of several keyframes."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A pose of the odometry with the points of its scan."""

    index: int
    """Number of the keyframe, from 0."""
    stamp_ns: int
    """Time of the scan's end, ns."""
    T_odom_imu: NDArray[np.float64]
    """(4, 4) pose by the odometry without corrections, m, z up."""
    points: NDArray[np.float32]
    """(n, 3) thinned points, m, in the IMU frame at the stamp."""
    covariance: NDArray[np.float64]
    """(6, 6) covariance of the pose's error since the previous keyframe: right perturbation, rotation (rad)
    before translation (m)."""
    stated: NDArray[np.float64] | None = None
    """(6, 6) the part of the covariance that the estimator states, see
    :func:`lio_jax.loops.edge_noise.odometry_covariance`; None: the covariance does not depend on
    ``params.backend``."""
    position_error: float = 0.0
    """Largest error of the position since the previous keyframe beyond the odometry's drift, m: where a new
    piece of map begins after an outage."""
    heading_error: float = 0.0
    """Largest error of the heading since the previous keyframe beyond the odometry's drift, rad."""

    @property
    def begins_piece(self) -> bool:
        """Return whether a new piece of map begins with the keyframe."""
        return self.position_error > 0


def same_piece(keyframes: Sequence[Keyframe], centre: int, members: Iterable[int]) -> list[int]:
    """Return those of some keyframes between which and a given one no new piece of map begins.

    Args:
        keyframes: all keyframes.
        centre: index of the given keyframe.
        members: indices of the keyframes.
    """
    return [
        k
        for k in members
        if not any(between.begins_piece for between in keyframes[min(k, centre) + 1 : max(k, centre) + 1])
    ]


def level_points(
    keyframes: Sequence[Keyframe],
    poses: NDArray[np.float64],
    centre: int,
    members: Iterable[int],
    reach: float,
) -> NDArray[np.float32]:
    """Return the points of some keyframes, (n, 3) m, in world axes with the origin at one keyframe.

    Args:
        keyframes: all keyframes.
        poses: (k, 4, 4) T_world_imu, m.
        centre: index of the keyframe at the origin.
        members: indices of the keyframes whose points are returned.
        reach: largest |x| and |y| of a returned point, m.
    """
    clouds = []
    for k in members:
        rotation = poses[k, :3, :3].astype(np.float32)
        offset = (poses[k, :3, 3] - poses[centre, :3, 3]).astype(np.float32)
        cloud = keyframes[k].points @ rotation.T + offset
        clouds.append(cloud[np.abs(cloud[:, :2]).max(axis=1, initial=0) < reach])
    return np.concatenate(clouds) if clouds else np.zeros((0, 3), np.float32)


def thinned(points: NDArray[np.float32], spacing: float) -> NDArray[np.float32]:
    """Return one point of each cube, in pseudo-random order: any first part of them covers all of space.

    Args:
        points: (n, 3) m.
        spacing: edge of a cube, m.
    """
    cube = np.floor(points / spacing).astype(np.int64) & 0x1FFFFF
    key = (cube[:, 0] << 42) | (cube[:, 1] << 21) | cube[:, 2]
    # a multiplier scatters the keys, so that the first ones in sorted order are spread over all of space
    _, first = np.unique(key * np.int64(0x9E3779B97F4A7C15 - (1 << 64)), return_index=True)
    return points[first]


def padded(points: NDArray[np.float32], capacity: int) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return the first points, padded with zeros, and a mask of the real rows.

    Args:
        points: (n, 3) m.
        capacity: number of returned rows.
    """
    rows = np.zeros((capacity, 3), np.float32)
    count = min(len(points), capacity)
    rows[:count] = points[:count]
    return rows, np.arange(capacity) < count
