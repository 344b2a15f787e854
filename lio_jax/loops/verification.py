"""Decide whether two keyframes saw the same place, and how they lie to each other.

Both are compared with what surrounds them: all fits of one on the other that the odometry's possible error
allows are found from above, aligned, and judged. A loop is accepted if one fit agrees, nothing stands where
the scan saw through, no direction is left open and no other fit comes near it. The last two refuse places
that repeat themselves.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.params import Params
from lio_jax.core.settings import Settings
from lio_jax.core.types import state_dtype
from lio_jax.loops.alignment import aligned
from lio_jax.loops.keyframe import Keyframe, level_points, padded, thinned
from lio_jax.loops.overlap import LEAST_POINTS, Candidate, Comparison, conflict
from lio_jax.loops.plan_view import SOURCE_REACH, TARGET_REACH, Fits, fits, upright_cells
from lio_jax.loops.proposals import Proposal, is_old, possible_error
from lio_jax.pose_graph.graph import heading_of

_Array = NDArray[np.float64]

_SPACING = 0.4
"""Of the points that are aligned, m."""
_OTHER_FIT = (2.0, 0.15)
"""Two fits are not the same if they are farther apart than this, m and rad."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What became of a proposal."""

    proposal: Proposal
    accepted: bool
    reason: str
    """Why, in words, for a reader."""
    T_target_source: _Array
    """(4, 4) as aligned; the guess where nothing was."""
    information: _Array
    """(6, 6) inverse covariance of its right perturbation, rotation (rad) first; zeros where refused."""
    fitness: float = np.inf
    """Mean squared distance to the map of the points that have it near, m^2."""
    overlap: float = 0.0
    """Share of points of upright things that agree with the map."""
    conflict: float = 0.0
    """Share of the map's upright things in view that stand where the scan saw through."""
    rival: float = 0.0
    """Points that agree with the best other fit, as a share of those that agree with this one."""


def verify(proposal: Proposal, keyframes: Sequence[Keyframe], poses: _Array, settings: Settings) -> Verdict:
    """Return whether a proposed loop holds.

    Args:
        proposal: which two keyframes.
        keyframes: all so far.
        poses: (k, 4, 4) their T_world_imu, corrected so far.
        settings: the run's. ``config.loops`` and ``params.loop`` say what is compared and accepted; the
            points are aligned with ``params.lidar``, ``params.map`` and ``params.registration``.
    """
    limits, sizes = settings.values["loop"], settings.config.loops
    source, target = proposal.source, proposal.target
    if proposal.twin is not None:
        return refused(proposal, f"keyframe {proposal.twin}, where it cannot be, looks as much alike")
    old = is_old(keyframes, source, limits["time_gap"])
    around = range(max(0, target - sizes.submap_keyframes), target + sizes.submap_keyframes + 1)
    members = [k for k in around if k < len(keyframes) and (old[k] or k == target)]
    theirs = level_points(keyframes, poses, target, members, TARGET_REACH)
    before = range(max(0, source - sizes.source_keyframes + 1), source + 1)
    ours = level_points(keyframes, poses, source, before, SOURCE_REACH)
    theirs, ours = thinned(theirs, _SPACING), thinned(ours, _SPACING)
    their_cells, their_upright = upright_cells(theirs)
    our_cells, our_upright = upright_cells(ours)
    if min(np.sum(their_upright), np.sum(our_upright)) < LEAST_POINTS:
        return refused(proposal, "nothing upright to compare")

    level = _level(proposal.T_target_source, poses[target], poses[source])
    found = fits(
        our_cells,
        their_cells,
        heading_of(level),
        proposal.turn_error,
        level[:2, 3],
        proposal.shift_error,
        sizes.starts,
    )
    if not len(found.turn):
        return refused(proposal, "no fit within the odometry's possible error")
    stations = poses[members, :3, 3] - poses[target, :3, 3]
    result = aligned(
        *padded(theirs, sizes.target_points),
        *padded(ours, sizes.source_points),
        _guesses(found, stations),
        sizes.starts,
        _aligning_params(settings),
    )
    comparison = Comparison(theirs, stations, ours[our_upright], limits["overlap_distance"])
    candidates = comparison.candidates(result, poses[[target, source]])
    seen = level_points(keyframes, poses, source, [source], TARGET_REACH)

    def conflicting(T: _Array) -> float:
        return conflict(seen, theirs[their_upright], T)

    return _judged(proposal, candidates, conflicting, poses[[target, source]], settings)


def _judged(
    proposal: Proposal,
    candidates: list[Candidate],
    conflicting: Callable[[_Array], float],
    poses: _Array,
    settings: Settings,
) -> Verdict:
    limits = settings.values["loop"]
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
    if not reason:
        information = _believed(to_body.T @ best.information @ to_body, settings.values)
    left, right = np.eye(4), np.eye(4)
    left[:3, :3], right[:3, :3] = poses[0, :3, :3].T, poses[1, :3, :3]
    return Verdict(
        proposal,
        not reason,
        reason or f"{best.overlap:.2f} of the points agree",
        left @ best.T_target_source @ right,
        information,
        best.fitness,
        best.overlap,
        against,
        rival,
    )


def refused(proposal: Proposal, reason: str) -> Verdict:
    """Return the verdict on a proposal that was not even aligned."""
    return Verdict(proposal, False, reason, proposal.T_target_source, np.zeros((6, 6)))


def _believed(information: _Array, values: dict[str, dict[str, Any]]) -> _Array:
    """Return the information that is left where neighbouring points share the map's error."""
    scale, limits = values["registration"]["information_scale"], values["loop"]
    sigmas = np.repeat([limits["rotation_sigma"], limits["translation_sigma"]], 3)
    believed = np.linalg.inv(np.linalg.inv(scale * information) + np.diag(sigmas**2))
    return (believed + believed.T) / 2


def _level(T_target_source: _Array, T_world_target: _Array, T_world_source: _Array) -> _Array:
    """Return a relative pose between two keyframes' level axes: those of the world that their poses imply."""
    level = np.eye(4)
    level[:3, :3] = T_world_target[:3, :3] @ T_target_source[:3, :3] @ T_world_source[:3, :3].T
    level[:3, 3] = T_world_target[:3, :3] @ T_target_source[:3, 3]
    return level


def _guesses(found: Fits, targets: _Array) -> _Array:
    """Return the fits' poses, at the height of the nearest of the target's keyframes, (n, 4, 4).

    Args:
        found: in level axes.
        targets: (k, 3) their positions, m.
    """
    guesses = np.tile(np.eye(4), (len(found.turn), 1, 1))
    guesses[:, :3, :3] = Rotation.from_euler("z", found.turn[:, None]).as_matrix()
    guesses[:, :2, 3] = found.shift
    apart = np.linalg.norm(targets[:, :2] - found.shift[:, None], axis=-1)
    guesses[:, 2, 3] = targets[np.argmin(apart, axis=1), 2]
    return guesses


def _aligning_params(settings: Settings) -> Params:
    """Return the run's parameters with the voxels that places are aligned with."""
    size = jnp.asarray(settings.values["loop"]["aligning_voxel"], state_dtype())
    return eqx.tree_at(lambda params: params.map.voxel_size, settings.params(), size)


def _wrapped(angle: float) -> float:
    return (angle + np.pi) % (2 * np.pi) - np.pi
