"""Propagate state and covariance along inertial samples, and relate the error at a sweep's end to its
mean."""

import dataclasses

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.error_state import (
    BIASES,
    DOF,
    GRAVITY,
    LAG,
    POSITION,
    ROTATION,
    TIME_OFFSET,
    VELOCITY,
    NavEstimate,
    SweptState,
    sphere_basis,
)
from lio_jax.core.geometry import from_blocks, rotation_matrix, skew
from lio_jax.core.types import ImuBatch, NavState
from lio_jax.imu.params import ImuParams
from lio_jax.imu.path import Path
from lio_jax.imu.preintegration import (
    NAV_DOF,
    Increments,
    accumulate,
    nav_transition,
)
from lio_jax.imu.sample_effects import (
    LAG_DOF,
    ImuModel,
    SampledMotion,
    intervals_and_shift,
    sample_effects,
    still_to_show,
)
from lio_jax.imu.sampling import Intervals, sample_intervals

_LAG_POSITION = slice(LAG.start + 3, LAG.stop)


def propagate(
    state: NavEstimate,
    imu: ImuBatch,
    params: ImuParams,
    start: Float[Array, ""],
    end: Float[Array, ""],
) -> tuple[NavEstimate, Path]:
    """Propagate a state from ``start`` to ``end`` as :func:`propagate_sweep` does, without a sweep."""
    swept, path = propagate_sweep(state, imu, params, start, end, end)
    return swept.at_end(), path


def propagate_sweep(
    state: NavEstimate,
    imu: ImuBatch,
    params: ImuParams,
    start: Float[Array, ""],
    end: Float[Array, ""],
    sweep_start: Float[Array, ""],
    rate: Float[Array, "3"] | None = None,
) -> tuple[SweptState, Path]:
    """Propagate a state and its covariance from ``start`` to ``end`` along the inertial samples.

    :func:`lio_jax.imu.sampling.sample_intervals` makes intervals of the samples. Where no sample is near the
    span, the rate and the velocity in the body's own axes stay constant. There, and in long gaps between
    samples, the noise is that of an unknown motion (:mod:`lio_jax.imu.discretise`).

    Args:
        state: at ``start``.
        imu: samples from the last one before ``start`` to the first one after ``end``.
        params: noise densities.
        start: usually the previous scan's end, s from this scan's start.
        end: s from this scan's start, not before ``start``.
        sweep_start: time of the sweep's first point, s from this scan's start. The last point is at ``end``.
        rate: angular rate where nothing is measured, rad/s, IMU frame; None: zero.

    Returns:
        The state at ``end``, with the covariance of its error and of the error's difference from its mean
        over the sweep; and the path from ``start`` to ``end``.
    """
    nav = state.nav
    intervals, shift = intervals_and_shift(imu, nav.time_offset, start, end)
    unmeasured = _carried_on(nav, rate)
    increments, path = _follow(nav, intervals, start, unmeasured)
    last = jaxlie.SE3(path.T_world_imu.wxyz_xyz[-1])
    moved = dataclasses.replace(nav, T_world_imu=last, velocity=path.velocity[-1])

    motion = SampledMotion(intervals, shift, path.rate, path.accel, increments)
    times = start, end, sweep_start
    model = ImuModel(*_added_to_samples(nav, intervals.measured, unmeasured), nav.time_offset, params)
    effects = sample_effects(motion, model, imu, times)

    shown = still_to_show(start, sweep_start, end)
    transition = _transition(nav, increments, path.gravity, effects.by_bias, effects.by_offset, shown)
    covariance = transition @ state.covariance @ transition.T + _placed(effects.noise)
    return SweptState(moved, (covariance + covariance.T) / 2, transition), path


