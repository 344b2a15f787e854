"""A made drive whose truth is known: smooth motion, noisy samples, and an odometry that drifts."""

from itertools import pairwise
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from lio_jax.core.leaf import traced
from lio_jax.data.sequence import GpsData, ImuData
from lio_jax.data.trajectory import Trajectory
from lio_jax.fusion.params import FusionParams
from lio_jax.fusion.tune import replaced

GRAVITY = 9.80665
GYRO_NOISE, ACCEL_NOISE = 2e-3, 2e-2
GYRO_WALK, ACCEL_WALK = 2e-5, 2e-4
ROTATION_DRIFT, TRANSLATION_DRIFT = 1e-3, 1e-2
ROTATION_NOISE, TRANSLATION_NOISE = 2e-3, 2e-2
GPS_SIGMA = 0.3

T_IMU_SENSOR = np.eye(4)
T_IMU_SENSOR[:3, :3] = Rotation.from_euler("zyx", [90, 5, -80], degrees=True).as_matrix()
T_IMU_SENSOR[:3, 3] = [0.3, -0.1, 0.2]


class Drive(NamedTuple):
    """A drive: what is measured, and the truth."""

    odometry: Trajectory
    """Poses of the sensor in the odometry's world."""
    imu: ImuData
    gps: GpsData
    truth: Trajectory
    """True poses of the sensor in the level world."""
    gyro_bias: np.ndarray
    """First bias, (3,)."""
    accel_bias: np.ndarray


def motion(t):
    """Return positions and rotations of the IMU; the drive begins at 5 m/s."""
    position = np.stack([5 * t + 2 * np.sin(0.5 * t), 3 * np.sin(0.4 * t), 0.3 * np.sin(0.7 * t)], -1)
    angles = np.stack([0.6 * np.sin(0.4 * t), 0.1 * np.sin(0.9 * t), 0.1 * np.cos(0.6 * t)], -1)
    return position, Rotation.from_euler("zyx", angles)


def made_drive(seed=0, seconds=20.0, rate=100, stride=10, noise=1.0, gap=None):
    """Return a drive.

    Args:
        seed: of all noise.
        seconds: length.
        rate: of the samples, Hz.
        stride: samples from pose to pose.
        noise: factor of the noise of the odometry.
        gap: first and last time without samples, s, or None.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0, seconds, 1 / rate)
    step = 1e-4
    position, rotation = motion(t)
    before, after = motion(t - step), motion(t + step)
    rates = (before[1].inv() * after[1]).as_rotvec() / (2 * step)
    forces = rotation.inv().apply((after[0] - 2 * position + before[0]) / step**2 + [0, 0, GRAVITY])
    gyro_bias, accel_bias = rng.normal(size=3) * 5e-3, rng.normal(size=3) * 0.05
    walks = [
        np.cumsum(rng.normal(size=(len(t), 3)), 0) * walk / np.sqrt(rate) for walk in (GYRO_WALK, ACCEL_WALK)
    ]
    gyro = rates + gyro_bias + walks[0] + rng.normal(size=(len(t), 3)) * GYRO_NOISE * np.sqrt(rate)
    accel = forces + accel_bias + walks[1] + rng.normal(size=(len(t), 3)) * ACCEL_NOISE * np.sqrt(rate)
    stamps = np.round(t * 1e9).astype(np.int64) + 1_000_000_000
    body = np.tile(np.eye(4), (len(t), 1, 1))
    body[:, :3, :3], body[:, :3, 3] = rotation.as_matrix(), position
    sensor = (body @ T_IMU_SENSOR)[::stride]
    drifting = [np.eye(4)]
    for first, second in pairwise(sensor):
        relative = np.linalg.inv(first) @ second
        way = np.sqrt(np.linalg.norm(relative[:3, 3]) + 0.1 * stride / rate)
        drifting.append(drifting[-1] @ relative @ _error(rng, noise * way, ROTATION_DRIFT, TRANSLATION_DRIFT))
    odometry = np.stack([pose @ _error(rng, noise, ROTATION_NOISE, TRANSLATION_NOISE) for pose in drifting])
    kept = np.ones(len(t), bool) if gap is None else (t < gap[0]) | (t > gap[1])
    fixes = slice(7, None, rate)
    antenna = position[fixes] + rng.normal(size=position[fixes].shape) * GPS_SIGMA
    covariance = np.tile(np.eye(3) * GPS_SIGMA**2, (len(antenna), 1, 1))
    return Drive(
        Trajectory(stamps[::stride], odometry),
        ImuData(stamps[kept], gyro[kept], accel[kept]),
        GpsData(stamps[fixes], antenna, covariance, (np.nan,) * 3),
        Trajectory(stamps[::stride], sensor),
        gyro_bias,
        accel_bias,
    )


def _error(rng, scale, rotation, translation):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(size=3) * scale * rotation).as_matrix()
    pose[:3, 3] = rng.normal(size=3) * scale * translation
    return pose


def true_params(noise=1.0):
    """Return the parameters of a made drive."""
    names = {
        "imu.gyro_noise": GYRO_NOISE,
        "imu.accel_noise": ACCEL_NOISE,
        "imu.gyro_bias_walk": GYRO_WALK,
        "imu.accel_bias_walk": ACCEL_WALK,
        "odometry.rotation_drift": noise * ROTATION_DRIFT,
        "odometry.translation_drift": noise * TRANSLATION_DRIFT,
        "odometry.rotation_noise": noise * ROTATION_NOISE,
        "odometry.translation_noise": noise * TRANSLATION_NOISE,
        "initial.accel_bias_sigma": 0.05,
        "initial.gyro_bias_sigma": 5e-3,
    }
    return replaced(traced(FusionParams), list(names), jnp.asarray(list(names.values())))
