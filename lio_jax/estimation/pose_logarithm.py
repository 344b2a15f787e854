"""The logarithm of a pose and its derivative, in closed form and smooth at zero.

Tangents are in the order rotation (rad), translation (m). Source: Barfoot, "State estimation for robotics",
2017, section 7.1.
"""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.geometry import skew
from lio_jax.imu.rotation_integrals import rotation_coefficients


def right_jacobian(rotvec: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b 3 3"]]:
    """Return J with Exp(w + dw) = Exp(w) Exp(J dw) at a rotation vector w, rad, and the inverse of J.

    The inverse is the derivative of log(R Exp(d)) at d = 0 for R = Exp(w).
    """
    cross = skew(rotvec)
    square = cross @ cross
    b, c, kappa, _ = _coefficients(rotvec)
    identity = jnp.eye(3, dtype=rotvec.dtype)
    return identity - b * cross + c * square, identity + cross / 2 + kappa * square


def log_and_jacobian(pose: jaxlie.SE3) -> tuple[Float[Array, "*b 6"], Float[Array, "*b 6 6"]]:
    """Return log(T), and the derivative of log(T exp(d)) at d = 0.

    The translation's part of log(T) is J(w)^-1 t with the inverse left Jacobian J(w)^-1 = I - W/2 + k W^2,
    where W is the matrix of the cross product with the rotation vector w. So its derivative follows from that
    of k by the square of the angle.
    """
    turn, along = pose.rotation().log(), pose.translation()
    turning, moving = jnp.moveaxis(skew(jnp.stack([turn, along], axis=-2)), -3, 0)
    *_, kappa, slope = _coefficients(turn)
    square = turning @ turning
    identity = jnp.eye(3, dtype=turn.dtype)
    right = identity + turning / 2 + kappa * square
    left_inverse = jnp.swapaxes(right, -1, -2)
    column, row = along[..., :, None], turn[..., None, :]
    of_square = jnp.sum(turn * along, -1)[..., None, None] * identity
    of_square += turn[..., :, None] * along[..., None, :] - 2 * column * row
    by_turn = moving / 2 + kappa * of_square + 2 * slope * (square @ column) * row
    zero = jnp.zeros_like(right)
    jacobian = jnp.concatenate(
        [
            jnp.concatenate([right, zero], axis=-1),
            jnp.concatenate([by_turn @ right, right], axis=-1),
        ],
        axis=-2,
    )
    return jnp.concatenate([turn, (left_inverse @ column)[..., 0]], axis=-1), jacobian


def _coefficients(rotvec: Float[Array, "*b 3"]) -> list[Float[Array, "*b 1 1"]]:
    """Return (1 - cos t) / t^2, (t - sin t) / t^3, k = (1 - t cot(t/2) / 2) / t^2 and dk / dt^2."""
    values = rotation_coefficients(jnp.sum(rotvec**2, -1))[..., None, None]
    _, b, c, d, e, f = (values[..., n, :, :] for n in range(6))
    kappa = (c - 2 * d) / (2 * b)
    slope = ((3 * e - d) / 2 - (4 * f - e) - kappa * (2 * d - c)) / (2 * b)
    return [b, c, kappa, slope]
