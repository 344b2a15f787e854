"""The fall of a pose graph's cost without one of its edges."""

import jax
import numpy as np
from numpy.typing import NDArray

from lio_jax.pose_graph.block_cholesky import factorise
from lio_jax.pose_graph.edge_equations import blocks_of
from lio_jax.pose_graph.factors import linearise
from lio_jax.pose_graph.graph import PoseGraph, Poses
from lio_jax.pose_graph.log_determinant import inverse_at_edges
from lio_jax.pose_graph.multifrontal import one_thread
from lio_jax.pose_graph.structure import Structure

_Array = NDArray[np.float64]


def falls_without(
    poses: Poses,
    graph: PoseGraph,
    structure: Structure,
    used: NDArray[np.bool_],
    edges: NDArray[np.int64],
) -> _Array:
    """Return by how much the sum of all r' Omega r falls if one edge is left out and the graph solved again.

    For linear residuals it is the squared residual of the edge from the poses that the others determine, in
    standard deviations. The largest one names the worst edge (Baarda, "A testing procedure for use in
    geodetic networks", 1968). With the edge's Hessian B and gradient g, and the blocks C of H^-1 at its two
    vertices, the poses move by (H - B)^-1 g, so the sum falls by r' Omega r + g' (1 - C B)^-1 C g.

    Args:
        poses: (n,) solution of the used edges, T_world_vertex, m.
        graph: vertices and edges, at a padded size or not.
        structure: structure of the used edges, without padding.
        used: (e,) edges that the solution used.
        edges: (k,) used edges to leave out, one at a time; without any of them the others still connect all
            vertices.

    Returns:
        (k,) falls of the sum.

    Raises:
        NotPositiveDefiniteError: the edges do not determine all poses.
        numpy.linalg.LinAlgError: the others do not connect all vertices.
    """
    parts = jax.device_get(_linearise(poses, graph))
    B = np.asarray(parts.blocks(), np.float64)[: len(used)]
    with one_thread():
        factor = factorise(structure.plan, *blocks_of(structure, np.where(used[:, None, None], B, 0.0)))
        C = inverse_at_edges(structure, factor)[edges]
    g = np.concatenate([parts.g_i, parts.g_j], -1)[edges][:, :, None]
    moved = np.linalg.solve(np.eye(B.shape[-1]) - C @ B[edges], C @ g)
    return np.asarray(2 * parts.cost[edges] + np.sum(g * moved, (1, 2)), np.float64)


_linearise = jax.jit(linearise)
