"""The log-determinant of a pose graph's Hessian, with its derivative by the selected inverse."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import solve_triangular

from lio_jax.pose_graph import multifrontal
from lio_jax.pose_graph.block_cholesky import ChainFactor, factorise
from lio_jax.pose_graph.edge_equations import blocks_of, structure_holding
from lio_jax.pose_graph.factors import linearise
from lio_jax.pose_graph.graph import PoseGraph, Poses
from lio_jax.pose_graph.multifrontal import NotPositiveDefiniteError, one_thread
from lio_jax.pose_graph.structure import Structure, structure_of

_Array = NDArray[np.float64]
_Edges = tuple[Int[Array, " e"], Int[Array, " e"], Bool[Array, " n"]]
"""First and second vertex of each edge; True for vertices that keep their pose."""


def log_determinant(poses: Poses, graph: PoseGraph) -> Float[Array, ""]:
    """Return log det H of the Gauss-Newton Hessian of the cost by the free vertices, with its derivative.

    The derivative is trace(H^-1 dH). The blocks of dH are those of H, so it needs the blocks of H^-1 at the
    edges only (:func:`inverse_blocks`). It has forward and reverse mode, but no second derivative. The
    sparse factorisation on the host costs as much as one step of a solve.

    Call it outside ``jit``, because the host finds the vertices that keep their pose.

    Args:
        poses: (n,) T_world_vertex at which to linearise, m.
        graph: vertices and edges.

    Returns:
        The logarithm, for perturbations in rad and m; NaN where H is not positive definite.
    """
    held = jax.device_put(structure_of(graph).held)
    return _log_determinant((graph.i, graph.j, held), _edge_blocks(poses, graph))


@jax.jit
def _edge_blocks(poses: Poses, graph: PoseGraph) -> Float[Array, "e h h"]:
    """Return each edge's part of H by the steps of its first and second vertex."""
    return linearise(poses, graph).blocks()


@jax.custom_jvp
def _log_determinant(edges: _Edges, blocks: Float[Array, "e h h"]) -> Float[Array, ""]:
    return _with_inverse(edges, blocks)[0]


