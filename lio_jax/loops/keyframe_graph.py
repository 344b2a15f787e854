"""A pose graph that grows with a drive and is solved again and again."""

from dataclasses import dataclass, replace
from typing import Literal

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lio_jax.loops.graduated import Robust
from lio_jax.loops.graph import LOOP, ODOMETRY, POSITION, PoseGraph, Poses
from lio_jax.loops.host_poses import matrices_of, poses_from
from lio_jax.loops.pose_graph import solve

_Array = NDArray[np.float64]

_SUSPICIOUS = 1e-4
"""An edge that lies this far out, by the chi-square distribution, has the whole graph solved robustly."""


_SYSTEMATIC = 5.0
"""So many sigmas the odometry may be off in the same direction, keyframe after keyframe."""


@dataclass(frozen=True, eq=False)
class Edge:
    """One measurement."""

    kind: int
    """ODOMETRY, LOOP, PRIOR or POSITION."""
    i: int
    j: int
    measured: _Array
    """(4, 4): T_i_j, or T_world_j of a prior; of a position only the translation counts."""
    information: _Array
    """(6, 6) of the right perturbation, rotation (rad) first; of a position in world axes."""
    lever: _Array | None = None
    """(3,) m, in the frame of j: the point whose position is measured; None: the origin."""


@dataclass(frozen=True, eq=False)
class Solved:
    """The graph's poses and how far each edge is believed."""

    poses: _Array
    """(k, 4, 4) T_world_keyframe."""
    weights: _Array
    """(e,) 1, or below where an edge contradicts the others."""


def solved(poses: _Array, edges: list[Edge]) -> Solved:
    """Return the poses that agree best with the edges.

    Trusting all edges first is many times quicker; only where an edge then lies improbably far off are loops
    and positions doubted. For that the odometry counts less: its errors follow each other, and true loops,
    which all contradict it in the same way, must not be taken for the wrong ones.

    Args:
        poses: (k, 4, 4) to begin with; the first one stays where no prior or position ties the graph.
        edges: between them.
    """
    graph = graph_of(poses, edges)
    plain = solve(graph, start="poses")
    kind = np.array([edge.kind for edge in edges])
    doubted = (kind == LOOP) | (kind == POSITION)
    limit = chi2.isf(_SUSPICIOUS, np.where(kind == POSITION, 3, 6))
    if not np.any(doubted & (2 * np.asarray(plain.edge_costs) > limit)):
        return Solved(matrices_of(plain.poses), np.ones(len(edges)))
    loose = [
        replace(edge, information=edge.information / _SYSTEMATIC**2) if edge.kind == ODOMETRY else edge
        for edge in edges
    ]
    weights = _robust_weights(poses, loose, doubted)
    believed = [edge for edge, weight in zip(edges, weights, strict=True) if weight > 0.5]
    if len(believed) == len(edges):
        return Solved(matrices_of(plain.poses), weights)
    return Solved(matrices_of(solve(graph_of(poses, believed), start="poses").poses), weights)


def _robust_weights(poses: _Array, edges: list[Edge], doubted: NDArray[np.bool_]) -> _Array:
    """Return the (e,) weights of the better one of two truncated least squares: both are local searches."""
    begins: tuple[Literal["trusted", "given"], ...] = ("trusted", "given")
    found = []
    for begin in begins:
        graph = graph_of(poses, edges)
        if begin == "given":
            graph = eqx.tree_at(lambda graph: graph.poses, graph, solve(graph, start="poses").poses)
        solution = solve(graph, start="poses", robust=Robust(begin=begin))
        costs = np.asarray(solution.edge_costs)
        limit = chi2.ppf(Robust.confidence, np.where(np.asarray(graph.kind) == POSITION, 3, 6)) / 2
        truncated = np.where(doubted, np.minimum(costs, limit), costs)
        found.append((float(truncated.sum()), np.asarray(solution.weights)))
    return min(found, key=lambda each: each[0])[1]


def graph_of(poses: _Array, edges: list[Edge]) -> PoseGraph:
    """Return the pose graph of (k, 4, 4) poses and the edges between them."""
    measured = np.array([edge.measured for edge in edges]).reshape(-1, 4, 4)
    levers = np.array([np.zeros(3) if edge.lever is None else edge.lever for edge in edges]).reshape(-1, 3)
    return PoseGraph(
        poses=_se3(poses),
        i=jax.device_put(np.array([edge.i for edge in edges], np.int64)),
        j=jax.device_put(np.array([edge.j for edge in edges], np.int64)),
        measurement=_se3(measured),
        information=jax.device_put(np.array([edge.information for edge in edges]).reshape(-1, 6, 6)),
        kind=jax.device_put(np.array([edge.kind for edge in edges], np.int64)),
        fixed=jax.device_put(np.zeros(len(poses), bool)),
        lever=jax.device_put(levers),
    )


def _se3(poses: _Array) -> Poses:
    return poses_from(poses[:, :3, :3], poses[:, :3, 3])
