"""Motion compensation: express every point in the sensor frame of one instant."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def deskew_constant_velocity(
    points: Float[Array, "n 3"], delay: Float[Array, " n"], twist: Float[Array, "6"]
) -> Float[Array, "n 3"]:
    """Move points measured ``delay`` seconds after an instant into the sensor frame of that instant.

    The result is p' = exp(delay * twist) p. The SE(3) exponential is in closed form (Rodrigues), in the
    points' dtype, without a quaternion for each point.

    Args:
        points: m, sensor frame at the firing time of each point.
        delay: firing time minus the instant, s; negative for points before the instant.
        twist: velocity of the sensor in its own frame, translation (m/s) first, then rotation (rad/s).
    """
    velocity, rate = twist[:3].astype(points.dtype), twist[3:].astype(points.dtype)
    angle_squared = delay**2 * jnp.sum(rate**2)
    small = angle_squared < 1e-2  # above it 1 - cos keeps enough digits in float32
    safe = jnp.where(small, 1.0, angle_squared)
    angle = jnp.sqrt(safe)
    a = jnp.where(small, 1 - angle_squared / 6 * (1 - angle_squared / 20), jnp.sin(angle) / angle)
    b = jnp.where(small, 0.5 - angle_squared / 24 * (1 - angle_squared / 30), (1 - jnp.cos(angle)) / safe)
    c = jnp.where(small, 1 / 6 - angle_squared / 120 * (1 - angle_squared / 42), (1 - a) / safe)
    omega = delay[:, None] * rate
    shift = delay[:, None] * velocity
    crossed = jnp.cross(omega, points)
    rotated = points + a[:, None] * crossed + b[:, None] * jnp.cross(omega, crossed)
    swept = jnp.cross(omega, shift)
    return rotated + shift + b[:, None] * swept + c[:, None] * jnp.cross(omega, swept)