@_log_determinant.defjvp
def _log_determinant_jvp(
    primals: tuple[_Edges, Array], tangents: tuple[_Edges, Array]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    value, inverse = _with_inverse(*primals)
    return value, jnp.sum(inverse * tangents[1])


def _with_inverse(
    edges: _Edges, blocks: Float[Array, "e h h"]
) -> tuple[Float[Array, ""], Float[Array, "e h h"]]:
    """Return log det H, and the rows and columns of H^-1 of each edge's two vertices."""
    shapes = jax.ShapeDtypeStruct((), blocks.dtype), jax.ShapeDtypeStruct(blocks.shape, blocks.dtype)
    return jax.pure_callback(_on_host, shapes, *edges, blocks, vmap_method="sequential")


def _on_host(i: ArrayLike, j: ArrayLike, held: ArrayLike, blocks: ArrayLike) -> tuple[NDArray, NDArray]:
    edges, dtype = np.asarray(blocks, np.float64), np.asarray(blocks).dtype
    size = edges.shape[-1] // 2
    structure = structure_holding(np.asarray(i), np.asarray(j), np.asarray(held), size)
    if not structure.count:
        return np.zeros((), dtype), np.zeros(edges.shape, dtype)
    try:
        with one_thread():
            factor = factorise(structure.plan, *blocks_of(structure, edges))
            inverse = inverse_at_edges(structure, factor)
    except NotPositiveDefiniteError:
        return np.full((), np.nan, dtype), np.full(edges.shape, np.nan, dtype)
    return np.asarray(log_determinant_of(factor), dtype), inverse.astype(dtype)


def log_determinant_of(factor: ChainFactor) -> float:
    """Return the log-determinant of a matrix.

    Args:
        factor: Cholesky factor of the matrix.
    """
    diagonals = [np.diagonal(panel) for panel in factor.fronts.panels]
    # the levels hold the inverse of the factor's own blocks
    diagonals += [1 / np.diagonal(level.root, axis1=1, axis2=2) for level in factor.levels]
    return 2 * sum(float(np.sum(np.log(diagonal))) for diagonal in diagonals)


def inverse_at_edges(structure: Structure, factor: ChainFactor) -> _Array:
    """Return the rows and columns of a Hessian's inverse of each edge's two vertices, (e, 2 d, 2 d).

    Args:
        structure: structure of the graph.
        factor: Cholesky factor of the Hessian of its used edges.

    Returns:
        The blocks; zero for held vertices. Those between the vertices of an unused edge are zero, too.
    """
    none = np.zeros((1, structure.tangent_size, structure.tangent_size))
    diagonal, pairs = (np.concatenate([blocks, none]) for blocks in inverse_blocks(factor))
    first, second = structure.unknown[structure.i], structure.unknown[structure.j]
    between = pairs[structure.pair_of]
    between = np.where((first < second)[:, None, None], between.transpose(0, 2, 1), between)
    return np.block([[diagonal[first], between], [between.transpose(0, 2, 1), diagonal[second]]])


def inverse_blocks(factor: ChainFactor) -> tuple[_Array, _Array]:
    """Return the blocks of a matrix's inverse at the matrix's own blocks, (n, d, d) and (m, d, d).

    The recursion goes through the order of elimination from its end (Takahashi, Fagan & Chin, "Formation of a
    sparse bus impedance matrix and its application to short circuit study", 1973). The work is a small
    multiple of that of the factorisation.

    Args:
        factor: Cholesky factor of the matrix.

    Returns:
        Blocks on the diagonal, and those of the pairs, whose rows belong to the greater node.
    """
    reduction, size = factor.plan.order.reduction, factor.plan.size
    left = _inverse_in_fronts(factor.fronts)
    if not reduction.levels:
        return left[: len(reduction.kept)], left[len(reduction.kept) :]
    blocks = (reduction.sums.T @ left.reshape(len(left), -1)).reshape(-1, size, size)
    count = len(reduction.kept) + sum(len(level.nodes) for level in reduction.levels)
    for level, columns in zip(reversed(reduction.levels), reversed(factor.levels), strict=True):
        # a node without a neighbour has a zero column in its place, so any block will do
        neighbours = np.where(level.neighbours < count, level.neighbours, 0)
        a, b = blocks[neighbours].swapaxes(0, 1)
        b_a = blocks[level.couplings[:, 0]]
        around = np.block([[a, b_a.transpose(0, 2, 1)], [b_a, b]])
        towards, own = _eliminated_inverse(columns.root, columns.adjacent, around)
        couplings = towards.reshape(-1, 2, size, size)
        turned = level.neighbours < level.nodes[:, None]
        couplings[turned] = couplings[turned].transpose(0, 2, 1)
        there = level.neighbours < count
        blocks[level.couplings[there]] = couplings[there]
        blocks[level.nodes] = own
    return blocks[:count], blocks[count:-1]


def _inverse_in_fronts(factor: multifrontal.Factor) -> _Array:
    """Return the (n + m, d, d) blocks of the inverse for the graph that the chains leave."""
    plan, size = factor.plan, factor.plan.size
    fronts = plan.tree.fronts
    numbers = np.zeros(plan.offsets[-1])
    inverses: list[_Array] = [np.zeros((0, 0))] * len(fronts)
    for index in reversed(range(len(fronts))):
        front, panel = fronts[index], factor.panels[index]
        width = panel.shape[1]
        around = np.zeros((0, 0))
        if len(front.rows):
            above = fronts[front.parent]
            nodes = np.concatenate([np.arange(above.start, above.stop), above.rows])
            places = (np.searchsorted(nodes, front.rows)[:, None] * size + np.arange(size)).ravel()
            around = inverses[front.parent][np.ix_(places, places)]
        # the factorisation leaves the upper triangle undefined
        root = solve_triangular(np.tril(panel[:width]), np.eye(width), lower=True).T
        towards, own = _eliminated_inverse(root, panel[width:], around)
        inverses[index] = np.block([[own, towards.T], [towards, around]])
        numbers[plan.offsets[index] : plan.offsets[index + 1]] = inverses[index][:, :width].ravel()
    return numbers[plan.places]


def _eliminated_inverse(root: _Array, below: _Array, around: _Array) -> tuple[_Array, _Array]:
    """Return the columns of the inverse for eliminated nodes: the rows of later nodes, and their own.

    Args:
        root: (..., w, w) L^-T of the nodes' own block L of the factor.
        below: (..., r, w) rows of the factor of the later nodes that are coupled to them.
        around: (..., r, r) inverse at these later nodes.
    """
    inverse_root = root.swapaxes(-1, -2)
    gain = below @ inverse_root
    towards = -around @ gain
    return towards, root @ inverse_root - gain.swapaxes(-1, -2) @ towards
