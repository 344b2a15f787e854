"""Solve pose graphs: find the poses that agree best with all measurements.

    graph = read_g2o(path).graph
    solution = solve(graph)
    covariances = marginal_covariances(graph, solution, [10, 20])

The device linearises all edges at once, and the host solves the linear systems. Programs are compiled for a
few sizes only, and the order of elimination is found once for each graph.
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import Literal

import jax
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.pose_graph.block_cholesky import factorise
from lio_jax.pose_graph.block_cholesky import solve as solve_factored
from lio_jax.pose_graph.chordal import chordal_poses
from lio_jax.pose_graph.descent import (
    Equations,
    Limits,
    descend,
    padded,
    padded_poses,
    padded_weights,
    point_at,
)
from lio_jax.pose_graph.graph import PoseGraph, Poses, Solution
from lio_jax.pose_graph.multifrontal import NotPositiveDefiniteError, one_thread
from lio_jax.pose_graph.robust import Robust, solve_robustly
from lio_jax.pose_graph.structure import Structure, structure_of

_VERTICES_AT_ONCE = 64


def solve(
    graph: PoseGraph,
    start: Literal["chordal", "poses"] = "chordal",
    robust: Robust | None = None,
    limits: Limits | None = None,
    structure: Structure | None = None,
) -> Solution:
    """Return the poses of least cost.

    The cost is half the sum of r' Omega r with r = Log(Z^-1 T_i^-1 T_j), as in gtsam. If no fixed vertex,
    prior or position connects a part of the graph with the world, the first vertex of that part keeps its
    pose.

    Args:
        graph: vertices and edges.
        start: "chordal" finds the first guess from the edges, where their weights allow it. "poses" begins at
            the graph's own poses, for a graph that was solved before and has grown a little.
        robust: which edges may be wrong; None: all are trusted.
        limits: conditions that end the solve; None: the defaults of :class:`Limits`.
        structure: structure of this graph, if it is known from an earlier solve.
    """
    with one_thread():
        return _solve(graph, start, robust, limits or Limits(), structure or structure_of(graph))


def compile_for(graph: PoseGraph) -> None:
    """Compile the programs for a solve of this graph, unless a graph of the same padded size has done so."""
    whole = padded(graph, structure_of(graph))
    jax.block_until_ready(point_at(whole.graph.poses, padded_weights(np.ones(len(graph.i)), whole), whole))


def _solve(
    graph: PoseGraph,
    start: Literal["chordal", "poses"],
    robust: Robust | None,
    limits: Limits,
    structure: Structure,
) -> Solution:
    whole = padded(graph, structure)
    own = point_at(whole.graph.poses, padded_weights(np.ones(len(structure.i)), whole), whole)
    poses = whole.graph.poses
    if start == "chordal":
        # weights of very different size leave no guess; the graph's own poses are one, too
        with suppress(NotPositiveDefiniteError):
            poses = padded_poses(chordal_poses(graph, structure), len(whole.graph.fixed))
    if robust is not None:
        descent, weights = solve_robustly(graph, structure, whole, poses, robust, limits)
    else:
        weights = np.ones(len(structure.i))
        descent = descend(whole, structure, poses, padded_weights(weights, whole), limits)
        if float(descent.point.cost) > float(own.cost):
            again = descend(whole, structure, whole.graph.poses, padded_weights(weights, whole), limits)
            descent = again._replace(iterations=descent.iterations + again.iterations)
    return Solution(
        poses=_unpadded(descent.point.poses, len(structure.held)),
        cost=descent.point.cost,
        weights=jax.device_put(weights),
        edge_costs=jax.device_put(np.asarray(descent.point.edge_costs)[: len(weights)]),
        initial_cost=own.cost,
        iterations=descent.iterations,
        status=descent.status,
    )


_OPEN_POSE = "the edges leave a pose open: there is no covariance of it."
_SINGULAR = 1e12
"""Product of a variance and its entry of the information above which a matrix is numerically singular."""


def marginal_covariances(
    graph: PoseGraph, solution: Solution, vertices: Sequence[int], structure: Structure | None = None
) -> NDArray[np.float64]:
    """Return the marginal covariances of some poses' right perturbations.

    They are blocks of the inverse of the Gauss-Newton Hessian J' Omega J at the solution, as in gtsam.

    Args:
        graph: the graph that was solved.
        solution: solution of the graph.
        vertices: the k vertices whose covariances are returned.
        structure: structure of the graph, if it is known.

    Returns:
        (k, d, d) covariances, rotation (rad) before translation (m); zero for held vertices.

    Raises:
        LioJaxError: the edges do not determine all poses.
    """
    structure = structure or structure_of(graph)
    whole = padded(graph, structure)
    poses = padded_poses(solution.poses, len(whole.graph.fixed))
    weights = padded_weights(np.asarray(solution.weights), whole)
    equations = Equations.at(point_at(poses, weights, whole), structure)
    size = structure.tangent_size
    covariances = np.zeros((len(vertices), size, size))
    unknown = structure.unknown[np.asarray(vertices, np.int64)]
    asked = np.flatnonzero(unknown < structure.count)
    try:
        with one_thread():
            factor = factorise(structure.plan, equations.diagonal, equations.pairs)
            for some in np.array_split(asked, -(-len(asked) // _VERTICES_AT_ONCE) or 1):
                columns = np.zeros((structure.count, size, len(some), size))
                columns[unknown[some], :, np.arange(len(some))] = np.eye(size)
                inverse = solve_factored(factor, columns.reshape(structure.count, size, -1))
                covariances[some] = inverse.reshape(columns.shape)[unknown[some], :, np.arange(len(some))]
    except NotPositiveDefiniteError:
        raise LioJaxError(_OPEN_POSE) from None
    # rounding may leave a pivot of a singular matrix above zero
    variances = np.diagonal(covariances[asked], axis1=1, axis2=2)
    own = np.diagonal(equations.diagonal[unknown[asked]], axis1=1, axis2=2)
    if np.any(variances * own > _SINGULAR):
        raise LioJaxError(_OPEN_POSE)
    return covariances


def _unpadded(poses: Poses, count: int) -> Poses:
    return jax.tree.map(lambda leaf: jax.device_put(np.asarray(leaf)[:count]), poses)
