"""Motion since the first instant of a chain of intervals, and its sensitivity to each interval's inputs.

Everything is relative to the frame of the first instant, where the recursions of Forster et al. ("On-manifold
preintegration for real-time visual-inertial odometry", T-RO 2017) become prefix sums: only the product of the
rotations is sequential. A disturbance of one interval reaches the end as a rotation about what has been
gained since then, so no chain of transition matrices is needed.
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
"""Rotation, position, velocity, in the frame of the last instant: the order of the error state."""


class Increments(eqx.Module):
    """Rotation, velocity and position gained since the first of n + 1 knots, without gravity."""

    time: Float[Array, " k"]
    """Since the first knot, s."""
    rotation: jaxlie.SO3
    """IMU frame at each knot to the first's, k."""
    velocity: Float[Array, "k 3"]
    """m/s, in the first frame."""
    position: Float[Array, "k 3"]
    """m, in the first frame."""


class Sensitivity(eqx.Module):
    """Derivative of the last increments' error with respect to the inputs of each of n intervals.

    The error is a right perturbation: rotation, position and velocity in the last knot's frame.
    """

    inputs: Float[Array, "n 9 6"]
    """Per angular rate, s, then per specific force."""
    duration: Float[Array, "n 9"]
    """Per duration, with the end at its time."""


def accumulate(
    duration: Float[Array, " n"],
    rate: Float[Array, "n 3"],
    accel: Float[Array, "n 3"],
    turning: bool = True,
    parallel: bool = False,
) -> Increments:
    """Return the increments at all knots of n intervals.

    Args:
        duration: s.
        rate: angular rate without bias, rad/s.
        accel: specific force without bias, m/s^2.
        turning: hold the force in the turning body's frame (exact for constant inputs); otherwise in the
            frame of the interval's start, as Forster et al. do.
        parallel: multiply the rotations by an associative scan instead of one after the other.
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
    """Return how the last of :func:`accumulate`'s increments depends on each interval's inputs."""
    matrix = rotation_matrix(increments.rotation)
    start, back = matrix[:-1], matrix[-1].T
    first, second = _integrals(rate * duration[:, None], turning)

    by_duration = _force_at_end(rate * duration[:, None], accel, turning)
    way_by_duration = duration[:, None, None] * (first @ accel[..., None])
    turned = start @ (first if turning else rotation_integrals(rate * duration[:, None])[0])
    h = duration[:, None, None]
    first_by, second_by = _by_rotvec(rate * duration[:, None], accel, turning)
    zero = jnp.zeros_like(turned)
    # impulses at the end of each interval, in the first frame: columns rate, specific force, duration
    rotation = jnp.concatenate([h * turned, zero, (start @ rate[..., None])], -1)
    velocity = start @ jnp.concatenate([h**2 * first_by, h * first, by_duration], -1)
    position = start @ jnp.concatenate([h**3 * second_by, h**2 * second, way_by_duration], -1)
    position = position.at[..., 6].add(increments.velocity[:-1])
    # what the impulses have become at the end
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
    """Return how an error of rotation, position and velocity at the first knot shows at the last one.

    Args:
        rotation: gained, as are ``velocity`` (m/s) and ``position`` (m), in the first frame.
        elapsed: s.
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
    """Return velocity and way gained within each interval from rest, in its first frame."""
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
