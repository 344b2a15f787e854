"""A vehicle with an antenna, as its odometry and its receiver saw it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

SPEED = 10.0
LEVER = np.array([0.6, -0.4, 1.5])
YAW, SHIFT = 2.1, np.array([40.0, -25.0, 7.0])
"""Yaw (rad) and position (m) of the odometry's world in the receiver's frame."""


@dataclass
class Drive:
    """A keyframe every metre, five fixes a second."""

    stamp_ns: np.ndarray
    T_odom_imu: np.ndarray
    fix_ns: np.ndarray
    fix: np.ndarray
    covariance: np.ndarray

    def antennas(self):
        return self.T_odom_imu[:, :3, :3] @ LEVER + self.T_odom_imu[:, :3, 3]

    def copy(self):
        return Drive(*(getattr(self, name).copy() for name in self.__dataclass_fields__))


def poses_at(seconds, turning=0.05):
    """Return (n, 4, 4) poses of a drive along a circle, its roll swaying."""
    heading = turning * seconds
    radius = SPEED / turning
    T = np.tile(np.eye(4), (len(seconds), 1, 1))
    roll = 0.1 * np.sin(seconds)
    T[:, :3, :3] = Rotation.from_euler("ZYX", np.stack([heading, 0 * heading, roll], -1)).as_matrix()
    T[:, 0, 3] = radius * np.sin(heading)
    T[:, 1, 3] = radius * (1 - np.cos(heading))
    T[:, 2, 3] = 0.02 * SPEED * seconds
    return T


def to_enu(points):
    return points @ Rotation.from_euler("z", YAW).as_matrix().T + SHIFT


def drive(length=200, sigma=0.0, rate=5.0, seed=0):
    """Return a drive of so many metres whose fixes have errors of this size."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(length) / SPEED
    at_fixes = np.arange(0.03, seconds[-1] + 1.0, 1 / rate)
    poses = poses_at(at_fixes)
    antennas = poses[:, :3, :3] @ LEVER + poses[:, :3, 3]
    fix = to_enu(antennas) + sigma * rng.normal(size=antennas.shape)
    covariance = np.tile(max(sigma, 0.1) ** 2 * np.eye(3), (len(fix), 1, 1))
    nanoseconds = [np.round(times * 1e9).astype(np.int64) for times in (seconds, at_fixes)]
    return Drive(nanoseconds[0], poses_at(seconds), nanoseconds[1], fix, covariance)
