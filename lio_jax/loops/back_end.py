"""The back end: a pose graph of keyframes, loops and GPS fixes, and the correction of the odometry by it.

:class:`BackEnd` takes keyframes in order, adds their edges to the graph and solves it when necessary.
:func:`solved` is the robust solve of the graph. :func:`corrected_poses` interpolates the correction of the
keyframes for all poses of the odometry.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, Protocol, runtime_checkable

import equinox as eqx
import jax
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from lio_jax.core.geometry import carried
from lio_jax.loops.closing import held_by
from lio_jax.loops.gps import Fix, GpsGate, Refusal, alignment
from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.params import BackEndSettings
from lio_jax.loops.verification import Verdict
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
from lio_jax.pose_graph.robust import Robust

_Array = NDArray[np.float64]


def corrected_poses(
    stamp_ns: NDArray[np.int64],
    T_odom_imu: _Array,
    keyframe_stamp_ns: NDArray[np.int64],
    keyframes_T_odom_imu: _Array,
    keyframes_T_world_imu: _Array,
) -> _Array:
    """Return the corrected poses T_world_imu, (n, 4, 4) m, of poses of the odometry.

    The correction of a pose between two keyframes is interpolated in time between the corrections of these
    two. Before the first keyframe it is that of the first, and after the last one that of the last. The
    result for a keyframe is its own corrected pose.

    Args:
        stamp_ns: (n,) times of the poses, ns.
        T_odom_imu: (n, 4, 4) poses of the odometry, m.
        keyframe_stamp_ns: (k,) times of the keyframes, ns, ascending, at least one.
        keyframes_T_odom_imu: (k, 4, 4) poses of the keyframes by the odometry, m.
        keyframes_T_world_imu: (k, 4, 4) corrected poses of the keyframes, m.
    """
    before, after, share = between_keyframes(stamp_ns, keyframe_stamp_ns)
    T_world_odom = keyframes_T_world_imu @ np.linalg.inv(keyframes_T_odom_imu)
    seen_before, seen_after = T_world_odom[before] @ T_odom_imu, T_world_odom[after] @ T_odom_imu
    turn = Rotation.from_matrix(seen_before[:, :3, :3].transpose(0, 2, 1) @ seen_after[:, :3, :3])
    poses = seen_before.copy()
    part_of_turn = Rotation.from_rotvec(turn.as_rotvec() * share[:, None]).as_matrix()
    poses[:, :3, :3] = seen_before[:, :3, :3] @ part_of_turn
    poses[:, :3, 3] += share[:, None] * (seen_after[:, :3, 3] - seen_before[:, :3, 3])
    return poses


def between_keyframes(
    stamp_ns: NDArray[np.int64], keyframe_stamp_ns: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.intp], _Array]:
    """Return the keyframes before and after each pose, and its share of the time between them, (n,) each.

    Both are the first keyframe before it, or the last one after it. The share is from 0 to 1.

    Args:
        stamp_ns: (n,) times of the poses, ns.
        keyframe_stamp_ns: (k,) times of the keyframes, ns, ascending, at least one.
    """
    last = len(keyframe_stamp_ns) - 1
    before = np.clip(np.searchsorted(keyframe_stamp_ns, stamp_ns, side="right") - 1, 0, last)
    after = np.minimum(before + 1, last)
    span = (keyframe_stamp_ns[after] - keyframe_stamp_ns[before]).astype(np.float64)
    share = np.clip((stamp_ns - keyframe_stamp_ns[before]) / np.where(span > 0, span, 1.0), 0.0, 1.0)
    return before, after, share


def levelled_onto(T_a_imu: _Array, T_b_imu: _Array) -> _Array:
    """Return the (4, 4) transformation T_b_a between two z-up frames that aligns a pose given in both.

    It is a rotation about the vertical and a translation. The positions agree exactly, and the headings as
    well as a rotation about the vertical allows.

    Args:
        T_a_imu: (4, 4) pose in frame a, m.
        T_b_imu: (4, 4) the same pose in frame b, m.
    """
    between = T_b_imu[:3, :3] @ T_a_imu[:3, :3].T
    yaw = np.arctan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1])
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T_b_a[:3, 3] = T_b_imu[:3, 3] - T_b_a[:3, :3] @ T_a_imu[:3, 3]
    return T_b_a


_SUSPICIOUS = 1e-4
"""Probability, by the chi-square distribution, of a residual for which the graph is solved robustly."""


_SYSTEMATIC = 5.0
"""Systematic error of the odometry in a robust solve, standard deviations of each edge."""


@dataclass(frozen=True, eq=False)
class Edge:
    """One measurement between keyframes or of one keyframe."""

    kind: int
    """ODOMETRY, LOOP, PRIOR or POSITION."""
    i: int
    """Index of the first keyframe; that of ``j`` for a prior and for a position."""
    j: int
    """Index of the second keyframe."""
    measured: _Array
    """(4, 4) measured T_i_j, m; for a prior T_world_j; for a position only the translation is used."""
    information: _Array
    """(6, 6) information of the right perturbation, rotation (rad) before translation (m); for a position
    that of the coordinates in world."""
    lever: _Array | None = None
    """(3,) point whose position is measured, in the frame of j, m; None: the origin."""
    stated: _Array | None = None
    """(6, 6) part of the covariance that does not depend on the parameters, see
    :mod:`lio_jax.loops.edge_noise`; None: no part of it depends on them."""


@dataclass(frozen=True, eq=False)
class Solved:
    """The solution of a graph of k keyframes and e edges."""

    poses: _Array
    """(k, 4, 4) T_world_keyframe, m."""
    weights: _Array
    """(e,) weight of each edge: 1, or less where an edge contradicts the others."""


def solved(poses: _Array, edges: list[Edge]) -> Solved:
    """Return the poses that agree best with the edges.

    A first solve trusts all edges, which is many times faster. A robust solve follows only if an edge then
    has an improbable residual, or the odometry is bent; it may reject loops and positions. In it the odometry
    has less information: its errors are correlated, so correct loops may all contradict it in the same way
    and must not be rejected.

    Args:
        poses: (k, 4, 4) first guess of T_world_keyframe, m. Without a prior or a position the first pose does
            not change.
        edges: measurements between the keyframes.
    """
    graph = graph_of(poses, edges)
    plain = solve(graph, start="poses")
    kind = np.array([edge.kind for edge in edges])
    doubted = (kind == LOOP) | (kind == POSITION)
    freedom = np.where(kind == POSITION, 3, 6)
    squared = 2 * np.asarray(plain.edge_costs)
    # a wrong loop may bend the odometry until it agrees, so the odometry's own share must be probable, too
    bent = squared[~doubted].sum() / _SYSTEMATIC**2 > chi2.isf(_SUSPICIOUS, max(freedom[doubted].sum(), 1))
    if not bent and not np.any(squared[doubted] > chi2.isf(_SUSPICIOUS, freedom[doubted])):
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
    """Return the (e,) weights of the better of two truncated least squares: each finds a local minimum."""
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
    """Return the pose graph of keyframes and edges.

    Args:
        poses: (k, 4, 4) T_world_keyframe, m.
        edges: measurements between the keyframes.
    """
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
"""Number of keyframes between two solves while new loops and fixes agree with the poses, and its least share
of all keyframes. With the share the work grows almost linearly with the length of a drive."""
_UNKNOWN_YAW, _UNKNOWN_POSITION = np.pi, 1e4
"""Prior standard deviations of the first pose's heading (rad) and position (m) on the earth, as in LIO-SAM.
The fixes determine both."""


@dataclass(frozen=True, eq=False)
class Correction:
    """The result of the back end for k keyframes and e edges."""

    stamp_ns: NDArray[np.int64]
    """(k,) times of the keyframes, ns."""
    T_odom_imu: _Array
    """(k, 4, 4) poses of the keyframes by the odometry, m."""
    T_world_imu: _Array
    """(k, 4, 4) corrected poses, m, in a z-up world with the first keyframe's position and heading."""
    edges: list[Edge]
    """All edges of the graph."""
    weights: _Array
    """(e,) weight of each edge: 1, or less where an edge contradicts the others."""
    loops: list[tuple[Verdict, float | None]]
    """Every proposed loop, with its weight if it entered the graph."""
    fixes: dict[str, int]
    """Number of keyframes with a GPS fix in the graph, and the numbers of those without, by reason."""
    T_enu_world: _Array | None
    """(4, 4) pose of the world in the fixes' east-north-up frame, m; None while the heading is unknown."""


