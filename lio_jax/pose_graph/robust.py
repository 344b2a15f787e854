"""Solve a pose graph in which some edges are wrong."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lio_jax.pose_graph.chordal import chordal_poses, edges_at
from lio_jax.pose_graph.descent import Descent, Limits, Padded, padded_poses
from lio_jax.pose_graph.graduated import graduate
from lio_jax.pose_graph.graph import LOOP, ODOMETRY, POSITION, PRIOR, PoseGraph, Poses
from lio_jax.pose_graph.selection import select
from lio_jax.pose_graph.structure import Structure, parts_of, structure_of


@dataclass(frozen=True)
class Robust:
    """Which edges may be wrong, and how large the residual of a correct edge may be."""

    confidence: float = 0.99
    """Share of correct edges whose r' Omega r is below the limit, by the chi-square distribution."""
    trusted_kinds: tuple[int, ...] = (ODOMETRY, PRIOR)
    """Kinds of edges that are taken to be correct."""
    begin: Literal["trusted", "given"] = "trusted"
    """Poses of the first residuals. "trusted": the poses that agree best with the trusted edges; this finds
    the correct edges among many wrong ones. "given": the given poses, for example the best ones with all
    edges; this finds a few wrong edges if all correct ones contradict the trusted edges in the same way."""


def solve_robustly(
    graph: PoseGraph, structure: Structure, padded: Padded, poses: Poses, robust: Robust, limits: Limits
) -> tuple[Descent, NDArray[np.float64]]:
    """Return the last descent, and the (e,) weight of each edge, 0 or 1 and rarely between.

    Loops are selected from the poses of the trusted edges (:mod:`lio_jax.pose_graph.selection`). Positions,
    and all edges with ``begin="given"``, are judged by graduated non-convexity.

    Args:
        graph: vertices and edges, without padding.
        structure: structure of the graph.
        padded: the graph at its padded size.
        poses: first poses, at the padded size. They are used if ``robust.begin`` is "given", or if the
            trusted edges do not connect all vertices.
        robust: which edges may be wrong.
        limits: conditions that end the last descent.
    """
    doubted = ~np.isin(structure.kind, robust.trusted_kinds)
    start = _poses_of_trusted(graph, structure, ~doubted) if robust.begin == "trusted" else None
    if start is not None:
        poses = padded_poses(start, len(padded.graph.fixed))
        if np.all(structure.kind[doubted] == LOOP):
            return select(graph, structure, padded, poses, doubted, robust.confidence, limits)
    size = np.where(
        structure.kind == POSITION, 3 if structure.tangent_size == 6 else 2, structure.tangent_size
    )
    limit = np.asarray(chi2.ppf(robust.confidence, size))
    begin = np.where(doubted, 0.0, 1.0) if start is not None else np.ones(len(doubted))
    return graduate(graph, structure, padded, poses, doubted, begin, limit, limits)


def _poses_of_trusted(graph: PoseGraph, structure: Structure, trusted: NDArray[np.bool_]) -> Poses | None:
    i, j = structure.i[trusted], structure.j[trusted]
    if parts_of(len(structure.held), i, j).max(initial=-1) + 1 != structure.parts:
        return None
    alone = edges_at(graph, np.flatnonzero(trusted))
    return chordal_poses(alone, structure_of(alone))
