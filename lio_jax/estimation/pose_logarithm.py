"""The logarithm of a pose and its derivative, in closed form and smooth at zero.

Order: rotation (rad), translation (m). See Barfoot, "State estimation for robotics", 2017, section 7.1.
"""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.rotation import rotation_matrix, skew
from lio_jax.imu.rotation_integrals import rotation_coefficients


def inverse_right_jacobian(rotvec: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Return the derivative of log(R Exp(d)) at d = 0, where ``rotvec`` = log(R), rad."""
    cross = skew(rotvec)
    kappa, _ = _kappa(jnp.sum(rotvec**2))
    return jnp.eye(3, dtype=rotvec.dtype) + cross / 2 + kappa * (cross @ cross)


def log_and_jacobian(pose: jaxlie.SE3) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Return log(T), and the derivative of log(T exp(d)) at d = 0.

    The translation's part is the inverse left Jacobian J(w)^-1 = I - W/2 + k W^2 times t, with W the cross
    product with the rotation vector w, so its derivative follows from that of k by the angle's square.
    """
    turn = pose.rotation().log()
    along = pose.translation()
    square = jnp.sum(turn**2)
    kappa, slope = _kappa(square)
    once = jnp.cross(turn, along)
    twice = jnp.cross(turn, once)
    move = along - once / 2 + kappa * twice
    by_twice = jnp.dot(turn, along) * jnp.eye(3, dtype=turn.dtype)
    by_twice += jnp.outer(turn, along) - 2 * jnp.outer(along, turn)
    move_by_turn = skew(along) / 2 + kappa * by_twice + 2 * slope * jnp.outer(twice, turn)
    right = inverse_right_jacobian(turn)
    jacobian = jnp.block([[right, jnp.zeros_like(right)], [move_by_turn @ right, right]])
    return jnp.concatenate([turn, move]), jacobian


def adjoint(pose: jaxlie.SE3) -> Float[Array, "6 6"]:
    """Return Ad with T exp(d) = exp(Ad d) T."""
    matrix = rotation_matrix(pose.rotation())
    return jnp.block([[matrix, jnp.zeros_like(matrix)], [skew(pose.translation()) @ matrix, matrix]])


def _kappa(square: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return (1 - t cot(t/2) / 2) / t^2 and its derivative by t^2, of an angle's square."""
    _, b, c, d, e, f = jnp.moveaxis(rotation_coefficients(square), -1, 0)
    kappa = (c - 2 * d) / (2 * b)
    slope = ((3 * e - d) / 2 - (4 * f - e) - kappa * (2 * d - c)) / (2 * b)
    return kappa, slope
