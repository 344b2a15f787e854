"""The marginal likelihood of a chain's measurements: their density with all states integrated out."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.estimation.block_tridiagonal import log_determinant
from lio_jax.estimation.chain import Chain
from lio_jax.estimation.imu_factor import imu_information
from lio_jax.estimation.innovation import square_root_information
from lio_jax.estimation.marginal_prior import LOG_2PI
from lio_jax.estimation.motion_state import DOF
from lio_jax.estimation.smoother import Smoothed


def log_evidence(chain: Chain, smoothed: Smoothed) -> Float[Array, ""]:
    """Return the log marginal likelihood of all measurements, by Laplace's approximation.

    ``log p(z) = log p(z, x) + DOF n / 2 log(2 pi) - log|H| / 2`` at the most probable states x, with the
    Gauss-Newton Hessian H (MacKay, "Information theory, inference, and learning algorithms", 2003, chapter
    27). It is exact for a linear Gaussian model. A robust kernel changes the cost and the Hessian, but not
    the normalisation of a measurement's density: an outlier keeps a cost, but does not dominate. The
    derivative is that of the solution and of the log-determinant; no iteration is differentiated.

    Args:
        chain: the measurements.
        smoothed: the most probable states of the chain.
    """
    matrix = smoothed.normal.matrix
    volume = DOF * chain.count / 2 * LOG_2PI - log_determinant(matrix) / 2
    return log_scale(chain) - smoothed.normal.cost + volume


def log_scale(chain: Chain) -> Float[Array, ""]:
    """Return the log-density of all measurements and of the prior if every residual were zero."""
    present = chain.present()
    linked = jnp.concatenate([present[1:], jnp.zeros(1, bool)])
    of_links = jax.vmap(imu_information)(chain.imu.covariance)[1]
    total = chain.prior.log_scale + _sum(of_links - DOF * LOG_2PI, linked)
    total += _sum(_of_information(chain.lidar.information), present & chain.lidar.mask)
    if chain.relative is not None:
        total += _sum(_of_information(chain.relative.information), linked & chain.relative.mask)
    if chain.gps is not None:
        of_axes = -2 * jnp.log(chain.gps.sigma) - LOG_2PI
        total += _sum(jnp.sum(of_axes, axis=-1), present & chain.gps.mask)
    return total


def _sum(twice: Float[Array, " n"], there: Array) -> Float[Array, ""]:
    return jnp.sum(jnp.where(there, twice, 0.0)) / 2


def _of_information(information: Float[Array, "n d d"]) -> Float[Array, " n"]:
    """Return log|A| - d log(2 pi) over the d directions of each matrix that have information."""
    nothing = jnp.zeros(information.shape[:-1], information.dtype)
    values = jax.vmap(square_root_information)(information, nothing)[2]
    there = values > 0
    return jnp.sum(jnp.where(there, jnp.log(jnp.where(there, values, 1.0)) - LOG_2PI, 0.0), axis=-1)
