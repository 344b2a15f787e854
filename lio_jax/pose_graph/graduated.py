"""Distrust edges that contradict the others, by graduated non-convexity."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lio_jax.pose_graph.chordal import chordal_poses, edges_at
from lio_jax.pose_graph.descent import (
    Descent,
    Limits,
    Padded,
    descend,
    padded_poses,
    padded_weights,
    places_in,
)
from lio_jax.pose_graph.graph import ODOMETRY, POSITION, PRIOR, PoseGraph, Poses
from lio_jax.pose_graph.structure import Structure, parts_of, structure_of

_Array = NDArray[np.float64]

_GROWTH = 1.4
"""Of the control parameter, from one set of weights to the next."""
_ROUNDS = 200
_ON_THE_WAY = Limits(iterations=10, tolerance=1e-4)
_SHRUNK = 0.9
"""When only this share of the edges still has a weight the order of elimination is found anew."""
_SETTLED = 1e-3
"""Weights this near to 0 or 1 change no more."""


@dataclass(frozen=True)
class Robust:
    """Which edges may be wrong, and from when on they are."""

    confidence: float = 0.99
    """Share of right edges whose r' Omega r is below the limit, by the chi-square distribution."""
    trusted_kinds: tuple[int, ...] = (ODOMETRY, PRIOR)
    """Edges that are taken to be right."""
    begin: Literal["trusted", "given"] = "trusted"
    """Whose residuals come first: those at the poses that the trusted edges ask for, which finds the right
    ones among many wrong edges; or at the given poses, such as the best ones with all edges, which finds a
    few wrong edges among right ones that the trusted edges contradict together."""


class Graduated(NamedTuple):
    """Where the graduation ended."""

    descent: Descent
    weights: _Array
    """(e,) 0 or 1, seldom between."""


def graduate(
    graph: PoseGraph, structure: Structure, padded: Padded, poses: Poses, robust: Robust, limits: Limits
) -> Graduated:
    """Return poses and weights of the truncated least squares, beginning with a convex problem.

    GNC-TLS of Yang, Antonante, Tzoumas & Carlone, "Graduated non-convexity for robust spatial perception:
    from non-minimal solvers to global outlier rejection", RA-L 2020. The first residuals are those at the
    poses that the trusted edges ask for, where these connect all vertices, else at ``poses``.

    Args:
        graph: as it is.
        structure: of the graph.
        padded: the graph at its padded size.
        poses: to begin with where ``robust.begin`` says so, or the trusted edges don't connect the graph; of
            the padded size.
        robust: which edges may be wrong.
        limits: of the last descent, with the weights found.
    """
    doubted = ~np.isin(structure.kind, robust.trusted_kinds)
    size = np.where(
        structure.kind == POSITION, 3 if structure.tangent_size == 6 else 2, structure.tangent_size
    )
    limit = chi2.ppf(robust.confidence, size)
    weights = np.where(doubted, 0.0, 1.0)
    start = _poses_of_trusted(graph, structure, ~doubted) if robust.begin == "trusted" else None
    if start is None:
        weights[:] = 1.0
    else:
        poses = padded_poses(start, len(padded.graph.fixed))

    def solved(poses: Poses, limits: Limits) -> Descent:
        """Descend with today's weights; edges that have none make no fill."""
        nonlocal padded, structure
        if np.sum(weights > 0) < _SHRUNK * np.sum(structure.used) or np.any((weights > 0) & ~structure.used):
            structure = structure_of(graph, weights > 0)
            padded = padded._replace(places=places_in(structure))
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
    return Graduated(descent._replace(iterations=iterations + descent.iterations), weights)


def truncated_weights(squared: _Array, control: float) -> _Array:
    """Return the weights of edges under the truncated square made convex by a control parameter.

    Args:
        squared: squared whitened residuals as shares of the limit above which an edge counts as wrong.
        control: mu: 0 makes the problem convex, infinity leaves it as it is.
    """
    if np.isinf(control):
        return (squared <= 1).astype(np.float64)
    between = np.sqrt(control * (control + 1) / np.maximum(squared, np.finfo(float).tiny)) - control
    between = np.where(squared >= (control + 1) / control, 0.0, between)
    return np.where(squared <= control / (control + 1), 1.0, between)


def _poses_of_trusted(graph: PoseGraph, structure: Structure, trusted: NDArray[np.bool_]) -> Poses | None:
    i, j = structure.i[trusted], structure.j[trusted]
    if parts_of(len(structure.held), i, j).max(initial=-1) + 1 != structure.parts:
        return None
    alone = edges_at(graph, np.flatnonzero(trusted))
    return chordal_poses(alone, structure_of(alone))