@runtime_checkable
class FindsLoops(Protocol):
    """A source of loops, for example :class:`lio_jax.loops.closing.LoopCloser`."""

    def take(self, keyframes: Sequence[Keyframe], poses: _Array) -> list[Verdict]:
        """Take the newest keyframe, and return the loops that enter the graph now.

        Args:
            keyframes: all so far; each call brings one more.
            poses: (k, 4, 4) their corrected T_world_imu, m.
        """
        ...

    def outcomes(self) -> list[Verdict]:
        """Return the verdicts on all proposals so far."""
        ...


class BackEnd:
    """A pose graph that grows with each keyframe."""

    def __init__(self, settings: BackEndSettings, closer: FindsLoops | None, gate: GpsGate | None) -> None:
        """Begin without keyframes.

        Args:
            settings: ``params.backend`` and ``params.gps``.
            closer: source of loops; None: no loops are closed.
            gate: choice of GPS fixes; None: fixes are not used.
        """
        self._tilt_sigma: float = settings.values["backend"]["tilt_sigma"]
        self._lever = np.asarray(settings.values["gps"]["lever_arm"], np.float64)
        self._yaw_sigma: float = settings.values["gps"]["yaw_sigma"]
        self._closer, self._gate = closer, gate
        self._keyframes: list[Keyframe] = []
        self._poses = np.zeros((0, 4, 4))
        """(k, 4, 4) poses of the keyframes, m, in the odometry's world, or in the fixes' once aligned."""
        self._edges: list[Edge] = []
        self._fixes: list[tuple[int, Fix]] = []
        self._aligned = False
        self._since_fix = np.zeros((6, 6))
        """Covariance of the last pose relative to the keyframe with the last fix."""
        self._weights = np.zeros(0)
        self._unsolved = 0
        """Number of loops and fixes that entered the graph after the last solve."""
        self._solved_at = 0
        self.solves = 0
        """Number of solves of the graph so far."""

    def add(self, keyframe: Keyframe) -> None:
        """Add the next keyframe with its loops and its fix, and solve the graph if that is due."""
        self._append(keyframe)
        surprised = self._close_loops(self._closer) if self._closer else False
        surprised |= self._tie_to_earth(self._gate) if self._gate else False
        count = len(self._keyframes)
        due = count >= self._solved_at + max(_SOLVE_EVERY, _SOLVE_SHARE * count)
        if surprised or (self._unsolved and due):
            self._solve()

    def settle(self) -> None:
        """Solve the graph if it has loops or fixes that no solve has used."""
        if self._unsolved:
            self._solve()

    def correction(self) -> Correction:
        """Return the correction of all keyframes so far, by the last solve."""
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
            ends = last.index, keyframe.index
            self._edges.append(Edge(ODOMETRY, *ends, T_last_this, information, stated=keyframe.stated))
            pose = self._poses[-1] @ T_last_this
            self._since_fix = carried(self._since_fix, _inverse(T_last_this)) + keyframe.covariance
        self._keyframes.append(keyframe)
        self._poses = np.concatenate([self._poses, pose[None]])

    def _close_loops(self, closer: FindsLoops) -> bool:
        """Add the loops that are found now; return whether one of them contradicts the poses."""
        entering = closer.take(self._keyframes, self._poses)
        for verdict in entering:
            ends = verdict.proposal.target, verdict.proposal.source
            measured = verdict.T_target_source, verdict.information
            self._edges.append(Edge(LOOP, *ends, *measured, stated=verdict.stated))
        self._unsolved += len(entering)
        return len(held_by(self._poses, entering)) < len(entering)

    def _tie_to_earth(self, gate: GpsGate) -> bool:
        """Add the newest keyframe's fix; return whether this fix makes the heading known."""
        keyframe, pose = self._keyframes[-1], self._poses[-1]
        covariance = pose[:3, :3] @ self._since_fix[3:, 3:] @ pose[:3, :3].T if self._aligned else None
        poses = keyframe.T_odom_imu, pose
        fix = gate.used_fix(keyframe.stamp_ns, *poses, covariance, keyframe.position_error)
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
        """Move the poses into the fixes' frame if the heading is observable; return whether it is."""
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
        self.solves += 1

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
    measured, information, stated = np.eye(4), np.zeros((6, 6)), np.zeros((6, 6))
    measured[:3, 3] = fix.position
    information[3:, 3:] = _inverse(fix.covariance)
    stated[3:, 3:] = fix.stated
    return Edge(POSITION, index, index, measured, information, lever, stated)


def _first_pose(T_enu_imu: _Array, tilt_sigma: float) -> Edge:
    """Return the prior of the first pose: without it, fixes along a straight line leave roll unobservable."""
    information = np.diag([tilt_sigma**-2] * 2 + [_UNKNOWN_YAW**-2] + [_UNKNOWN_POSITION**-2] * 3)
    R = T_enu_imu[:3, :3]
    information[:3, :3] = R.T @ information[:3, :3] @ R
    return Edge(PRIOR, 0, 0, T_enu_imu, information)


def _inverse(matrix: _Array) -> _Array:
    return np.asarray(np.linalg.inv(matrix), np.float64)
