"""Strapdown propagation of the navigation state and its covariance between two scans' ends."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.blocks import from_blocks
from lio_jax.core.error_state import (
    BIASES,
    DOF,
    GRAVITY,
    POSITION,
    TIME_OFFSET,
    VELOCITY,
    Uncertain,
    sphere_basis,
)
from lio_jax.core.params import ImuParams
from lio_jax.core.rotation import rotation_matrix, skew
from lio_jax.core.types import ImuBatch, NavState
from lio_jax.imu.discretise import discretise
from lio_jax.imu.increments import NAV_DOF, Increments, Sensitivity, accumulate, nav_transition, sensitivity
from lio_jax.imu.path import Path
from lio_jax.imu.process_noise import process_noise
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
    intervals, shift = jax.jvp(
        lambda offset: sample_intervals(imu, offset, start, end),
        (nav.time_offset,),
        (jnp.ones_like(nav.time_offset),),
    )
    increments, path = _follow(nav, intervals, start)
    last = jaxlie.SE3(path.T_world_imu.wxyz_xyz[-1])
    moved = dataclasses.replace(nav, T_world_imu=last, velocity=path.velocity[-1])

    effect = sensitivity(increments, intervals.duration, path.rate, path.accel)
    transition = _transition(nav, increments, effect, shift, path.gravity, intervals.measured)
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
    matrix = rotation_matrix(rotation)
    elapsed = increments.time[:, None]
    fall = elapsed * (nav.velocity + elapsed / 2 * gravity)
    position = nav.T_world_imu.translation() + fall + increments.position @ matrix.T
    turned = (rotation @ increments.rotation).normalize()
    path = Path(
        time=start + increments.time,
        T_world_imu=jaxlie.SE3.from_rotation_and_translation(turned, position),
        velocity=nav.velocity + elapsed * gravity + increments.velocity @ matrix.T,
        rate=rate,
        accel=accel,
        gravity=gravity,
    )
    return increments, path


def _transition(
    nav: NavState,
    increments: Increments,
    effect: Sensitivity,
    shift: Intervals,
    gravity: Float[Array, "3"],
    measured: Array,
) -> Float[Array, "9 24"]:
    """Return the derivative of rotation, position and velocity at the end by the whole error at the start.

    The time offset acts through ``shift``, its effect on what is sampled.
    """
    elapsed = increments.time[-1]
    turned = jaxlie.SO3(increments.rotation.wxyz[-1])
    last = nav.T_world_imu.rotation() @ turned
    fall = rotation_matrix(last).T @ -skew(gravity) @ sphere_basis(nav.gravity)
    signal = jnp.concatenate([shift.gyro, shift.accel], axis=1)
    by_offset = jnp.einsum("nij,nj->i", effect.inputs, signal) + shift.duration @ effect.duration
    every = slice(0, NAV_DOF)
    return from_blocks(
        (NAV_DOF, DOF),
        (every, every, nav_transition(turned, increments.velocity[-1], increments.position[-1], elapsed)),
        (every, BIASES, jnp.where(measured, -jnp.sum(effect.inputs, 0), 0.0)),
        (POSITION, GRAVITY, fall * elapsed**2 / 2),
        (VELOCITY, GRAVITY, fall * elapsed),
        (every, TIME_OFFSET, by_offset[:, None]),
    )


def _carry_covariance(
    covariance: Float[Array, "24 24"], transition: Float[Array, "9 24"]
) -> Float[Array, "24 24"]:
    """Return Phi P Phi' where all rows of Phi but the first nine are the identity's."""
    rows = transition @ covariance
    rest = rows[:, NAV_DOF:]
    top = jnp.concatenate([rows @ transition.T, rest], axis=1)
    bottom = jnp.concatenate([rest.T, covariance[NAV_DOF:, NAV_DOF:]], axis=1)
    return jnp.concatenate([top, bottom])
