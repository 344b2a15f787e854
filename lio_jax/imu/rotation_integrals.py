"""Integrals of a rotation at constant rate, for large batches, with finite derivatives at zero."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.core.geometry import skew

SERIES_LIMIT = 40.0
"""Square of the angle, rad^2, up to which the power series has float32's precision."""
_SERIES_BELOW = 4.0
"""Square of the angle, rad^2, up to which the power series has float64's precision."""
_TERMS = 12
_FACTORIALS = np.array([math.factorial(n) for n in range(2 * _TERMS + 5)], float)


@jax.jit
def rotation_coefficients(angle_squared: Float[Array, "*b"]) -> Float[Array, "*b 6"]:
    """Return s_n, the sum over k of (-t^2)^k / (2k+n)!, for n from 1 to 6.

    The first four are a = sin(t)/t, b = (1-cos(t))/t^2, c = (t-sin(t))/t^3 and d = (t^2/2-1+cos(t))/t^4.

    With them, for phi = t * axis and X the cross product with phi: Exp(phi) = I + a X + b X^2, its integral
    over the unit interval I + b X + c X^2, and the integral of that I/2 + c X + d X^2. The derivative of
    s_n by t^2 is (n s_(n+2) - s_(n+1)) / 2.

    Args:
        angle_squared: t^2, rad^2.
    """
    square = angle_squared[..., None]
    small = square < _SERIES_BELOW
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    ab = jnp.concatenate([jnp.sin(angle) / angle, (1 - jnp.cos(angle)) / safe], -1)
    # s_(n+2) = (1/n! - s_n) / t^2
    cd = (np.array([1, 1 / 2], ab.dtype) - ab) / safe
    ef = (np.array([1 / 6, 1 / 24], ab.dtype) - cd) / safe
    exact = jnp.concatenate([ab, cd, ef], -1)
    return jnp.where(small, _series(jnp.where(small, square, 0.0), np.arange(1, 7)), exact)


def rotation_series(angle_squared: Float[Array, " n"]) -> Float[Array, "4 n"]:
    """Return the first four of :func:`rotation_coefficients` by their series, which is cheap in batches.

    Args:
        angle_squared: rad^2, at most ``SERIES_LIMIT``.
    """
    return _series(angle_squared, np.arange(1, 5)[:, None])


def _series(x: Float[Array, "*b"], order: NDArray[np.intp]) -> Array:
    """Return the sums over k of (-x)^k / (2 k + order)!."""
    total: Array = jnp.zeros((), x.dtype)
    for k in reversed(range(_TERMS)):
        total = -x * total + np.asarray(1 / _FACTORIALS[2 * k + order], x.dtype)
    return total


def rotation_exponential(rotvec: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Return the rotation matrix Exp(rotvec) of a rotation vector, rad, from the terms of the integrals."""
    a, b, *_ = _coefficients(rotvec)
    cross = skew(rotvec)
    return jnp.eye(3, dtype=rotvec.dtype) + a * cross + b * (cross @ cross)


def rotation_integrals(rotvec: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b 3 3"]]:
    """Return the first and second integral of Exp(s rotvec) over s from 0 to 1.

    The first is the left Jacobian of SO(3). A body that turns by ``rotvec`` in h seconds under a constant
    specific force f gains the velocity h * first @ f and the way h^2 * second @ f, in its frame at the start
    (Bloesch et al., "State estimation for legged robots", RSS 2012).

    Args:
        rotvec: rad.
    """
    _, b, c, d, _, _ = _coefficients(rotvec)
    cross = skew(rotvec)
    square = cross @ cross
    identity = jnp.eye(3, dtype=rotvec.dtype)
    return identity + b * cross + c * square, identity / 2 + c * cross + d * square


def integral_derivatives(
    rotvec: Float[Array, "*b 3"], vector: Float[Array, "*b 3"]
) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b 3 3"]]:
    """Return the derivatives of ``first @ vector`` and ``second @ vector`` with respect to ``rotvec``.

    Args:
        rotvec: rad.
        vector: multiplied by both :func:`rotation_integrals` of ``rotvec``.
    """
    _, b, c, d, e, f = _coefficients(rotvec)
    cross = skew(rotvec)
    once = (cross @ vector[..., None])[..., 0]
    twice = (cross @ once[..., None])[..., 0]
    row, column = rotvec[..., None, :], vector[..., None]
    of_once = -skew(vector)
    inner = jnp.sum(rotvec * vector, -1)[..., None, None] * jnp.eye(3, dtype=rotvec.dtype)
    of_twice = inner + rotvec[..., None] * vector[..., None, :] - 2 * column * row
    once, twice = once[..., None] * row, twice[..., None] * row
    first = b * of_once + (2 * d - c) * once + c * of_twice + (3 * e - d) * twice
    second = c * of_once + (3 * e - d) * once + d * of_twice + (4 * f - e) * twice
    return first, second


def _coefficients(rotvec: Float[Array, "*b 3"]) -> list[Float[Array, "*b 1 1"]]:
    values = rotation_coefficients(jnp.sum(rotvec**2, -1))[..., None, None]
    return [values[..., n, :, :] for n in range(6)]
