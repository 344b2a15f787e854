"""Inertial samples of a vehicle, in memory."""

import numpy as np

from lio_jax.data.sequence import ImuData

EPOCH_NS = 1_700_000_000_000_000_000
RATE = 200
GRAVITY = 9.80665


def drive(duration: float = 10.0, seed: int = 0) -> ImuData:
    """Return a second of rest, then a vehicle that sways, turns and accelerates; noise as of a MEMS unit."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(round(duration * RATE)) / RATE
    moving = np.clip(seconds - 1.0, 0.0, 1.0)[:, None]
    phase = seconds[:, None] * np.array([2.1, 1.7, 0.4])
    tilt = 0.03 * np.sin(phase[:, :2]) * moving
    gyro = (
        np.hstack([0.03 * np.array([2.1, 1.7]) * np.cos(phase[:, :2]), 0.4 * np.sin(phase[:, 2:])]) * moving
    )
    accel = np.stack([-tilt[:, 1], tilt[:, 0], np.ones(len(seconds))], axis=1) * GRAVITY
    accel[:, :1] += np.sin(0.5 * seconds[:, None]) * moving
    gyro += rng.normal(0, 0.005, gyro.shape)
    accel += rng.normal(0, 0.05, accel.shape)
    return ImuData(EPOCH_NS + np.arange(len(seconds)) * (1_000_000_000 // RATE), gyro, accel)


def replaced(imu: ImuData, **columns: np.ndarray) -> ImuData:
    return ImuData(**{"stamp_ns": imu.stamp_ns, "gyro": imu.gyro, "accel": imu.accel, **columns})
