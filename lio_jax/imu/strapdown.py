"""Strapdown propagation of the navigation state and its covariance between two scans' ends."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.error_state import (
    ACCEL_BIAS,
    DOF,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    TIME_OFFSET,
    VELOCITY,
    Uncertain,
    sphere_basis,
)
from lio_jax.core.params import ImuParams
from lio_jax.core.types import ImuBatch, NavState
from lio_jax.imu.discretise import discretise
from lio_jax.imu.increments import NAV_DOF, Increments, Sensitivity, accumulate, nav_transition, sensitivity
from lio_jax.imu.path import Path
from lio_jax.imu.process_noise import process_noise
from lio_jax.imu.rotation_integrals import skew
from lio_jax.imu.sampling import Intervals, sample_intervals


def propagate(
    state: Uncertain,
    imu: ImuBatch,
    params: ImuParams,
    start: Float[Array, ""],
    end: Float[Array, ""],
) -> tuple[Uncertain, Path]:
    """Carry a state from ``start`` to ``end`` along the inertial samples, with its covariance.

    The samples are sampled as :func:`lio_jax.imu.sampling.sample_intervals` says, at the lidar's clock. Where
    no sample is near the whole span, the velocity stays constant and the rate is zero; there, and in long
    gaps, the noise is that of an unknown motion (:mod:`lio_jax.imu.discretise`).

    Args:
        state: at ``start``.
        imu: samples from the last one before ``start`` to the first one after ``end``.
        params: noise densities.
        start: usually the last scan's end, s from this scan's start.
        end: s from this scan's start, not before ``start``.

    Returns:
        The state at ``end``, and the motion in between.
    """
    nav = state.nav
    intervals = sample_intervals(imu, nav.time_offset, start, end)
    increments, path = _follow(nav, intervals, start)
    last = jaxlie.SE3(path.T_world_imu.wxyz_xyz[-1])
    moved = dataclasses.replace(nav, T_world_imu=last, velocity=path.velocity[-1])

    effect = sensitivity(increments, intervals.duration, path.rate, path.accel)
    by_offset = _effect_of_time_offset(nav, imu, start, end, effect)
    transition = _transition(nav, increments, effect, by_offset, path.gravity, intervals.measured)
    noise = discretise(params, intervals.duration, intervals.gap, intervals.known)
    added = process_noise(effect, noise, intervals.measured)
    covariance = _carry_covariance(state.covariance, transition).at[:15, :15].add(added)
    return Uncertain(moved, (covariance + covariance.T) / 2), path


def path_along(nav: NavState, imu: ImuBatch, start: Float[Array, ""], end: Float[Array, ""]) -> Path:
    """Return the motion from ``start`` to ``end`` alone, as :func:`propagate` does."""
    return _follow(nav, sample_intervals(imu, nav.time_offset, start, end), start)[1]


def _follow(nav: NavState, intervals: Intervals, start: Float[Array, ""]) -> tuple[Increments, Path]:
    # constant velocity where nothing is measured: gravity must not act either
    measured = intervals.measured
    rate = jnp.where(measured, intervals.gyro - nav.gyro_bias, 0.0)
    accel = jnp.where(measured, intervals.accel - nav.accel_bias, 0.0)
    gravity = jnp.where(measured, nav.gravity, 0.0)
    increments = accumulate(intervals.duration, rate, accel)
    rotation = nav.T_world_imu.rotation()
    matrix = rotation.as_matrix()
    elapsed = increments.time[:, None]
    fall = elapsed * (nav.velocity + elapsed / 2 * gravity)
    position = nav.T_world_imu.translation() + fall + increments.position @ matrix.T
    turned = jax.vmap(lambda gained: (rotation @ gained).normalize())(increments.rotation)
    path = Path(
        time=start + increments.time,
        T_world_imu=jaxlie.SE3.from_rotation_and_translation(turned, position),
        velocity=nav.velocity + elapsed * gravity + increments.velocity @ matrix.T,
        rate=rate,
        accel=accel,
        gravity=gravity,
    )
    return increments, path


def _effect_of_time_offset(
    nav: NavState, imu: ImuBatch, start: Float[Array, ""], end: Float[Array, ""], effect: Sensitivity
) -> Float[Array, "9"]:
    """Return the derivative of the last increments by the time offset, which shifts what is sampled."""

    def sampled(offset: Float[Array, ""]) -> tuple[Array, Array, Array]:
        intervals = sample_intervals(imu, offset, start, end)
        return intervals.gyro, intervals.accel, intervals.duration

    _, (gyro, accel, duration) = jax.jvp(sampled, (nav.time_offset,), (jnp.ones_like(nav.time_offset),))
    return (
        jnp.einsum("nij,nj->i", effect.rate, gyro)
        + jnp.einsum("nij,nj->i", effect.accel, accel)
        + jnp.einsum("ni,n->i", effect.duration, duration)
    )


def _transition(
    nav: NavState,
    increments: Increments,
    effect: Sensitivity,
    by_offset: Float[Array, "9"],
    gravity: Float[Array, "3"],
    measured: Array,
) -> Float[Array, "9 24"]:
    """Return the derivative of rotation, position and velocity at the end by the whole error at the start."""
    elapsed = increments.time[-1]
    turned = jaxlie.SO3(increments.rotation.wxyz[-1])
    last = nav.T_world_imu.rotation() @ turned
    fall = last.as_matrix().T @ -skew(gravity) @ sphere_basis(nav.gravity)
    own = nav_transition(turned, increments.velocity[-1], increments.position[-1], elapsed)
    transition = jnp.zeros((NAV_DOF, DOF), elapsed.dtype).at[:, :NAV_DOF].set(own)
    transition = transition.at[POSITION, GRAVITY].set(fall * elapsed**2 / 2)
    transition = transition.at[VELOCITY, GRAVITY].set(fall * elapsed)
    transition = transition.at[:, GYRO_BIAS].set(jnp.where(measured, -jnp.sum(effect.rate, 0), 0.0))
    transition = transition.at[:, ACCEL_BIAS].set(jnp.where(measured, -jnp.sum(effect.accel, 0), 0.0))
    return transition.at[:, TIME_OFFSET].set(by_offset[:, None])


def _carry_covariance(
    covariance: Float[Array, "24 24"], transition: Float[Array, "9 24"]
) -> Float[Array, "24 24"]:
    """Return Phi P Phi' where all rows of Phi but the first nine are the identity's."""
    rows = transition @ covariance
    rest = rows[:, NAV_DOF:]
    top = jnp.concatenate([rows @ transition.T, rest], axis=1)
    bottom = jnp.concatenate([rest.T, covariance[NAV_DOF:, NAV_DOF:]], axis=1)
    return jnp.concatenate([top, bottom])
