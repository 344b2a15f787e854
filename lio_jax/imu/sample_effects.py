"""What errors of the inertial samples of a span lead to at its end: noise, biases and the clock's offset."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from lio_jax.core.error_state import POSITION, ROTATION
from lio_jax.core.implicit import with_derivative_of
from lio_jax.core.prefix_sum import prefix_sum
from lio_jax.core.types import ImuBatch
from lio_jax.imu.discretise import IntervalNoise, discretise, process_noise, process_noise_slopes
from lio_jax.imu.params import ImuParams
from lio_jax.imu.preintegration import Increments, Sensitivity, accumulate, sensitivity
from lio_jax.imu.sampling import Intervals, sample_intervals

LAG_DOF = 6
"""Size of the lag: rotation (rad), then position (m), in the IMU frame of the sweep's end."""


def still_to_show(
    time: Float[Array, "*n"], sweep_start: Float[Array, ""], end: Float[Array, ""]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """Return the share of an error at the sweep's end that its mean over the sweep does not contain.

    The points are uniform in time. An error that arises at ``time`` and grows with the k-th power of the time
    since then has the share 1 - mean of ((t - time)+ / (end - time))^k over the points' times t.

    Args:
        time: when the error arises, s.
        sweep_start: time of the first point, s.
        end: time of the last point, s.

    Returns:
        The shares for k = 0, 1 and 2, no unit.
    """
    sweep = end - sweep_start
    left, waiting = end - time, jnp.maximum(sweep_start - time, 0.0)
    after = jnp.where(sweep > 0, (left - waiting) / jnp.where(sweep > 0, sweep, 1.0), 1.0)
    ratio = waiting / jnp.where(left > 0, left, 1.0)
    # all points of a sweep without duration are at its end
    ratio = jnp.where(sweep > 0, ratio, 1.0)
    return 1 - after, 1 - after * (1 + ratio) / 2, 1 - after * (1 + ratio * (1 + ratio)) / 3


def lag_of_inputs(
    effect: Sensitivity, time: Float[Array, " n"], sweep_start: Float[Array, ""], end: Float[Array, ""]
) -> Float[Array, "n 6 6"]:
    """Return the derivative of the lag with respect to each interval's inputs.

    Args:
        effect: derivatives of rotation, position and velocity at the end by the inputs.
        time: middle of each interval, s.
        sweep_start: time of the first point, s.
        end: time of the last point, s.
    """
    at_once, linear, quadratic = (share[:, None] for share in still_to_show(time, sweep_start, end))
    rotation = at_once[..., None] * effect.inputs[:, ROTATION]
    by_input = jnp.repeat(jnp.concatenate([quadratic, linear], axis=1), 3, axis=1)
    return jnp.concatenate([rotation, by_input[:, None] * effect.inputs[:, POSITION]], axis=1)


def lag_of_durations(
    effect: Sensitivity,
    longer: Float[Array, " n"],
    knots: Float[Array, " k"],
    sweep_start: Float[Array, ""],
    end: Float[Array, ""],
) -> Float[Array, "6"]:
    """Return the change of the lag when the intervals change their durations, and so their times.

    Args:
        effect: derivatives of rotation, position and velocity at the end by the durations.
        longer: change of each interval's duration, s; their sum is zero.
        knots: the k = n + 1 ends of the intervals, s.
        sweep_start: time of the first point, s.
        end: time of the last point, s.
    """
    # where a knot moves later, the inputs of the interval before it replace those of the interval after it
    later = prefix_sum(longer)[:-1]
    exchanged = later[:, None] * (effect.duration[:-1] - effect.duration[1:])
    at_once, linear, _ = still_to_show(knots[1:-1], sweep_start, end)
    # these inputs differ in rate and force, so the exchange acts on the rotation and on the velocity
    return jnp.concatenate([at_once @ exchanged[:, ROTATION], linear @ exchanged[:, POSITION]])


class SampledMotion(NamedTuple):
    """The motion in each interval of a span."""

    intervals: Intervals
    shift: Intervals
    """Derivative of the intervals by the time offset."""
    rate: Float[Array, "n 3"]
    """Without bias, rad/s, IMU frame."""
    accel: Float[Array, "n 3"]
    """Without bias, m/s^2, IMU frame."""
    increments: Increments


class ImuModel(NamedTuple):
    """What the effects of a span's samples depend on, beside the samples."""

    rate: Float[Array, "3"]
    """Added to the sampled angular rates, rad/s, IMU frame."""
    accel: Float[Array, "3"]
    """Added to the sampled specific forces, m/s^2, IMU frame."""
    time_offset: Float[Array, ""]
    noise: ImuParams


class SampleEffects(NamedTuple):
    """What errors of the samples lead to: rotation (rad), position (m) and velocity (m/s) at the span's end,
    then ``LAG``."""

    noise: Float[Array, "21 21"]
    """Covariance of these, and of the change of both biases."""
    by_bias: Float[Array, "15 6"]
    """Derivative by the biases."""
    by_offset: Float[Array, "15"]
    """Derivative by the time offset."""


class _Response(NamedTuple):
    """Derivatives of rotation, position and velocity at the span's end, and of ``LAG``."""

    inputs: Float[Array, "n 15 6"]
    """By the angular rate and the specific force of each interval."""
    by_offset: Float[Array, "15"]
    """By the time offset."""


def sample_effects(
    motion: SampledMotion, model: ImuModel, imu: ImuBatch, times: tuple[Array, Array, Array]
) -> SampleEffects:
    """Return what errors of a span's samples lead to at its end.

    Args:
        motion: in the span, of ``model`` and ``imu``.
        model: what may have tangents; a derivative is that of :func:`_linear_effects`.
        imu: samples from the last one before the span to the first one after it.
        times: start and end of the span, and time of the sweep's first point, s.
    """
    known = _effects_of(*jax.lax.stop_gradient((motion, model.noise, *times)))
    held = jax.lax.stop_gradient(model)
    return with_derivative_of(known, _linear_effects, model, held, imu, times)


def _effects_of(
    motion: SampledMotion, noise: ImuParams, start: Array, end: Array, sweep_start: Array
) -> SampleEffects:
    intervals = motion.intervals
    response = _response_of(motion, start, end, sweep_start)
    each = discretise(noise, intervals.duration, intervals.gap, intervals.known)
    return SampleEffects(
        noise=process_noise(response.inputs, each, intervals.measured),
        by_bias=_by_bias(response, intervals.measured),
        by_offset=response.by_offset,
    )


def _response_of(motion: SampledMotion, start: Array, end: Array, sweep_start: Array) -> _Response:
    intervals, shift, rate, accel, increments = motion
    effect = sensitivity(increments, intervals.duration, rate, accel)
    knots = start + increments.time
    middle = (knots[:-1] + knots[1:]) / 2
    lag_inputs = lag_of_inputs(effect, middle, sweep_start, end)
    inputs = jnp.concatenate([effect.inputs, lag_inputs], axis=1)
    signal = jnp.concatenate([shift.gyro, shift.accel], axis=1)
    lag_by_offset = lag_of_durations(effect, shift.duration, knots, sweep_start, end)
    moved_knots = jnp.concatenate([shift.duration @ effect.duration, lag_by_offset])
    return _Response(inputs, jnp.einsum("nij,nj->i", inputs, signal) + moved_knots)


def _by_bias(response: _Response, measured: Bool[Array, ""]) -> Float[Array, "15 6"]:
    return jnp.where(measured, -jnp.sum(response.inputs, axis=0), 0.0)


def _linear_effects(model: ImuModel, held: ImuModel, imu: ImuBatch, times: tuple) -> SampleEffects:
    """Return the effects as a linear function of the model around the same values.

    The slope by each of its few numbers is worked out once, so the cost grows little with the number of
    tangents. This holds as long as ``model`` alone has tangents: any other argument with tangents would make
    every slope a second derivative along each of them. The covariance is quadratic in the response to the
    samples and linear in the variances of their noise, so the slopes by what changes the variances need none
    of the response.
    """
    intervals, _ = intervals_and_shift(imu, held.time_offset, *times[:2])
    measured = intervals.measured

    def response(x: Array) -> _Response:
        moved, shift = intervals_and_shift(imu, x[6], *times[:2])
        rate, accel = moved.gyro + x[:3], moved.accel + x[3:6]
        increments = accumulate(moved.duration, rate, accel)
        return _response_of(SampledMotion(moved, shift, rate, accel, increments), *times)

    def variances(x: Array) -> IntervalNoise:
        time_offset, noise = of_noise(x)
        cut, _ = intervals_and_shift(imu, time_offset, *times[:2])
        return discretise(noise, cut.duration, cut.gap, cut.known)

    at = jnp.concatenate([held.rate, held.accel, held.time_offset[None]])
    moved = jnp.concatenate([model.rate, model.accel, model.time_offset[None]]) - at
    # the time offset changes how long the first and the last interval are, and so their noise
    noise_at, of_noise = ravel_pytree((held.time_offset, held.noise))
    noise_moved = ravel_pytree((model.time_offset, model.noise))[0] - noise_at

    value, slopes = _value_and_slopes(response, at)
    each, each_slopes = _value_and_slopes(variances, noise_at)
    by_response, by_variances = process_noise_slopes(value.inputs, slopes.inputs, each, each_slopes, measured)
    noise = jnp.tensordot(moved, by_response, 1) + jnp.tensordot(noise_moved, by_variances, 1)
    by_bias = jnp.tensordot(moved, jax.vmap(lambda slope: _by_bias(slope, measured))(slopes), 1)
    return SampleEffects(
        noise=process_noise(value.inputs, each, measured) + noise,
        by_bias=_by_bias(value, measured) + by_bias,
        by_offset=value.by_offset + moved @ slopes.by_offset,
    )


def _value_and_slopes(function: Callable[[Array], Any], at: Float[Array, " d"]) -> tuple[Any, Any]:
    """Return a function's value, and its derivatives by each of d numbers along a new first axis."""
    units = jnp.eye(len(at), dtype=at.dtype)
    return function(at), jax.vmap(lambda unit: jax.jvp(function, (at,), (unit,))[1])(units)


def intervals_and_shift(
    imu: ImuBatch, time_offset: Array, start: Array, end: Array
) -> tuple[Intervals, Intervals]:
    """Return the intervals of a span, and their derivative by the time offset."""
    return jax.jvp(
        lambda offset: sample_intervals(imu, offset, start, end),
        (time_offset,),
        (jnp.ones_like(time_offset),),
    )
