"""The back end: a pose graph of keyframes, loops and GPS fixes, and how it corrects the odometry."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from lio_jax.core.pose_covariance import carried
from lio_jax.loops.closing import held_by
from lio_jax.loops.gps import Fix, GpsGate, Refusal, alignment
from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.params import BackEndSettings
from lio_jax.loops.verification import Verdict
from lio_jax.pose_graph.graduated import Robust
from lio_jax.pose_graph.graph import (
    LOOP,
    ODOMETRY,
    POSITION,
    PRIOR,
    PoseGraph,
    Poses,
    matrices_of,
    poses_from,
)
from lio_jax.pose_graph.pose_graph import solve

_Array = NDArray[np.float64]


def corrected_poses(
    stamp_ns: NDArray[np.int64],
    T_odom_imu: _Array,
    keyframe_stamp_ns: NDArray[np.int64],
    keyframes_T_odom_imu: _Array,
    keyframes_T_world_imu: _Array,
) -> _Array:
    """Return T_world_imu (n, 4, 4) of poses of the odometry.

    A pose between two keyframes is where each of them sees it, weighed by time; one before the first or
    behind the last is where that one sees it. Keyframes themselves get their own corrected pose.

    Args:
        stamp_ns: (n,) of the poses.
        T_odom_imu: (n, 4, 4).
        keyframe_stamp_ns: (k,) ascending, k > 0.
        keyframes_T_odom_imu: (k, 4, 4).
        keyframes_T_world_imu: (k, 4, 4) as corrected.
    """
    last = len(keyframe_stamp_ns) - 1
    before = np.clip(np.searchsorted(keyframe_stamp_ns, stamp_ns, side="right") - 1, 0, last)
    after = np.minimum(before + 1, last)
    span = (keyframe_stamp_ns[after] - keyframe_stamp_ns[before]).astype(np.float64)
    share = np.clip((stamp_ns - keyframe_stamp_ns[before]) / np.where(span > 0, span, 1.0), 0.0, 1.0)
    T_world_odom = keyframes_T_world_imu @ np.linalg.inv(keyframes_T_odom_imu)
    seen_before, seen_after = T_world_odom[before] @ T_odom_imu, T_world_odom[after] @ T_odom_imu
    turn = Rotation.from_matrix(seen_before[:, :3, :3].transpose(0, 2, 1) @ seen_after[:, :3, :3])
    poses = seen_before.copy()
    part_of_turn = Rotation.from_rotvec(turn.as_rotvec() * share[:, None]).as_matrix()
    poses[:, :3, :3] = seen_before[:, :3, :3] @ part_of_turn
    poses[:, :3, 3] += share[:, None] * (seen_after[:, :3, 3] - seen_before[:, :3, 3])
    return poses


def levelled_onto(T_a_imu: _Array, T_b_imu: _Array) -> _Array:
    """Return T_b_a, a turn about the vertical and a shift, that lays one pose of z-up frame a onto b's.

    The heading agrees as far as a turn about the vertical can make it; the position agrees.

    Args:
        T_a_imu: (4, 4).
        T_b_imu: (4, 4).
    """
    between = T_b_imu[:3, :3] @ T_a_imu[:3, :3].T
    yaw = np.arctan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1])
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T_b_a[:3, 3] = T_b_imu[:3, 3] - T_b_a[:3, :3] @ T_a_imu[:3, 3]
    return T_b_a


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


_SOLVE_EVERY, _SOLVE_SHARE = 20, 0.05
"""Keyframes from one solve to the next while loops and fixes come in that agree with the poses, and as a
share of all: the work of a drive stays nearly linear in its length."""
_UNKNOWN_YAW, _UNKNOWN_POSITION = np.pi, 1e4
"""Sigmas of the first pose on the earth, rad and m, as in LIO-SAM; fixes tell both."""


@dataclass(frozen=True, eq=False)
class Correction:
    """What the back end made of a drive."""

    stamp_ns: NDArray[np.int64]
    """(k,) of the keyframes."""
    T_odom_imu: _Array
    """(k, 4, 4) by the odometry."""
    T_world_imu: _Array
    """(k, 4, 4) corrected, in a z-up world in which the first keyframe keeps its position and heading."""
    edges: list[Edge]
    weights: _Array
    """(e,) of the edges: 1, or below where one contradicts the others."""
    loops: list[tuple[Verdict, float | None]]
    """Every proposed loop and, of those that entered the graph, the weight."""
    fixes: dict[str, int]
    """How many keyframes were tied to a GPS fix, and how many were not, by reason."""
    T_enu_world: _Array | None
    """(4, 4) from world to the fixes' east-north-up frame; None without fixes, or too few for the heading."""


