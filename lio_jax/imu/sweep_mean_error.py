"""The difference between a pose's error at a sweep's end and the mean of that error over the sweep.

A sweep that is deskewed along a predicted motion contains that motion's errors. Matching such a sweep
measures the mean of the pose's error over the points, and not the error at the end. An error of the rotation
acts at once. An error of the velocity acts on the position in proportion to the time since it arose, and an
error of the acceleration in proportion to the square of that time. The difference is called the lag here.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.core.error_state import POSITION, ROTATION
from lio_jax.core.prefix_sum import prefix_sum
from lio_jax.imu.increments import Sensitivity

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
