"""Integrals of a rotation at constant rate, for large batches, with finite derivatives at zero."""

import math

import jax.numpy as jnp
from jaxtyping import Array, Float

SERIES_LIMIT = 40.0
"""Square of the angle, rad^2, up to which the power series holds to float32's precision."""
_SERIES_BELOW = 4.0
"""Square of the angle, rad^2, up to which it holds to float64's."""
_TERMS = 12


def rotation_coefficients(angle_squared: Float[Array, "*b"]) -> tuple[Array, Array, Array, Array]:
    """Return a = sin(t)/t, b = (1-cos(t))/t^2, c = (t-sin(t))/t^3 and d = (t^2/2-1+cos(t))/t^4.

    With them, for phi = t * axis and X the cross product with phi: Exp(phi) = I + a X + b X^2, its integral
    over the unit interval I + b X + c X^2, and the integral of that I/2 + c X + d X^2.

    Args:
        angle_squared: t^2, rad^2.
    """
    small = angle_squared < _SERIES_BELOW
    safe = jnp.where(small, 1.0, angle_squared)
    angle = jnp.sqrt(safe)
    sine, versine = jnp.sin(angle), 1 - jnp.cos(angle)
    exact = (
        sine / angle,
        versine / safe,
        (angle - sine) / (safe * angle),
        (safe / 2 - versine) / safe**2,
    )
    series = rotation_series(jnp.where(small, angle_squared, 0.0))
    a, b, c, d = (jnp.where(small, near, far) for near, far in zip(series, exact, strict=True))
    return a, b, c, d


def rotation_series(angle_squared: Float[Array, "*b"]) -> tuple[Array, Array, Array, Array]:
    """Return :func:`rotation_coefficients` up to ``SERIES_LIMIT``, cheaper in large batches.

    Args:
        angle_squared: rad^2.
    """
    a, b, c, d = (_series(angle_squared, order) for order in (1, 2, 3, 4))
    return a, b, c, d


def _series(x: Float[Array, "*b"], order: int) -> Float[Array, "*b"]:
    """Return the sum over k of (-x)^k / (2 k + order)!."""
    total = jnp.zeros_like(x)
    for k in reversed(range(_TERMS)):
        total = 1 / math.factorial(2 * k + order) - x * total
    return total


def rotation_integrals(rotvec: Float[Array, "*b 3"]) -> tuple[Float[Array, "*b 3 3"], Float[Array, "*b 3 3"]]:
    """Return the first and second integral of Exp(s rotvec) over s from 0 to 1.

    The first is the left Jacobian of SO(3); a body that turns by ``rotvec`` in h seconds under a constant
    specific force f gains the velocity h * first @ f and the way h^2 * second @ f, in its frame at the start
    (Bloesch et al., "State estimation for legged robots", RSS 2012).

    Args:
        rotvec: rad.
    """
    _, b, c, d = rotation_coefficients(jnp.sum(rotvec**2, -1))
    cross = skew(rotvec)
    square = cross @ cross
    identity = jnp.eye(3, dtype=rotvec.dtype)
    b, c, d = b[..., None, None], c[..., None, None], d[..., None, None]
    return identity + b * cross + c * square, identity / 2 + c * cross + d * square


def skew(vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3 3"]:
    """Return the matrix whose product with w is ``vector`` x w."""
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    zero = jnp.zeros_like(x)
    return jnp.stack(
        [jnp.stack([zero, -z, y], -1), jnp.stack([z, zero, -x], -1), jnp.stack([-y, x, zero], -1)], -2
    )
