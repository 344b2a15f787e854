"""Reject edges that contradict the others, by graduated non-convexity."""

import numpy as np
from numpy.typing import NDArray

from lio_jax.pose_graph.descent import (
    Descent,
    Limits,
    Padded,
    descend,
    padded_weights,
    restricted,
)
from lio_jax.pose_graph.graph import PoseGraph, Poses
from lio_jax.pose_graph.structure import Structure

_Array = NDArray[np.float64]

_GROWTH = 1.4
"""Factor of the control parameter from one set of weights to the next."""
_ROUNDS = 200
"""Largest number of sets of weights."""
_ON_THE_WAY = Limits(iterations=10, tolerance=1e-4)
"""Conditions that end the descents before the last one."""
_SHRUNK = 0.9
"""Share of the edges with a weight below which a new order of elimination is found."""
_SETTLED = 1e-3
"""Distance from 0 or 1 below which a weight counts as final."""


def graduate(
    graph: PoseGraph,
    structure: Structure,
    padded: Padded,
    poses: Poses,
    doubted: NDArray[np.bool_],
    begin: _Array,
    limit: _Array,
    limits: Limits,
) -> tuple[Descent, _Array]:
    """Return poses and weights of a truncated least-squares problem, beginning with a convex approximation.

    This is GNC-TLS of Yang, Antonante, Tzoumas & Carlone, "Graduated non-convexity for robust spatial
    perception: from non-minimal solvers to global outlier rejection", RA-L 2020.

    Args:
        graph: vertices and edges, without padding.
        structure: structure of the graph.
        padded: the graph at its padded size.
        poses: first poses, at the padded size.
        doubted: (e,) edges that may be wrong.
        begin: (e,) weights of the edges for the first residuals.
        limit: (e,) r' Omega r above which an edge counts as wrong.
        limits: conditions that end the last descent, which has the final weights.

    Returns:
        The last descent, with the count of iterations of all descents, and the (e,) weight of each edge, 0 or
        1 and rarely between.
    """
    weights = begin.copy()

    def solved(poses: Poses, limits: Limits) -> Descent:
        """Descend with the current weights; edges of weight 0 cause no fill-in."""
        nonlocal padded, structure
        if np.sum(weights > 0) < _SHRUNK * np.sum(structure.used) or np.any((weights > 0) & ~structure.used):
            padded, structure = restricted(graph, padded, weights > 0)
        return descend(padded, structure, poses, padded_weights(weights, padded), limits)

    descent = solved(poses, _ON_THE_WAY)
    squared = 2 * np.asarray(descent.point.edge_costs)[: len(doubted)] / limit
    iterations = descent.iterations
    largest = np.max(squared[doubted], initial=0.0)
    control = 1 / (2 * largest - 1) if largest > 1 else np.inf
    for _ in range(_ROUNDS):
        weights[doubted] = truncated_weights(squared[doubted], control)
        descent = solved(descent.point.poses, _ON_THE_WAY)
        iterations += descent.iterations
        squared = 2 * np.asarray(descent.point.edge_costs)[: len(doubted)] / limit
        if np.all(np.minimum(weights, 1 - weights) < _SETTLED):
            break
        control *= _GROWTH
    descent = solved(descent.point.poses, limits)
    return descent._replace(iterations=iterations + descent.iterations), weights


def truncated_weights(squared: _Array, control: float) -> _Array:
    """Return the weights of edges for a truncated square that a control parameter makes convex.

    Args:
        squared: (e,) squared whitened residuals over the limit above which an edge counts as wrong.
        control: the parameter mu: 0 is the convex problem, infinity the truncated square itself.

    Returns:
        (e,) weights from 0 to 1.
    """
    if np.isinf(control):
        return (squared <= 1).astype(np.float64)
    between = np.sqrt(control * (control + 1) / np.maximum(squared, np.finfo(float).tiny)) - control
    between = np.where(squared >= (control + 1) / control, 0.0, between)
    return np.where(squared <= control / (control + 1), 1.0, between)