def _added_to_samples(
    nav: NavState, measured: Bool[Array, ""], unmeasured: tuple[Float[Array, "3"], Float[Array, "3"]]
) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return what is added to sampled rates and forces: minus the bias; the motion itself without samples."""
    rate, accel = unmeasured
    return jnp.where(measured, -nav.gyro_bias, rate), jnp.where(measured, -nav.accel_bias, accel)


def path_along(nav: NavState, imu: ImuBatch, start: Float[Array, ""], end: Float[Array, ""]) -> Path:
    """Return the path from ``start`` to ``end`` that :func:`propagate` returns, without a covariance.

    Args:
        nav: at ``start``.
        imu: samples from the last one before ``start`` to the first one after ``end``.
        start: on the lidar's clock, s, from the same origin as the samples' times.
        end: on the lidar's clock, s, not before ``start``.
    """
    intervals = sample_intervals(imu, nav.time_offset, start, end)
    return _follow(nav, intervals, start, _carried_on(nav, None))[1]


def _carried_on(nav: NavState, rate: Float[Array, "3"] | None) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Return rate and weightless force of a body whose rate and velocity in its own axes stay constant."""
    rate = jnp.zeros_like(nav.velocity) if rate is None else rate
    return rate, jnp.cross(rate, rotation_matrix(nav.T_world_imu.rotation()).T @ nav.velocity)


def _follow(
    nav: NavState,
    intervals: Intervals,
    start: Float[Array, ""],
    unmeasured: tuple[Float[Array, "3"], Float[Array, "3"]],
) -> tuple[Increments, Path]:
    rate, accel = intervals.without_bias(nav.gyro_bias, nav.accel_bias, unmeasured)
    # nothing measures the weight there, so gravity must have no effect either
    gravity = jnp.where(intervals.measured, nav.gravity, 0.0)
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
    gravity: Float[Array, "3"],
    by_bias: Float[Array, "15 6"],
    by_offset: Float[Array, "15"],
    to_show: tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""]],
) -> Float[Array, "30 24"]:
    """Return the derivative of the error at the end, and of ``LAG``, by the error at the start.

    Args:
        nav: at the start.
        increments: motion since the start.
        gravity: m/s^2, in world; zero where nothing is measured.
        by_bias: derivative of rotation, position and velocity at the end, and of ``LAG``, by the biases.
        by_offset: derivative of the same quantities by the time offset.
        to_show: what :func:`still_to_show` returns for the start.
    """
    elapsed = increments.time[-1]
    turned = jaxlie.SO3(increments.rotation.wxyz[-1])
    last = nav.T_world_imu.rotation() @ turned
    fall = rotation_matrix(last).T @ -skew(gravity) @ sphere_basis(nav.gravity)
    carried = nav_transition(turned, increments.velocity[-1], increments.position[-1], elapsed)
    every, rest = slice(0, NAV_DOF), slice(NAV_DOF, DOF)
    by_bias_or_offset = (
        (rows, columns, effect[part])
        for columns, effect in ((BIASES, by_bias), (TIME_OFFSET, by_offset[:, None]))
        for rows, part in ((every, every), (LAG, slice(NAV_DOF, None)))
    )
    _, linear, quadratic = to_show
    return from_blocks(
        (LAG.stop, DOF),
        (every, every, carried),
        (rest, rest, jnp.eye(DOF - NAV_DOF, dtype=carried.dtype)),
        (POSITION, GRAVITY, fall * elapsed**2 / 2),
        (VELOCITY, GRAVITY, fall * elapsed),
        (_LAG_POSITION, ROTATION, quadratic * carried[POSITION, ROTATION]),
        (_LAG_POSITION, VELOCITY, linear * carried[POSITION, VELOCITY]),
        (_LAG_POSITION, GRAVITY, quadratic * fall * elapsed**2 / 2),
        *by_bias_or_offset,
    )


def _placed(noise: Float[Array, "21 21"]) -> Float[Array, "30 30"]:
    """Return a covariance of motion, ``LAG`` and biases with its entries at their places in the error."""
    places = (slice(0, NAV_DOF), LAG, BIASES)
    parts = (slice(0, NAV_DOF), slice(NAV_DOF, NAV_DOF + LAG_DOF), slice(NAV_DOF + LAG_DOF, None))
    pairs = tuple(zip(places, parts, strict=True))
    blocks = ((rows, columns, noise[part, other]) for rows, part in pairs for columns, other in pairs)
    return from_blocks((LAG.stop, LAG.stop), *blocks)
