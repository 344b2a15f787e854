"""What is known about a chain's first state without the chain: a given prior, or a marginalised past."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.estimation.motion_state import DOF, MotionState, local_jacobian
from lio_jax.estimation.quadratic import Quadratic

LOG_2PI = 1.8378770664093453


class Prior(eqx.Module):
    """A log-density of a state's error e from an origin: log_scale - e' information e / 2 - gradient' e."""

    origin: MotionState
    information: Float[Array, "15 15"]
    gradient: Float[Array, "15"]
    log_scale: Float[Array, ""]
    """After marginalisation it holds the log-likelihood of all that the forgotten states explained."""

    def quadratic(self, state: MotionState) -> Quadratic:
        """Return the cost of a state, without ``log_scale``."""
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
        mean: of the state.
        covariance: of its error, positive definite.
    """
    # scaled to unit variances: a velocity's may be 1e14 times as large as a bias's
    scale = 1 / jnp.sqrt(jnp.diagonal(covariance))
    lower = jnp.linalg.cholesky(scale[:, None] * covariance * scale)
    root = jax.scipy.linalg.solve_triangular(lower, jnp.diag(scale), lower=True)
    log_det = jnp.sum(jnp.log(jnp.diagonal(root)))
    return Prior(mean, root.T @ root, jnp.zeros_like(scale), log_det - DOF / 2 * LOG_2PI)


def marginalised(joint: Quadratic, log_scale: Float[Array, ""], following: MotionState) -> Prior:
    """Return what a quadratic density of two states says about the second one alone.

    Schur complement of the first state's block (Sibley et al., "Sliding window filter with application to
    planetary landing", JFR 2010).

    Args:
        joint: over the errors of the first and the second state, 30.
        log_scale: of the density.
        following: the second state, where ``joint`` was linearised.
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
