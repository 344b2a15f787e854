"""Weighted residuals as quadratic costs: what every factor contributes to the normal equations."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Quadratic(eqx.Module):
    """A negative log-density about the states it was linearised at: cost + gradient' d + d' hessian d / 2."""

    cost: Float[Array, "*b"]
    gradient: Float[Array, "*b d"]
    hessian: Float[Array, "*b d d"]
    """Gauss-Newton's: positive semidefinite."""
    weight: Float[Array, "*b"]
    """Share of the information that the robust kernel lets through; 0 where there is no measurement."""


def quadratic(
    residual: Float[Array, " m"],
    jacobian: Float[Array, "m d"],
    information: Float[Array, "m m"],
    weight: Float[Array, ""],
) -> Quadratic:
    """Return half the squared norm of a residual with information A: r'Ar / 2, J'Ar, J'AJ, times weight."""
    scaled = information @ residual
    return Quadratic(
        cost=weight * jnp.dot(residual, scaled) / 2,
        gradient=weight * (jacobian.T @ scaled),
        hessian=weight * (jacobian.T @ (information @ jacobian)),
        weight=weight,
    )


def robust_quadratic(
    residual: Float[Array, " m"],
    jacobian: Float[Array, "m d"],
    information: Float[Array, "m m"],
    kernel: Float[Array, ""],
    mask: Array,
) -> Quadratic:
    """Return the same under a Geman-McClure kernel: the cost is s / (1 + s / k^2) / 2 with s = r'A r.

    The weight 1 / (1 + s / k^2)^2 falls with the fourth power of the distance, so an outlier has no pull
    left (Barron, "A general and adaptive robust loss function", CVPR 2019, alpha = -2).

    Args:
        residual: of m dimensions.
        jacobian: of the residual by the states' perturbation.
        information: inverse covariance of the residual.
        kernel: k, in sigmas of the whole residual; infinite for plain least squares.
        mask: False for a measurement that is none.
    """
    square = jnp.dot(residual, information @ residual)
    share = 1 / (1 + square / kernel**2)
    plain = quadratic(residual, jacobian, information, jnp.where(mask, share**2, 0.0))
    return eqx.tree_at(lambda q: q.cost, plain, jnp.where(mask, square * share / 2, 0.0))
