"""How far the error of the pose at a sweep's end runs ahead of the error's mean over the sweep.

A sweep that is put together along a predicted motion keeps that motion's errors: what matches it measures the
mean of the pose's error over the points, not the error at the end. An error that arises at time t shows at
once in the rotation, in proportion to the time since then in the position if it is one of the velocity, and
to that time's square if it is one of the acceleration.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.core.error_state import POSITION, ROTATION
from lio_jax.core.prefix_sum import prefix_sum
from lio_jax.imu.increments import Sensitivity

LAG_DOF = 6
"""Rotation (rad) before position (m), in the IMU frame of the sweep's end."""


def still_to_show(
    time: Float[Array, "*n"], sweep_start: Float[Array, ""], end: Float[Array, ""]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"], Float[Array, "*n"]]:
    """Return what share of an effect at the end is not in its mean over the points, which come evenly.

    That is one less the mean of ((t - time)+ / (end - time))^k for points at times t, for k = 0, 1 and 2.

    Args:
        time: when the effect begins, s.
        sweep_start: time of the first point, s.
        end: time of the last point, s.
    """
    sweep = end - sweep_start
    left, waiting = end - time, jnp.maximum(sweep_start - time, 0.0)
    after = jnp.where(sweep > 0, (left - waiting) / jnp.where(sweep > 0, sweep, 1.0), 1.0)
    ratio = waiting / jnp.where(left > 0, left, 1.0)
    # a sweep without duration is all at its end
    ratio = jnp.where(sweep > 0, ratio, 1.0)
    return 1 - after, 1 - after * (1 + ratio) / 2, 1 - after * (1 + ratio * (1 + ratio)) / 3


def lag_of_inputs(
    effect: Sensitivity, time: Float[Array, " n"], sweep_start: Float[Array, ""], end: Float[Array, ""]
) -> Float[Array, "n 6 6"]:
    """Return the lag's derivative with respect to each interval's inputs.

    Args:
        effect: of the inputs on rotation, position and velocity at the end.
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
    """Return by how much the lag changes when the intervals change their durations, and so their times.

    Args:
        effect: of the durations on rotation, position and velocity at the end.
        longer: change of each interval's duration; their sum is zero.
        knots: the intervals' ends, s.
        sweep_start: time of the first point, s.
        end: time of the last point, s.
    """
    # where a knot moves, the inputs of the interval before it take the place of those after it
    later = prefix_sum(longer)[:-1]
    exchanged = later[:, None] * (effect.duration[:-1] - effect.duration[1:])
    at_once, linear, _ = still_to_show(knots[1:-1], sweep_start, end)
    # they differ in rate and force, so it shows in the rotation and in the velocity
    return jnp.concatenate([at_once @ exchanged[:, ROTATION], linear @ exchanged[:, POSITION]])
