"""Quadratic forms of the smoother, and the marginal prior that stands for states that were forgotten."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.estimation.motion_state import DOF, MotionState, local_jacobian


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


LOG_2PI = 1.8378770664093453


class Prior(eqx.Module):
    """A log-density of a state's error e from an origin: log_scale - e' information e / 2 - gradient' e."""

    origin: MotionState
    """The state to which the error refers."""
    information: Float[Array, "15 15"]
    """Information on the error."""
    gradient: Float[Array, "15"]
    """Gradient of the negative log-density at the origin."""
    log_scale: Float[Array, ""]
    """Log-density at the origin. After marginalisation it includes the log-likelihood of the measurements of
    the states that were marginalised."""

    def quadratic(self, state: MotionState) -> Quadratic:
        """Return the cost as a function of a state's error, without ``log_scale``."""
        error = self.origin.local(state)
        jacobian = local_jacobian(self.origin, state)
        slope = self.information @ error
        return Quadratic(
            cost=jnp.dot(error, slope / 2 + self.gradient),
            gradient=jacobian.T @ (slope + self.gradient),
            hessian=jacobian.T @ self.information @ jacobian,
            weight=jnp.ones((), error.dtype),
        )


def gaussian_prior(mean: MotionState, covariance: Float[Array, "15 15"]) -> Prior:
    """Return the prior of a state with a Gaussian error.

    Args:
        mean: mean of the state.
        covariance: covariance of the state's error, positive definite.
    """
    # scaled to unit variances: the variance of a velocity may be 1e14 times that of a bias
    scale = 1 / jnp.sqrt(jnp.diagonal(covariance))
    lower = jnp.linalg.cholesky(scale[:, None] * covariance * scale)
    root = jax.scipy.linalg.solve_triangular(lower, jnp.diag(scale), lower=True)
    log_det = jnp.sum(jnp.log(jnp.diagonal(root)))
    return Prior(mean, root.T @ root, jnp.zeros_like(scale), log_det - DOF / 2 * LOG_2PI)


def marginalised(joint: Quadratic, log_scale: Float[Array, ""], following: MotionState) -> Prior:
    """Return the marginal density of the second of two states with a joint quadratic density.

    It follows from the Schur complement of the first state's block (Sibley et al., "Sliding window filter
    with application to planetary landing", JFR 2010).

    Args:
        joint: cost over the 30 entries of the errors of the first and the second state.
        log_scale: log-density where the cost is zero.
        following: the second state, at which ``joint`` was linearised.
    """
    own, across, kept = joint.hessian[:DOF, :DOF], joint.hessian[:DOF, DOF:], joint.hessian[DOF:, DOF:]
    lower = jnp.linalg.cholesky((own + own.T) / 2)
    right = jnp.concatenate([across, joint.gradient[:DOF, None]], axis=1)
    scaled = jax.scipy.linalg.solve_triangular(lower, right, lower=True)
    spread, pull = scaled[:, :DOF], scaled[:, DOF]
    information = kept - spread.T @ spread
    volume = DOF / 2 * LOG_2PI - jnp.sum(jnp.log(jnp.diagonal(lower)))
    return Prior(
        origin=following,
        information=(information + information.T) / 2,
        gradient=joint.gradient[DOF:] - spread.T @ pull,
        log_scale=log_scale + volume - joint.cost + jnp.dot(pull, pull) / 2,
    )
