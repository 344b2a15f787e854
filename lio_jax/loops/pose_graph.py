"""Solve pose graphs: the poses that agree best with all that was measured.

    graph = read_g2o(path).graph
    solution = solve(graph)
    covariances = marginal_covariances(graph, solution, [10, 20])

The device linearises all edges at once, the host eliminates: programs are compiled for a few sizes only, and
the order of elimination is found once per graph.
"""

from collections.abc import Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.loops.block_cholesky import NotPositiveDefiniteError, factorise
from lio_jax.loops.block_cholesky import solve as solve_factored
from lio_jax.loops.chordal import chordal_poses
from lio_jax.loops.descent import Equations, Limits, descend
from lio_jax.loops.graduated import Robust, graduate
from lio_jax.loops.graph import PoseGraph, Poses, Solution
from lio_jax.loops.normal_equations import Padded, Point, padded, padded_poses, padded_weights, point_after
from lio_jax.loops.structure import Structure, structure_of

_VERTICES_AT_ONCE = 64


def solve(
    graph: PoseGraph,
    start: Literal["chordal", "poses"] = "chordal",
    robust: Robust | None = None,
    limits: Limits = Limits(),
    structure: Structure | None = None,
) -> Solution:
    """Return the poses of least cost.

    The cost is half the sum of r' Omega r with r = Log(Z^-1 T_i^-1 T_j), as in gtsam. Where nothing ties a
    connected part of the graph to the world its first vertex keeps its pose.

    Args:
        graph: vertices and edges.
        start: "chordal" finds the first guess from the edges, and needs none; "poses" begins at the graph's own,
            for a graph that has only grown a little.
        robust: which edges may be wrong; None: all are trusted.
        limits: when to end.
        structure: of this graph, where it is known from an earlier solve.
    """
    structure = structure or structure_of(graph)
    whole = padded(graph, structure)
    own = _point(whole, structure, whole.graph.poses, np.ones(len(structure.i)))
    initial_cost = float(own.cost)
    poses = whole.graph.poses
    if start == "chordal":
        poses = padded_poses(chordal_poses(graph, structure), len(whole.graph.fixed))
    if robust is not None:
        descent, weights = graduate(graph, structure, whole, poses, robust, limits)
    else:
        weights = np.ones(len(structure.i))
        descent = descend(whole, structure, poses, padded_weights(weights, whole), limits)
        if float(descent.point.cost) > initial_cost:
            again = descend(whole, structure, whole.graph.poses, padded_weights(weights, whole), limits)
            descent = again._replace(iterations=descent.iterations + again.iterations)
    return Solution(
        poses=_unpadded(descent.point.poses, len(structure.held)),
        cost=descent.point.cost,
        weights=jnp.asarray(weights),
        initial_cost=own.cost,
        iterations=descent.iterations,
        status=descent.status,
    )


def marginal_covariances(
    graph: PoseGraph, solution: Solution, vertices: Sequence[int], structure: Structure | None = None
) -> NDArray[np.float64]:
    """Return the covariances (k, d, d) of poses' right perturbations, rotation first; 0 of a vertex that is held.

    They are blocks of the inverse of the Gauss-Newton Hessian J' Omega J at the solution, as in gtsam.

    Args:
        graph: that was solved.
        solution: of the graph.
        vertices: whose covariances are asked for.
        structure: of the graph, where it is known.

    Raises:
        LioJaxError: the graph leaves a pose open.
    """
    structure = structure or structure_of(graph)
    whole = padded(graph, structure)
    poses = padded_poses(solution.poses, len(whole.graph.fixed))
    equations = Equations.at(_point(whole, structure, poses, np.asarray(solution.weights)), structure)
    try:
        factor = factorise(structure.plan, np.concatenate([equations.diagonal, equations.pairs]))
    except NotPositiveDefiniteError as error:
        raise LioJaxError("the edges leave a pose open: there is no covariance of it.") from error
    size = structure.tangent_size
    covariances = np.zeros((len(vertices), size, size))
    unknown = structure.unknown[np.asarray(vertices, np.int64)]
    asked = np.flatnonzero(unknown < structure.count)
    for some in np.array_split(asked, -(-len(asked) // _VERTICES_AT_ONCE) or 1):
        columns = np.zeros((structure.count, size, len(some), size))
        columns[unknown[some], :, np.arange(len(some))] = np.eye(size)
        inverse = solve_factored(factor, columns.reshape(structure.count, size, -1)).reshape(columns.shape)
        covariances[some] = inverse[unknown[some], :, np.arange(len(some))]
    return covariances


def _point(whole: Padded, structure: Structure, poses: Poses, weights: NDArray[np.float64]) -> Point:
    still = jnp.zeros((len(whole.places.unknown) + 1, structure.tangent_size), whole.graph.information.dtype)
    return point_after(poses, still, padded_weights(weights, whole), whole)


def _unpadded(poses: Poses, count: int) -> Poses:
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[:count]), poses)