@runtime_checkable
class FindsLoops(Protocol):
    """Such as :class:`lio_jax.loops.closing.LoopCloser`."""

    def take(self, keyframes: Sequence[Keyframe], poses: _Array) -> list[Verdict]:
        """Take up the newest keyframe; return the loops that enter the graph now."""
        ...

    def outcomes(self) -> list[Verdict]:
        """Return every proposal so far with what became of it."""
        ...


class BackEnd:
    """Takes keyframes in order."""

    def __init__(self, settings: BackEndSettings, closer: FindsLoops | None, gate: GpsGate | None) -> None:
        """Begin without keyframes.

        Args:
            settings: ``params.backend`` and ``params.gps``.
            closer: finds loops; None: none are closed.
            gate: chooses GPS fixes; None: they are not used.
        """
        self._tilt_sigma: float = settings.values["backend"]["tilt_sigma"]
        self._lever = np.asarray(settings.values["gps"]["lever_arm"], np.float64)
        self._yaw_sigma: float = settings.values["gps"]["yaw_sigma"]
        self._closer, self._gate = closer, gate
        self._keyframes: list[Keyframe] = []
        self._poses = np.zeros((0, 4, 4))
        """In the odometry's world; from the alignment on in the fixes' frame."""
        self._edges: list[Edge] = []
        self._fixes: list[tuple[int, Fix]] = []
        self._aligned = False
        self._since_fix = np.zeros((6, 6))
        """Covariance of the last pose, given the last fix."""
        self._weights = np.zeros(0)
        self._unsolved = 0
        """Loops and fixes that entered the graph since it was solved."""
        self._solved_at = 0

    def add(self, keyframe: Keyframe) -> None:
        """Take the next keyframe; its loops and its fix enter the graph, which is solved where it is due."""
        self._append(keyframe)
        surprised = self._close_loops(self._closer) if self._closer else False
        surprised |= self._tie_to_earth(self._gate) if self._gate else False
        count = len(self._keyframes)
        due = count >= self._solved_at + max(_SOLVE_EVERY, _SOLVE_SHARE * count)
        if surprised or (self._unsolved and due):
            self._solve()

    def settle(self) -> None:
        """Solve the graph with all that it holds."""
        if self._unsolved:
            self._solve()

    def correction(self) -> Correction:
        """Return the correction of all keyframes so far, as the last solve left it."""
        T_world_enu = np.eye(4)
        if self._keyframes and self._aligned:
            T_world_enu = levelled_onto(self._poses[0], self._keyframes[0].T_odom_imu)
        weights = np.ones(len(self._edges))
        weights[: len(self._weights)] = self._weights
        fixes: dict[str, int] = {}
        if self._gate:
            fixes = {"used": len(self._fixes)} | {str(why): n for why, n in self._gate.refusals.items()}
        return Correction(
            stamp_ns=np.array([keyframe.stamp_ns for keyframe in self._keyframes], np.int64),
            T_odom_imu=np.array([keyframe.T_odom_imu for keyframe in self._keyframes]).reshape(-1, 4, 4),
            T_world_imu=T_world_enu @ self._poses,
            edges=self._edges,
            weights=weights,
            loops=self._outcomes(weights),
            fixes=fixes,
            T_enu_world=_inverse(T_world_enu) if self._aligned else None,
        )

    def _append(self, keyframe: Keyframe) -> None:
        pose = keyframe.T_odom_imu
        if self._keyframes:
            last = self._keyframes[-1]
            T_last_this = _inverse(last.T_odom_imu) @ pose
            information = _inverse(keyframe.covariance)
            self._edges.append(Edge(ODOMETRY, last.index, keyframe.index, T_last_this, information))
            pose = self._poses[-1] @ T_last_this
            self._since_fix = carried(self._since_fix, _inverse(T_last_this)) + keyframe.covariance
        self._keyframes.append(keyframe)
        self._poses = np.concatenate([self._poses, pose[None]])

    def _close_loops(self, closer: FindsLoops) -> bool:
        """Add the loops that are found now; return whether one contradicts the poses."""
        entering = closer.take(self._keyframes, self._poses)
        for verdict in entering:
            ends = verdict.proposal.target, verdict.proposal.source
            self._edges.append(Edge(LOOP, *ends, verdict.T_target_source, verdict.information))
        self._unsolved += len(entering)
        return len(held_by(self._poses, entering)) < len(entering)

    def _tie_to_earth(self, gate: GpsGate) -> bool:
        """Add the newest keyframe's fix; return whether it is the one from which on the heading is known."""
        keyframe, pose = self._keyframes[-1], self._poses[-1]
        covariance = pose[:3, :3] @ self._since_fix[3:, 3:] @ pose[:3, :3].T if self._aligned else None
        fix = gate.used_fix(keyframe.stamp_ns, keyframe.T_odom_imu, pose, covariance)
        if isinstance(fix, Refusal):
            return False
        self._since_fix = np.zeros((6, 6))
        self._fixes.append((keyframe.index, fix))
        if self._aligned:
            self._edges.append(_position(keyframe.index, fix, self._lever))
            self._unsolved += 1
            return False
        return self._align()

    def _align(self) -> bool:
        """Lay the poses into the fixes' frame, where these tell the heading already."""
        poses = self._poses[[index for index, _ in self._fixes]]
        antennas = poses[:, :3, :3] @ self._lever + poses[:, :3, 3]
        positions = np.array([fix.position for _, fix in self._fixes])
        covariances = np.array([fix.covariance for _, fix in self._fixes])
        found = alignment(antennas, positions, covariances, self._yaw_sigma)
        if found is None:
            return False
        self._poses = found.T_enu_odom @ self._poses
        self._edges.append(_first_pose(self._poses[0], self._tilt_sigma))
        self._edges += [_position(index, fix, self._lever) for index, fix in self._fixes]
        self._aligned = True
        self._unsolved += len(self._fixes)
        return True

    def _solve(self) -> None:
        found: Solved = solved(self._poses, self._edges)
        self._poses, self._weights = found.poses, found.weights
        self._unsolved, self._solved_at = 0, len(self._keyframes)

    def _outcomes(self, weights: _Array) -> list[tuple[Verdict, float | None]]:
        if self._closer is None:
            return []
        weight_of = {
            (edge.i, edge.j): float(weight)
            for edge, weight in zip(self._edges, weights, strict=True)
            if edge.kind == LOOP
        }
        return [
            (
                verdict,
                weight_of.get((verdict.proposal.target, verdict.proposal.source))
                if verdict.accepted
                else None,
            )
            for verdict in self._closer.outcomes()
        ]


def _position(index: int, fix: Fix, lever: _Array) -> Edge:
    measured, information = np.eye(4), np.zeros((6, 6))
    measured[:3, 3] = fix.position
    information[3:, 3:] = _inverse(fix.covariance)
    return Edge(POSITION, index, index, measured, information, lever)


def _first_pose(T_enu_imu: _Array, tilt_sigma: float) -> Edge:
    """Return the prior without which fixes along a straight way would leave the roll about it open."""
    information = np.diag([tilt_sigma**-2] * 2 + [_UNKNOWN_YAW**-2] + [_UNKNOWN_POSITION**-2] * 3)
    R = T_enu_imu[:3, :3]
    information[:3, :3] = R.T @ information[:3, :3] @ R
    return Edge(PRIOR, 0, 0, T_enu_imu, information)


def _inverse(matrix: _Array) -> _Array:
    return np.asarray(np.linalg.inv(matrix), np.float64)
