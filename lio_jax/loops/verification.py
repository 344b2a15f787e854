"""Decide whether two keyframes saw the same place, and find their relative pose."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from lio_jax.core.leaf import numbers_of, traced
from lio_jax.loops.alignment import aligned
from lio_jax.loops.edge_noise import loop_covariance
from lio_jax.loops.keyframe import Keyframe, level_points, padded, same_piece, thinned
from lio_jax.loops.overlap import LEAST_POINTS, Candidate, CloudComparison, conflict
from lio_jax.loops.params import AlignmentParams, BackEndSettings
from lio_jax.loops.proposals import Proposal, is_old, possible_error
from lio_jax.pose_graph.graph import heading_of

_Plan = NDArray[np.floating]

CELL = 1.0
"""Edge of a cell of the grid, m."""
_SIDE = 128
"""Number of cells along an edge of the grid."""
WINDOW = 16
"""Largest shift in each direction, cells; the grid has a margin of this width around the source."""
SOURCE_REACH = (_SIDE // 2 - WINDOW) * CELL
"""Largest |x| and |y| of the source's points, m."""
TARGET_REACH = _SIDE // 2 * CELL
"""Largest |x| and |y| of the target's points, m."""
_UPRIGHT = (0.4, 2.0)
"""Differences of height within a cell, m, at which an object begins to count as upright, and counts fully."""
_TURN = 0.05
"""Step of the rotations that are tried, rad."""
_APART = 3.0
"""Least distance between two different fits, m."""
_BLUR = 0.8
"""Standard deviation of the target's blur, cells: it allows for half a cell and half a step of rotation."""


class Fits(NamedTuple):
    """The n best fits of the source on the target, the best first."""

    turn: _Plan
    """(n,) rotations of the source about z, rad."""
    shift: _Plan
    """(n, 2) positions of the source's origin in the target, m."""
    share: _Plan
    """(n,) share of the source's upright objects that lie on upright objects of the target, 0 to 1."""


