"""A smooth handheld motion in closed form and what an ideal inertial sensor on it measures."""

import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from lio_jax.core.types import ImuBatch, NavState

quick_jit = functools.partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
"""Compiles in half the time; these tests run their programs only a few times."""

GRAVITY = np.array([0.0, 0.0, -9.81])
GYRO_BIAS = np.array([0.02, -0.01, 0.03])
ACCEL_BIAS = np.array([0.1, 0.2, -0.15])


def position(t):
    return jnp.stack([3 * jnp.sin(1.3 * t), 2 * jnp.cos(0.9 * t) + t, 0.5 * jnp.sin(2.1 * t)])


def rotation(t):
    yaw = jaxlie.SO3.exp(jnp.stack([0.0 * t, 0.0 * t, 2.0 * jnp.sin(1.5 * t)]))
    return yaw @ jaxlie.SO3.exp(jnp.stack([0.4 * jnp.sin(2.3 * t), 0.3 * jnp.cos(1.7 * t), 0.0 * t]))


def velocity(t):
    return jax.jvp(position, (t,), (jnp.ones_like(t),))[1]


def measured(t):
    """Return rate and specific force without bias."""
    matrix, slope = jax.jvp(lambda s: rotation(s).as_matrix(), (t,), (jnp.ones_like(t),))
    spin = matrix.T @ slope
    rate = jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
    acceleration = jax.jvp(velocity, (t,), (jnp.ones_like(t),))[1]
    return rate, matrix.T @ (acceleration - GRAVITY)


def nav_at(t: float, time_offset: float = 0.0) -> NavState:
    now = jnp.asarray(t)
    return NavState(
        T_world_imu=jaxlie.SE3.from_rotation_and_translation(rotation(now), position(now)),
        velocity=velocity(now),
        gyro_bias=jnp.asarray(GYRO_BIAS),
        accel_bias=jnp.asarray(ACCEL_BIAS),
        gravity=jnp.asarray(GRAVITY),
        T_imu_lidar=jaxlie.SE3.exp(jnp.array([0.1, -0.2, 0.3, 0.5, -0.4, 1.0])),
        time_offset=jnp.asarray(time_offset),
    )


def pose_matrix(t: float) -> np.ndarray:
    return np.asarray(nav_at(t).T_world_imu.as_matrix())


_measured = jax.jit(jax.vmap(measured))


def ideal_imu(times: np.ndarray, origin: float = 0.0, time_offset: float = 0.0, size: int = 48) -> ImuBatch:
    """Return the samples taken at ``times`` on the lidar's clock, stamped by the IMU from ``origin`` on.

    They are padded to ``size`` with rows that are not a number.
    """
    mask = np.arange(size) < len(times)
    padded = np.pad(times, (0, size - len(times)))
    rate, force = _measured(jnp.asarray(padded))
    return ImuBatch(
        time=jnp.asarray(np.where(mask, padded - origin + time_offset, np.nan)),
        gyro=jnp.where(mask[:, None], rate + GYRO_BIAS, jnp.nan),
        accel=jnp.where(mask[:, None], force + ACCEL_BIAS, jnp.nan),
        mask=jnp.asarray(mask),
    )
