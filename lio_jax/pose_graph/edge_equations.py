"""Symmetric linear systems of a pose graph, given as sums over its edges, within a compiled program.

Small systems are solved as dense matrices. For larger ones the program calls the sparse factorisation on the
host. A batch of systems, and any number of right-hand sides, are one call.
"""

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike, NDArray

from lio_jax.pose_graph.block_cholesky import factorise, solve
from lio_jax.pose_graph.multifrontal import NotPositiveDefiniteError, one_thread
from lio_jax.pose_graph.structure import Structure, parts_of

MOST_DENSE_ROWS = 144
"""Largest number of rows of a system that is solved as a dense matrix."""


class EdgeEquations(NamedTuple):
    """The matrix of a system: blocks that edges add, and a diagonal.

    The rows and columns of held vertices are those of the identity.
    """

    i: Int[Array, " e"]
    """First vertex of each edge."""
    j: Int[Array, " e"]
    """Second vertex of each edge."""
    held: Bool[Array, " n"]
    """True for vertices that are not unknown."""
    blocks: Float[Array, "e h h"]
    """What each edge adds: the d rows and columns of its first vertex, then those of its second one."""
    diagonal: Float[Array, "n d"]
    """What is added to the diagonal."""

    def solved(self, right: Float[Array, "n d"]) -> Float[Array, "n d"]:
        """Return the solution x of H x = right; NaN where H is not positive definite.

        Args:
            right: right-hand side; the solution has the same values for held vertices.
        """
        if right.size <= MOST_DENSE_ROWS:
            solution = cho_solve(cho_factor(self._dense()), right.ravel().astype(float)).reshape(right.shape)
            return solution.astype(right.dtype)
        shape = jax.ShapeDtypeStruct(right.shape, right.dtype)
        return jax.pure_callback(_solved_on_host, shape, *self, right, vmap_method="expand_dims")

    def _dense(self) -> Float[Array, "r r"]:
        count, size = self.diagonal.shape
        blocks = self.blocks.reshape(-1, 2, size, 2, size).transpose(0, 1, 3, 2, 4).astype(float)
        vertices = jnp.stack([self.i, self.j], -1)
        H = jnp.zeros((count, count, size, size), blocks.dtype)
        H = H.at[vertices[:, :, None], vertices[:, None, :]].add(blocks)
        free = ~self.held
        H = jnp.where((free[:, None] & free)[:, :, None, None], H, 0.0)
        H = H.transpose(0, 2, 1, 3).reshape(count * size, count * size)
        return H + jnp.diag(jnp.where(self.held[:, None], 1.0, self.diagonal).ravel())


def _solved_on_host(
    i: ArrayLike, j: ArrayLike, held: ArrayLike, blocks: ArrayLike, diagonal: ArrayLike, right: ArrayLike
) -> NDArray:
    """Solve a batch of systems; axes along which only ``right`` varies are right-hand sides of one system."""
    system = [np.asarray(each) for each in (i, j, held, blocks, diagonal)]
    axes = [each.shape[: each.ndim - own] for each, own in zip(system, (1, 1, 1, 3, 2), strict=True)]
    batch = np.broadcast_shapes(*axes)
    right = np.asarray(right)
    own = right.shape[-2:]
    right = np.broadcast_to(right, (*np.broadcast_shapes(batch, right.shape[:-2]), *own))
    solution = np.empty_like(right)
    with one_thread():
        for index in np.ndindex(batch):
            picked = [
                each[tuple(number if size > 1 else 0 for number, size in zip(index, axes_of, strict=True))]
                for each, axes_of in zip(system, axes, strict=True)
            ]
            some = tuple(
                number if size > 1 else slice(None) for number, size in zip(index, batch, strict=True)
            )
            columns = right[some]
            solution[some] = _solved_columns(*picked, columns.reshape(-1, *own)).reshape(columns.shape)
    return solution


def _solved_columns(
    i: NDArray, j: NDArray, held: NDArray, blocks: NDArray, diagonal: NDArray, right: NDArray
) -> NDArray:
    """Return the (k, n, d) solutions of one system."""
    edges = (vertex.astype(np.int64).tobytes() for vertex in (i, j))
    structure = _structure(*edges, held.tobytes(), diagonal.shape[-1])
    solution = right.copy()
    if structure.count:
        of_vertices, of_pairs = blocks_of(structure, blocks)
        rows = np.arange(diagonal.shape[-1])
        of_vertices[:, rows, rows] += diagonal[~held]
        columns = right[:, ~held].transpose(1, 2, 0).astype(np.float64)
        try:
            solved = solve(factorise(structure.plan, of_vertices, of_pairs), columns)
        except NotPositiveDefiniteError:
            solved = np.full_like(columns, np.nan)
        solution[:, ~held] = solved.transpose(2, 0, 1)
    return solution


def blocks_of(
    structure: Structure, blocks: NDArray[np.floating]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a matrix's blocks on the diagonal, and those of the pairs.

    Args:
        structure: structure of the graph.
        blocks: (e, 2 d, 2 d) blocks that each edge adds, as in :class:`EdgeEquations`.
    """
    size = structure.tangent_size
    i, j = structure.unknown[structure.i], structure.unknown[structure.j]
    H_ij = blocks[:, :size, size:]
    diagonal = np.zeros((structure.count + 1, size, size))
    np.add.at(diagonal, i, blocks[:, :size, :size])
    np.add.at(diagonal, j, blocks[:, size:, size:])
    pairs = np.zeros((len(structure.pairs) + 1, size, size))
    np.add.at(pairs, structure.pair_of, np.where((i < j)[:, None, None], H_ij.transpose(0, 2, 1), H_ij))
    return diagonal[:-1], pairs[:-1]


@lru_cache(maxsize=16)
def _structure(i: bytes, j: bytes, held: bytes, tangent_size: int) -> Structure:
    """Return the structure of a graph whose held vertices are known; the order of elimination is kept."""
    first, second = np.frombuffer(i, np.int64), np.frombuffer(j, np.int64)
    still = np.frombuffer(held, bool)
    part = parts_of(len(still), first, second)
    used = np.ones(len(first), bool)
    return Structure(first, second, np.zeros_like(first), used, part, still, tangent_size)
