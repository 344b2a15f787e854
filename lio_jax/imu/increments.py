"""Motion since the start of a chain of intervals, and its derivative by each interval's inputs.

All quantities are expressed in the frame of the first instant. There the recursions of Forster et al.
("On-manifold preintegration for real-time visual-inertial odometry", T-RO 2017) become prefix sums, and only
the product of the rotations is sequential. The effect of an interval's disturbance on the end follows from
the velocity and position gained since then, so no chain of transition matrices is needed.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.error_state import POSITION, ROTATION, VELOCITY
from lio_jax.core.geometry import from_blocks, rotation_matrix, skew
from lio_jax.core.prefix_sum import prefix_sum
from lio_jax.imu.rotation_integrals import integral_derivatives, rotation_exponential, rotation_integrals

NAV_DOF = 9
"""Size of an error of rotation (rad), position (m) and velocity (m/s), in the order of the error state."""


class Increments(eqx.Module):
    """Rotation, velocity and position gained since the first of k knots, without gravity."""

    time: Float[Array, " k"]
    """Time since the first knot, s."""
    rotation: jaxlie.SO3
    """Rotation from the IMU frame of each of the k knots to that of the first knot."""
    velocity: Float[Array, "k 3"]
    """Velocity gained since the first knot, m/s, in the IMU frame of the first knot."""
    position: Float[Array, "k 3"]
    """Position gained since the first knot, m, in the IMU frame of the first knot."""


class Sensitivity(eqx.Module):
    """Derivative of the last increments with respect to the inputs of each of n intervals.

    The nine rows are a right perturbation: rotation (rad), position (m) and velocity (m/s) in the last knot's
    frame.
    """

    inputs: Float[Array, "n 9 6"]
    """Derivative with respect to the angular rate (rad/s), then to the specific force (m/s^2)."""
    duration: Float[Array, "n 9"]
    """Derivative with respect to the duration of the interval (s), later intervals unchanged."""


def accumulate(
    duration: Float[Array, " n"],
    rate: Float[Array, "n 3"],
    accel: Float[Array, "n 3"],
    turning: bool = True,
    parallel: bool = False,
) -> Increments:
    """Return the increments at all n + 1 knots of n intervals.

    Args:
        duration: length of each interval, s.
        rate: angular rate without bias, rad/s, IMU frame.
        accel: specific force without bias, m/s^2, IMU frame.
        turning: True: the specific force is constant in the turning IMU frame, which is exact for constant
            inputs. False: it is constant in the IMU frame of the interval's start, as in Forster et al.
        parallel: multiply the rotations by an associative scan instead of a sequential one.
    """
    turn = jaxlie.SO3.exp(rate * duration[:, None]).wxyz
    if parallel:
        products = jax.lax.associative_scan(_multiply, turn)
    else:
        unit = jaxlie.SO3.identity().wxyz.astype(turn.dtype)
        products = jax.lax.scan(lambda r, t: (_multiply(r, t),) * 2, unit, turn)[1]
    unit = jnp.zeros_like(turn[:1]).at[0, 0].set(1)
    rotation = jaxlie.SO3(jnp.concatenate([unit, products])).normalize()
    gained, moved = _gain(rate, accel, duration, turning)
    matrix = rotation_matrix(rotation)[:-1]
    velocity = _knots(jnp.einsum("nij,nj->ni", matrix, gained))
    position = _knots(jnp.einsum("nij,nj->ni", matrix, moved) + velocity[:-1] * duration[:, None])
    return Increments(_knots(duration), rotation, velocity, position)


def sensitivity(
    increments: Increments,
    duration: Float[Array, " n"],
    rate: Float[Array, "n 3"],
    accel: Float[Array, "n 3"],
    turning: bool = True,
) -> Sensitivity:
    """Return the derivative of the last of :func:`accumulate`'s increments by each interval's inputs.

    Args:
        increments: the result of :func:`accumulate` for the same inputs.
        duration: length of each interval, s.
        rate: angular rate without bias, rad/s, IMU frame.
        accel: specific force without bias, m/s^2, IMU frame.
        turning: as in :func:`accumulate`.
    """
    matrix = rotation_matrix(increments.rotation)
    start, back = matrix[:-1], matrix[-1].T
    first, second = _integrals(rate * duration[:, None], turning)

    by_duration = _force_at_end(rate * duration[:, None], accel, turning)
    way_by_duration = duration[:, None, None] * (first @ accel[..., None])
    turned = start @ (first if turning else rotation_integrals(rate * duration[:, None])[0])
    h = duration[:, None, None]
    first_by, second_by = _by_rotvec(rate * duration[:, None], accel, turning)
    zero = jnp.zeros_like(turned)
    # effects at the end of each interval, in the first frame: columns rate, specific force, duration
    rotation = jnp.concatenate([h * turned, zero, (start @ rate[..., None])], -1)
    velocity = start @ jnp.concatenate([h**2 * first_by, h * first, by_duration], -1)
    position = start @ jnp.concatenate([h**3 * second_by, h**2 * second, way_by_duration], -1)
    position = position.at[..., 6].add(increments.velocity[:-1])
    # the same effects at the last knot
    left = (increments.time[-1] - increments.time[1:])[:, None, None]
    speed = increments.velocity[-1] - increments.velocity[1:]
    way = increments.position[-1] - increments.position[1:] - increments.velocity[1:] * left[..., 0]
    final = back @ jnp.stack(
        [
            rotation,
            position + left * velocity - skew(way) @ rotation,
            velocity - skew(speed) @ rotation,
        ],
        1,
    )
    final = final.reshape(-1, NAV_DOF, 7)
    return Sensitivity(final[..., :6], final[..., 6])


def nav_transition(
    rotation: jaxlie.SO3, velocity: Float[Array, "3"], position: Float[Array, "3"], elapsed: Float[Array, ""]
) -> Float[Array, "9 9"]:
    """Return the transition matrix of an error of rotation, position and velocity over a span.

    Args:
        rotation: from the IMU frame at the end of the span to that at its start.
        velocity: gained over the span without gravity, m/s, in the first IMU frame.
        position: gained over the span without gravity and initial velocity, m, in the first IMU frame.
        elapsed: length of the span, s.
    """
    back = rotation_matrix(rotation).T
    by_position, by_velocity = -back @ skew(jnp.stack([position, velocity]))
    return from_blocks(
        (NAV_DOF, NAV_DOF),
        (ROTATION, ROTATION, back),
        (POSITION, ROTATION, by_position),
        (POSITION, POSITION, back),
        (POSITION, VELOCITY, elapsed * back),
        (VELOCITY, ROTATION, by_velocity),
        (VELOCITY, VELOCITY, back),
    )


def _integrals(rotvec: Float[Array, "n 3"], turning: bool) -> tuple[Array, Array]:
    if turning:
        return rotation_integrals(rotvec)
    identity = jnp.broadcast_to(jnp.eye(3, dtype=rotvec.dtype), (*rotvec.shape, 3))
    return identity, identity / 2


def _gain(rate: Array, accel: Array, duration: Array, turning: bool) -> tuple[Array, Array]:
    """Return the velocity (m/s) and the way (m) gained within each interval from rest, in its first frame."""
    h = duration[:, None]
    first, second = _integrals(rate * h, turning)
    return h * (first @ accel[..., None])[..., 0], h**2 * (second @ accel[..., None])[..., 0]


def _multiply(p: Float[Array, "*b 4"], q: Float[Array, "*b 4"]) -> Float[Array, "*b 4"]:
    return (jaxlie.SO3(p) @ jaxlie.SO3(q)).wxyz


def _knots(steps: Float[Array, "n *s"]) -> Float[Array, "k *s"]:
    return jnp.concatenate([jnp.zeros_like(steps[:1]), prefix_sum(steps)])


def _by_rotvec(rotvec: Float[Array, "n 3"], accel: Float[Array, "n 3"], turning: bool) -> tuple[Array, Array]:
    if turning:
        return integral_derivatives(rotvec, accel)
    return (jnp.zeros((*rotvec.shape, 3), rotvec.dtype),) * 2


def _force_at_end(rotvec: Float[Array, "n 3"], accel: Float[Array, "n 3"], turning: bool) -> Array:
    return rotation_exponential(rotvec) @ accel[..., None] if turning else accel[..., None]
