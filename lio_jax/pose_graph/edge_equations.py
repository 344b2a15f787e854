"""Symmetric linear systems of a pose graph, given as sums over its edges, within a compiled program.

The program calls the host, once for a batch of systems and any number of right-hand sides. Small systems are
solved as dense matrices there, larger ones by the sparse factorisation. LAPACK within the program would do
for small systems, but not on a busy machine: its threads then wait for each other, tens of times as
long as they work.
"""

from functools import lru_cache
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import lapack

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
        shape = jax.ShapeDtypeStruct(right.shape, right.dtype)
        return jax.pure_callback(_solved_on_host, shape, *self, right, vmap_method="expand_dims")


def _solved_on_host(*arrays: ArrayLike) -> NDArray:
    """Solve a batch of systems; axes along which only the last array varies are right-hand sides of one.

    Args:
        arrays: the fields of :class:`EdgeEquations`, then the right-hand sides, all with the axes of the
            batch first; an axis along which an array does not vary has size 1.
    """
    *system, right = (np.asarray(each) for each in arrays)
    axes = [each.shape[: each.ndim - own] for each, own in zip(system, (1, 1, 1, 3, 2), strict=True)]
    batch = np.broadcast_shapes(*axes)
    own = right.shape[-2:]
    right = np.broadcast_to(right, (*np.broadcast_shapes(batch, right.shape[:-2]), *own))
    solution = np.empty_like(right)
    with one_thread():
        for index in np.ndindex(batch):
            i, j, held, blocks, diagonal = (
                each[tuple(number if size > 1 else 0 for number, size in zip(index, axes_of, strict=True))]
                for each, axes_of in zip(system, axes, strict=True)
            )
            some = tuple(
                number if size > 1 else slice(None) for number, size in zip(index, batch, strict=True)
            )
            columns = right[some]
            solved = _solved_columns(i, j, held, blocks, diagonal, columns.reshape(-1, *own))
            solution[some] = solved.reshape(columns.shape)
    return solution


def _solved_columns(
    i: NDArray, j: NDArray, held: NDArray, blocks: NDArray, diagonal: NDArray, right: NDArray
) -> NDArray:
    """Return the (k, n, d) solutions of one system."""
    columns = right.reshape(len(right), -1).T.astype(np.float64)
    if len(columns) <= MOST_DENSE_ROWS:
        _, solved, failed = lapack.dposv(_dense(i, j, held, blocks, diagonal), columns, lower=True)
        return np.full_like(right, np.nan) if failed else solved.T.reshape(right.shape)
    size = diagonal.shape[-1]
    structure = structure_holding(i, j, held, size)
    solution = right.copy()
    if structure.count:
        of_vertices, of_pairs = blocks_of(structure, blocks)
        of_vertices[:, np.arange(size), np.arange(size)] += diagonal[~held]
        unknown = columns.reshape(len(held), size, -1)[~held]
        try:
            solved = solve(factorise(structure.plan, of_vertices, of_pairs), unknown)
        except NotPositiveDefiniteError:
            solved = np.full_like(unknown, np.nan)
        solution[:, ~held] = solved.transpose(2, 0, 1)
    return solution


def _dense(i: NDArray, j: NDArray, held: NDArray, blocks: NDArray, diagonal: NDArray) -> NDArray[np.float64]:
    count, size = diagonal.shape
    H = np.zeros((count, size, count, size))
    ends = np.stack([i, j], -1)
    parts = blocks.reshape(-1, 2, size, 2, size).transpose(0, 1, 3, 2, 4)
    np.add.at(H.transpose(0, 2, 1, 3), (ends[:, :, None], ends[:, None, :]), parts)
    H[held] = 0
    H[:, :, held] = 0
    added = np.diag(np.where(held[:, None], 1.0, diagonal).ravel())
    return H.reshape(added.shape) + added


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


def structure_holding(i: NDArray, j: NDArray, held: NDArray[np.bool_], tangent_size: int) -> Structure:
    """Return the structure of a graph whose held vertices are known; those of the last graphs are kept.

    Args:
        i: (e,) first vertex of each edge.
        j: (e,) second vertex of each edge.
        held: (n,) True for vertices that keep their pose.
        tangent_size: 6 in space, 3 in the plane.
    """
    first, second = (vertex.astype(np.int64).tobytes() for vertex in (i, j))
    return _structure(first, second, held.tobytes(), tangent_size)


@lru_cache(maxsize=16)
def _structure(i: bytes, j: bytes, held: bytes, tangent_size: int) -> Structure:
    """Return the structure; the order of elimination, which it finds once, is kept with it."""
    first, second = np.frombuffer(i, np.int64), np.frombuffer(j, np.int64)
    still = np.frombuffer(held, bool)
    part = parts_of(len(still), first, second)
    used = np.ones(len(first), bool)
    return Structure(first, second, np.zeros_like(first), used, part, still, tangent_size)