def upright_cells(points: NDArray[np.float32]) -> tuple[_Plan, NDArray[np.bool_]]:
    """Return how upright the content of each cell of the grid is, and which points are in upright cells.

    Args:
        points: (n, 3) m, z up, with |x| and |y| below ``TARGET_REACH``.

    Returns:
        The (cells, cells) values from 0 to 1, by x and y, with the origin at the corner of the four cells in
        the middle; and an (n,) mask of the points in cells above 0.
    """
    x, y = (np.floor(points[:, :2] / CELL).astype(np.int64) + _SIDE // 2).T
    low, high = np.full((_SIDE, _SIDE), np.inf, np.float32), np.full((_SIDE, _SIDE), -np.inf, np.float32)
    np.minimum.at(low, (x, y), points[:, 2])
    np.maximum.at(high, (x, y), points[:, 2])
    extent = np.where(high > low, high, 0.0) - np.where(high > low, low, 0.0)
    least, full = _UPRIGHT
    cells = np.clip((extent - least) / (full - least), 0, 1).astype(np.float32)
    return cells, cells[x, y] > 0


def fits(
    source: _Plan,
    target: _Plan,
    turn: float,
    turn_error: float,
    shift: _Plan,
    shift_error: float,
    most: int,
) -> Fits:
    """Return the best fits of one grid on another near a guess.

    Args:
        source: (cells, cells) upright objects within ``SOURCE_REACH``, see :func:`upright_cells`.
        target: (cells, cells) upright objects within ``TARGET_REACH``.
        turn: guess of the source's rotation about z, rad.
        turn_error: largest error of ``turn``, rad.
        shift: (2,) guess of the source's origin in the target, m, within the window.
        shift_error: largest error of ``shift``, m.
        most: largest number of fits.
    """
    steps = int(np.ceil(turn_error / _TURN))
    turns = turn + _TURN * np.arange(-steps, steps + 1)
    x, y = np.nonzero(source)
    weight = source[x, y]
    centres = (np.stack([x, y], axis=1) + 0.5 - _SIDE // 2) * CELL
    turned = np.stack([_turned(centres, weight, angle) for angle in turns])
    under = rfft2(gaussian_filter(target, _BLUR).astype(np.float32))
    overlap = irfft2(under * rfft2(turned, axes=(1, 2)).conj(), (_SIDE, _SIDE), axes=(1, 2))
    share = overlap / max(float(weight.sum()), 1e-6)

    cells = np.arange(-WINDOW, WINDOW + 1)
    window = share[:, cells[:, None], cells]
    best_turn = np.argmax(window, axis=0)
    best = np.max(window, axis=0)
    places = np.stack(np.meshgrid(cells, cells, indexing="ij"), axis=-1) * CELL
    best = np.where(np.linalg.norm(places - shift, axis=-1) <= max(shift_error, CELL), best, -np.inf)
    found = []
    for _ in range(most):
        peak = np.unravel_index(np.argmax(best), best.shape)
        if not best[peak] > 0:
            break
        found.append((turns[best_turn[peak]], *places[peak], best[peak]))
        best = np.where(np.linalg.norm(places - places[peak], axis=-1) <= _APART, -np.inf, best)
    table = np.array(found).reshape(-1, 4)
    return Fits(table[:, 0], table[:, 1:3], table[:, 3])


def _turned(centres: _Plan, weight: _Plan, angle: float) -> _Plan:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = (np.floor(centres @ np.array([[cos, sin], [-sin, cos]]) / CELL).astype(np.int64) + _SIDE // 2).T
    inside = (x >= 0) & (x < _SIDE) & (y >= 0) & (y < _SIDE)
    cells = np.bincount(x[inside] * _SIDE + y[inside], weight[inside], _SIDE * _SIDE)
    return cells.reshape(_SIDE, _SIDE).astype(np.float32)


_Array = NDArray[np.float64]

_SPACING = 0.4
"""Edge of the cubes to which the aligned points are thinned, m."""
_BELIEVED = 0.03
"""Share of an alignment's information that is believed, because neighbouring points share the map's error."""
_OTHER_FIT = (2.0, 0.15)
"""Distances, m and rad, above which two fits are different."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """The decision on a proposal."""

    proposal: Proposal
    """The proposed loop."""
    accepted: bool
    """Whether the two keyframes saw the same place."""
    reason: str
    """Reason of the decision, in words."""
    T_target_source: _Array
    """(4, 4) aligned pose of the newer keyframe in the older one's frame, m; the guess if not aligned."""
    information: _Array
    """(6, 6) inverse covariance of its right perturbation, rotation (rad) before translation (m); zero if the
    loop was refused."""
    stated: _Array | None = None
    """(6, 6) the part of its covariance that the alignment states, see
    :func:`lio_jax.loops.edge_noise.loop_covariance`; None if the loop was refused."""
    fitness: float = np.inf
    """Mean squared distance to the map of the points that have a counterpart there, m^2."""
    overlap: float = 0.0
    """Share of the points on upright objects that agree with the map, 0 to 1."""
    conflict: float = 0.0
    """Share of the map's visible upright points that lie in space measured as empty, 0 to 1."""
    rival: float = 0.0
    """Overlap of the best different fit, as a share of this one's."""


def verify(
    proposal: Proposal, keyframes: Sequence[Keyframe], poses: _Array, settings: BackEndSettings
) -> Verdict:
    """Return the decision on a proposed loop.

    Args:
        proposal: the two keyframes, with a guess.
        keyframes: all so far.
        poses: (k, 4, 4) their T_world_imu, corrected so far, m.
        settings: ``config.loops`` and ``params.loop``.
    """
    limits, sizes = settings.values["loop"], settings.run.loops
    source, target = proposal.source, proposal.target
    if proposal.twin is not None:
        return refused(proposal, f"keyframe {proposal.twin}, where it cannot be, looks as much alike")
    old = is_old(keyframes, source, limits["time_gap"])
    around = range(max(0, target - sizes.submap_keyframes), target + sizes.submap_keyframes + 1)
    whole = [k for k in around if k < len(keyframes) and (old[k] or k == target)]
    members = same_piece(keyframes, target, whole)
    theirs = level_points(keyframes, poses, target, members, TARGET_REACH)
    before = same_piece(keyframes, source, range(max(0, source - sizes.source_keyframes + 1), source + 1))
    ours = level_points(keyframes, poses, source, before, SOURCE_REACH)
    level = _level(proposal.T_target_source, poses[target], poses[source])
    stations = poses[members, :3, 3] - poses[target, :3, 3]
    guess = Guess(heading_of(level), proposal.turn_error, level[:2, 3], proposal.shift_error)
    compared = compare(theirs, ours, guess, settings, stations, poses[[target, source]])
    if compared.problem:
        return refused(proposal, compared.problem)
    seen = level_points(keyframes, poses, source, [source], TARGET_REACH)

    def conflicting(T: _Array) -> float:
        return conflict(seen, compared.upright, T)

    return _judged(proposal, compared.candidates, conflicting, poses[[target, source]], limits)


class Guess(NamedTuple):
    """Where the source's points lie among the target's, and how wrong that may be."""

    turn: float
    """Rotation of the source about z, rad."""
    turn_error: float
    """Largest error of ``turn``, rad."""
    shift: _Plan
    """(2,) position of the source's origin in the target, m."""
    shift_error: float
    """Largest error of ``shift``, m."""


class Compared(NamedTuple):
    """Two clouds that were compared."""

    candidates: list[Candidate]
    """Alignments of the source with the target, the one with the most overlap first."""
    upright: NDArray[np.float32]
    """(m, 3) points of the target on upright objects, m."""
    problem: str
    """Why nothing was aligned; empty where something was."""


def compare(
    theirs: NDArray[np.float32],
    ours: NDArray[np.float32],
    guess: Guess,
    settings: BackEndSettings,
    stations: _Array | None = None,
    poses: _Array | None = None,
) -> Compared:
    """Fit the upright objects of two clouds, align the clouds from the fits, and measure the overlap.

    Args:
        theirs: (m, 3) points of the target in level axes, m, with |x| and |y| below ``TARGET_REACH``.
        ours: (n, 3) points of the source in level axes, m, with |x| and |y| below ``SOURCE_REACH``.
        guess: where to search.
        settings: ``config.loops`` and ``params.loop``.
        stations: (k, 3) positions from which the target was seen, m. None: the fits, at the target's height.
        poses: (2, 4, 4) current T_world_imu of the target and of the source, m; None: both at the origin.
    """
    sizes = settings.run.loops
    theirs, ours = thinned(theirs, _SPACING), thinned(ours, _SPACING)
    their_cells, their_upright = upright_cells(theirs)
    our_cells, our_upright = upright_cells(ours)
    upright = theirs[their_upright]
    if len(upright) < LEAST_POINTS or np.sum(our_upright) < LEAST_POINTS:
        return Compared([], upright, "nothing upright to compare")
    found = fits(our_cells, their_cells, *guess, sizes.starts)
    if not len(found.turn):
        return Compared([], upright, "no fit within the odometry's possible error")
    guesses = _guesses(found, np.zeros((1, 3)) if stations is None else stations)
    result = aligned(
        *padded(theirs, sizes.target_points),
        *padded(ours, sizes.source_points),
        guesses,
        sizes.starts,
        _aligning_params(settings),
    )
    stations = guesses[:, :3, 3] if stations is None else stations
    within = settings.values["loop"]["overlap_distance"]
    comparison = CloudComparison(theirs, stations, ours[our_upright], within)
    poses = np.tile(np.eye(4), (2, 1, 1)) if poses is None else poses
    return Compared(comparison.candidates(result, poses), upright, "")


def _judged(
    proposal: Proposal,
    candidates: list[Candidate],
    conflicting: Callable[[_Array], float],
    poses: _Array,
    limits: Mapping[str, Any],
) -> Verdict:
    error = possible_error(proposal.metres, limits)
    if not candidates:
        return refused(proposal, "the points could not be aligned")
    possible = [
        candidate
        for candidate in candidates
        if candidate.shift <= error.position
        and candidate.turn <= error.heading
        and candidate.tilt <= limits["tilt"]
    ]
    if not possible:
        best = candidates[0]
        return refused(
            proposal,
            f"{best.shift:.1f} m, {best.turn:.2f} rad of heading and {best.tilt:.2f} rad of tilt from "
            f"where the odometry is after {proposal.metres:.0f} m: more than it can be wrong",
        )
    best, *others = possible
    apart, turned = _OTHER_FIT
    rivals = [
        other.overlap
        for other in others
        if np.linalg.norm(other.T_target_source[:3, 3] - best.T_target_source[:3, 3]) > apart
        or abs(_wrapped(heading_of(other.T_target_source) - heading_of(best.T_target_source))) > turned
    ]
    rival = max(rivals, default=0.0) / max(best.overlap, 1e-9)
    against = conflicting(best.T_target_source)
    reason = ""
    if best.degenerate:
        reason = "the place leaves a direction open"
    elif best.overlap < limits["overlap"]:
        reason = f"only {best.overlap:.2f} of the points agree"
    elif best.fitness > limits["fitness"]:
        reason = f"fitness {best.fitness:.3f} m^2"
    elif against > limits["conflict"]:
        reason = f"{against:.2f} of what is in view stands where the scan saw through"
    elif rival > limits["rival"]:
        reason = f"another fit agrees with {rival:.2f} of the points that agree with the best"
    to_body = np.kron(np.eye(2), poses[1, :3, :3])
    information = np.zeros((6, 6))
    stated: _Array | None = None
    if not reason:
        stated = np.linalg.inv(_BELIEVED * to_body.T @ best.information @ to_body)
        information = _believed(stated, limits)
    left, right = np.eye(4), np.eye(4)
    left[:3, :3], right[:3, :3] = poses[0, :3, :3].T, poses[1, :3, :3]
    return Verdict(
        proposal,
        not reason,
        reason or f"{best.overlap:.2f} of the points agree",
        left @ best.T_target_source @ right,
        information,
        stated,
        best.fitness,
        best.overlap,
        against,
        rival,
    )


def refused(proposal: Proposal, reason: str) -> Verdict:
    """Return the verdict on a proposal that is refused before an alignment.

    Args:
        proposal: the two keyframes, with a guess.
        reason: reason of the refusal, in words.
    """
    return Verdict(proposal, False, reason, proposal.T_target_source, np.zeros((6, 6)))


def _believed(stated: _Array, limits: Mapping[str, Any]) -> _Array:
    """Return the information of a loop whose alignment states a covariance."""
    believed = np.linalg.inv(loop_covariance(stated, limits["rotation_sigma"], limits["translation_sigma"]))
    return np.asarray((believed + believed.T) / 2)


def _level(T_target_source: _Array, T_world_target: _Array, T_world_source: _Array) -> _Array:
    """Return a relative pose between two keyframes' level axes: the world axes that their poses imply."""
    level = np.eye(4)
    level[:3, :3] = T_world_target[:3, :3] @ T_target_source[:3, :3] @ T_world_source[:3, :3].T
    level[:3, 3] = T_world_target[:3, :3] @ T_target_source[:3, 3]
    return level


def _guesses(found: Fits, targets: _Array) -> _Array:
    """Return the (n, 4, 4) poses of the fits, m, at the height of the nearest of the target's keyframes.

    Args:
        found: fits in level axes.
        targets: (k, 3) positions of the target's keyframes, m.
    """
    guesses = np.tile(np.eye(4), (len(found.turn), 1, 1))
    guesses[:, :3, :3] = Rotation.from_euler("z", found.turn[:, None]).as_matrix()
    guesses[:, :2, 3] = found.shift
    apart = np.linalg.norm(targets[:, :2] - found.shift[:, None], axis=-1)
    guesses[:, 2, 3] = targets[np.argmin(apart, axis=1), 2]
    return guesses


def _aligning_params(settings: BackEndSettings) -> AlignmentParams:
    """Return the parameters of the alignment: the run's where its recipe has them, else the defaults."""
    values = {
        section: {name: settings.values[section].get(name, default) for name, default in leaves.items()}
        for section, leaves in numbers_of(AlignmentParams).items()
    }
    values["map"]["voxel_size"] = settings.values["loop"]["aligning_voxel"]
    return traced(AlignmentParams, values)


def _wrapped(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi
