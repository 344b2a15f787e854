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
    """A log-density of an error e from an origin: log_scale - e' information e / 2 - gradient' e.

    The error is that of a state, and of the tilt of gravity where its direction is unknown (q is then 2, else
    0; see :func:`lio_jax.estimation.factors.tilted`).
    """

    origin: MotionState
    """The state to which the error refers."""
    tilt: Float[Array, " q"]
    """The tilt of gravity to which the error refers, rad."""
    information: Float[Array, "p p"]
    """Information on the error, p = 15 + q."""
    gradient: Float[Array, " p"]
    """Gradient of the negative log-density at the origin."""
    log_scale: Float[Array, ""]
    """Log-density at the origin. After marginalisation it includes the log-likelihood of the measurements of
    the states that were marginalised."""

    def quadratic(self, state: MotionState, tilt: Float[Array, " q"]) -> Quadratic:
        """Return the cost as a function of the errors of a state and of the tilt, without ``log_scale``."""
        error = jnp.concatenate([self.origin.local(state), tilt - self.tilt])
        jacobian = jax.scipy.linalg.block_diag(
            local_jacobian(self.origin, state), jnp.eye(len(tilt), dtype=error.dtype)
        )
        slope = self.information @ error
        return Quadratic(
            cost=jnp.dot(error, slope / 2 + self.gradient),
            gradient=jacobian.T @ (slope + self.gradient),
            hessian=jacobian.T @ self.information @ jacobian,
            weight=jnp.ones((), error.dtype),
        )


def gaussian_prior(mean: MotionState, covariance: Float[Array, "p p"]) -> Prior:
    """Return the prior of a state with a Gaussian error, and of the tilt of gravity, whose mean is zero.

    Args:
        mean: mean of the state.
        covariance: covariance of the state's error, positive definite; with 17 rows, the last two of which
            are those of the tilt, gravity's direction is unknown.
    """
    # scaled to unit variances: the variance of a velocity may be 1e14 times that of a bias
    scale = 1 / jnp.sqrt(jnp.diagonal(covariance))
    lower = jnp.linalg.cholesky(scale[:, None] * covariance * scale)
    root = jax.scipy.linalg.solve_triangular(lower, jnp.diag(scale), lower=True)
    log_det = jnp.sum(jnp.log(jnp.diagonal(root)))
    log_scale = log_det - len(scale) / 2 * LOG_2PI
    tilt = jnp.zeros(len(scale) - DOF, scale.dtype)
    return Prior(mean, tilt, root.T @ root, jnp.zeros_like(scale), log_scale)


def marginalised(
    joint: Quadratic, log_scale: Float[Array, ""], following: MotionState, tilt: Float[Array, " q"]
) -> Prior:
    """Return the marginal density of the second of two states, and of the tilt, by their joint density.

    It follows from the Schur complement of the first state's block (Sibley et al., "Sliding window filter
    with application to planetary landing", JFR 2010).

    Args:
        joint: cost over the 30 + q entries of the errors of the first and the second state and of the tilt.
        log_scale: log-density where the cost is zero.
        following: the second state, at which ``joint`` was linearised.
        tilt: of gravity, at which ``joint`` was linearised, rad; q is 0 where the direction is known.
    """
    own, across, kept = joint.hessian[:DOF, :DOF], joint.hessian[:DOF, DOF:], joint.hessian[DOF:, DOF:]
    lower = jnp.linalg.cholesky((own + own.T) / 2)
    right = jnp.concatenate([across, joint.gradient[:DOF, None]], axis=1)
    scaled = jax.scipy.linalg.solve_triangular(lower, right, lower=True)
    spread, pull = scaled[:, :-1], scaled[:, -1]
    information = kept - spread.T @ spread
    volume = DOF / 2 * LOG_2PI - jnp.sum(jnp.log(jnp.diagonal(lower)))
    return Prior(
        origin=following,
        tilt=tilt,
        information=(information + information.T) / 2,
        gradient=joint.gradient[DOF:] - spread.T @ pull,
        log_scale=log_scale + volume - joint.cost + jnp.dot(pull, pull) / 2,
    )
