"""Innovation statistics by k x k algebra, at a cost that does not depend on the number of residuals.

Let A = C C' be the measurement's information on a k-dimensional quantity with prior covariance W. All
statistics follow from the k x k matrix I + C'WC, the covariance of the innovation in units of the
measurement's own noise.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32


class Innovation(eqx.Module):
    """The innovation of a measurement in the directions that it observes."""

    whitened: Float[Array, " k"]
    """Innovation along the principal directions in units of the measurement's noise; zero if unobserved."""
    factor: Float[Array, "k k"]
    """Lower Cholesky factor of the covariance of ``whitened``."""
    nis: Float[Array, ""]
    """Normalised innovation squared: chi-square of ``dof`` degrees of freedom for a consistent filter."""
    dof: Int32[Array, ""]
    """Number of observed directions: the rank of the measurement's information."""
    log_det: Float[Array, ""]
    """Log-determinant of the innovation's covariance in the observed directions, in the quantity's units."""

    def log_likelihood(self) -> Float[Array, ""]:
        """Return the log-density of the innovation, for a measurement of ``dof`` dimensions."""
        return -0.5 * (self.nis + self.log_det + self.dof * jnp.log(2 * jnp.pi))

    def solve(self, right: Float[Array, "k n"]) -> Float[Array, "k n"]:
        """Return the inverse covariance of ``whitened`` times ``right``.

        The factor is inverted, which is accurate here, because the covariance is at least the identity. A
        solve for the many columns of a batch of tangents would use the linear algebra library's threads, and
        waking them takes longer than the solve.
        """
        k = self.factor.shape[0]
        inverse = jax.scipy.linalg.solve_triangular(self.factor, jnp.eye(k, dtype=right.dtype), lower=True)
        return inverse.T @ (inverse @ right)


def square_root_information(
    information: Float[Array, "k k"], gradient: Float[Array, " k"]
) -> tuple[Float[Array, "k k"], Float[Array, " k"], Float[Array, " k"]]:
    """Return C with C C' = information, u with C u = gradient, and the eigenvalues, zero where unobserved.

    Eigenvalues below the rounding error of the largest one, and negative ones, count as zero. The gradient's
    part along their directions is dropped.

    Args:
        information: symmetric matrix.
        gradient: gradient of half the squared error in the same coordinates.
    """
    root, residual, values, _ = _square_root(information, gradient)
    return root, residual, values


@jax.custom_jvp
def _square_root(information: Array, gradient: Array) -> tuple[Array, Array, Array, Array]:
    """Return C, u, the eigenvalues and the eigenvectors."""
    values, vectors = jnp.linalg.eigh(information)
    limits = jnp.finfo(values.dtype)
    smallest = jnp.maximum(values.shape[0] * limits.eps * values[-1], limits.tiny)
    values = jnp.where(values > smallest, values, 0.0)
    root = jnp.sqrt(values)
    along = vectors.T @ gradient
    return vectors * root, jnp.where(root > 0, along / jnp.where(root > 0, root, 1.0), 0.0), values, vectors


@_square_root.defjvp
def _square_root_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """Differentiate the root up to a rotation C -> CQ, on which no statistic of the innovation depends.

    The derivative of the eigenvectors, which is infinite for equal eigenvalues, is not needed. With the
    pseudoinverse C+ and the projector N on the unobserved directions, dC = (CC+/2 + N) dA C+' satisfies
    dA = dC C' + C dC' for every dA that keeps the rank.
    """
    values = _square_root(*primals)
    _, residual, eigenvalues, vectors = values
    observed = eigenvalues > 0
    inverse = jnp.where(observed, 1 / jnp.sqrt(jnp.where(observed, eigenvalues, 1.0)), 0.0)
    pseudoinverse = inverse[:, None] * vectors.T
    share = vectors * jnp.where(observed, 0.5, 1.0)
    information_dot, gradient_dot = tangents
    along = vectors.T @ information_dot
    root_dot = share @ (along @ pseudoinverse.T)
    residual_dot = pseudoinverse @ (gradient_dot - root_dot @ residual)
    eigenvalues_dot = jnp.where(observed, jnp.sum(along * vectors.T, 1), 0.0)
    return values, (root_dot, residual_dot, eigenvalues_dot, jnp.zeros_like(vectors))


def innovation_of(
    covariance: Float[Array, "k k"], whitened: Float[Array, " k"], eigenvalues: Float[Array, " k"]
) -> Innovation:
    """Return the statistics of a whitened innovation.

    Args:
        covariance: C'WC, the prior's share of the covariance of ``whitened``.
        whitened: innovation in units of the measurement's noise.
        eigenvalues: of the measurement's information, zero along unobserved directions.
    """
    observed = eigenvalues > 0
    total = (covariance + covariance.T) / 2 + jnp.eye(whitened.shape[0], dtype=whitened.dtype)
    factor = jnp.linalg.cholesky(total, symmetrize_input=False)
    scaled = jax.scipy.linalg.solve_triangular(factor, whitened, lower=True)
    noise = jnp.sum(jnp.where(observed, jnp.log(jnp.where(observed, eigenvalues, 1.0)), 0.0))
    return Innovation(
        whitened=whitened,
        factor=factor,
        nis=jnp.sum(scaled**2),
        dof=jnp.sum(observed).astype(jnp.int32),
        log_det=2 * jnp.sum(jnp.log(jnp.diagonal(factor))) - noise,
    )
