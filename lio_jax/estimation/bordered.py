"""Block-tridiagonal systems with a border: a chain of states, and a few unknowns that all of them share.

The border is eliminated by its Schur complement after the chain (Golub & Van Loan, "Matrix computations",
2013, section 3.2.6), so that the cost stays linear in the number of states.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.core.implicit import with_derivative_of
from lio_jax.estimation.block_tridiagonal import BlockTridiagonal, Factored, factorise, inverse_blocks, solve


class Bordered(eqx.Module):
    """The symmetric matrix of n states of d unknowns, and of q common unknowns."""

    chain: BlockTridiagonal
    """Blocks of the states."""
    border: Float[Array, "n d q"]
    """Blocks between each state and the common unknowns."""
    corner: Float[Array, "q q"]
    """Block of the common unknowns."""


class FactoredBordered(eqx.Module):
    """What solves a bordered system."""

    chain: Factored
    """Factor of the states' matrix."""
    carried: Float[Array, "n d q"]
    """Inverse of the states' matrix times the border."""
    corner: Float[Array, "q q"]
    """Lower Cholesky factor of the Schur complement of the common unknowns, with unit diagonal before it."""
    scale: Float[Array, " q"]
    """Factors of rows and columns that make the diagonal of the Schur complement one."""


def factorise_bordered(matrix: Bordered) -> FactoredBordered:
    """Return the factor; it is NaN where the matrix is not positive definite."""
    chain = factorise(matrix.chain)
    carried = solve(chain, matrix.border)
    left = matrix.corner - jnp.einsum("ndq,ndp->qp", matrix.border, carried)
    scale = 1 / jnp.sqrt(jnp.diagonal(left))
    return FactoredBordered(chain, carried, jnp.linalg.cholesky(scale[:, None] * left * scale), scale)


def solve_bordered(
    factor: FactoredBordered, right: Float[Array, "n d"], common: Float[Array, " q"]
) -> tuple[Float[Array, "n d"], Float[Array, " q"]]:
    """Return the inverse of the matrix times a right side, of the states and of the common unknowns."""
    rest = common - jnp.einsum("ndq,nd->q", factor.carried, right)
    shared = factor.scale * jax.scipy.linalg.cho_solve((factor.corner, True), factor.scale * rest)
    return solve(factor.chain, right) - factor.carried @ shared, shared


def inverse_bordered(factor: FactoredBordered) -> Bordered:
    """Return the blocks of the inverse where the matrix has blocks; its other blocks are not zero either."""
    own = inverse_blocks(factor.chain)
    identity = jnp.diag(factor.scale)
    root = jax.scipy.linalg.solve_triangular(factor.corner, identity, lower=True)
    corner = root.T @ root
    half = factor.carried @ root.T
    diagonal = own.diagonal + half @ jnp.swapaxes(half, 1, 2)
    coupling = own.coupling + half[1:] @ jnp.swapaxes(half[:-1], 1, 2)
    return Bordered(BlockTridiagonal(diagonal, coupling), -factor.carried @ corner, corner)


def log_determinant_bordered(matrix: Bordered) -> Float[Array, ""]:
    """Return the log-determinant of a positive definite matrix; only its first derivative is correct."""
    held = jax.lax.stop_gradient(matrix)
    factor = factorise_bordered(held)
    roots = jnp.diagonal(factor.chain.diagonal, axis1=1, axis2=2)
    corner = jnp.diagonal(factor.corner) / factor.scale
    value = 2 * jnp.sum(jnp.log(roots)) + 2 * jnp.sum(jnp.log(corner))
    return with_derivative_of(value, _trace_of_product, matrix, inverse_bordered(factor))


def _trace_of_product(left: Bordered, right: Bordered) -> Float[Array, ""]:
    chain = jnp.sum(left.chain.diagonal * right.chain.diagonal)
    across = jnp.sum(left.chain.coupling * right.chain.coupling) + jnp.sum(left.border * right.border)
    return chain + 2 * across + jnp.sum(left.corner * right.corner)
