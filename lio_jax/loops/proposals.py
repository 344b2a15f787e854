"""Which earlier keyframes the newest one is compared with."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.loops.drift import possible_error
from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.place_descriptor import Likeness, Places

Origin = Literal["radius", "descriptor", "external"]

_SHARE_OF_RADIUS = 0.5
"""Places whose distance may be wrong by more than this share of the radius are also sought by descriptor."""
_RIVAL = 1.25
"""A second place is compared if its descriptor differs by no more than this many times the best one's."""
_TWIN = 1.1
"""The same for places that are out of the question: they make the best one doubtful without comparison."""
_DESCRIBED_SHIFT = 12.0
"""By how much the place of the keyframe that looks most alike may be off, m."""
_GUESSED_TURN = 0.25
"""By how much a described or a given heading may be off, rad."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """Two keyframes that may have seen the same place."""

    source: int
    """Index of the newer keyframe."""
    target: int
    """Index of the older keyframe."""
    origin: Origin
    T_target_source: NDArray[np.float64]
    """(4, 4) first guess."""
    shift_error: float
    """By how much the guess may be wrong in position, m ..."""
    turn_error: float
    """... and in heading, rad."""
    metres: float
    """Of odometry between the two along the shortest way, closed loops being short cuts."""
    twin: int | None = None
    """Another keyframe that looks as much alike, where the odometry cannot have been."""


def is_old(keyframes: Sequence[Keyframe], source: int, time_gap: float) -> NDArray[np.bool_]:
    """Return which keyframes are older than one of them by more than ``time_gap`` s, (k,)."""
    stamps = np.array([keyframe.stamp_ns for keyframe in keyframes])
    return (stamps[source] - stamps) > time_gap * 1e9


def nearest_proposal(
    poses: NDArray[np.float64],
    old: NDArray[np.bool_],
    metres: NDArray[np.float64],
    limits: dict[str, Any],
) -> list[Proposal]:
    """Return the newest keyframe with the nearest old one, if there is one within the radius.

    Args:
        poses: (k, 4, 4) T_world_imu of all keyframes, corrected so far.
        old: (k,) which may be compared with the last.
        metres: (k,) of odometry between each and the last.
        limits: ``params.loop`` as plain numbers.
    """
    distance = np.where(old, np.linalg.norm(poses[:, :3, 3] - poses[-1, :3, 3], axis=1), np.inf)
    target = int(np.argmin(distance))
    if not distance[target] <= limits["radius"]:
        return []
    guess = np.linalg.inv(poses[target]) @ poses[-1]
    error = possible_error(metres[target], limits)
    shift_error = min(float(error.position), limits["radius"])
    return [
        Proposal(
            len(poses) - 1, target, "radius", guess, shift_error, float(error.heading), float(metres[target])
        )
    ]


def external_proposal(
    source: int,
    target: int,
    T_target_source: NDArray[np.float64] | None,
    poses: NDArray[np.float64],
    metres: float,
    limits: dict[str, Any],
) -> Proposal:
    """Return two keyframes that something else proposed.

    Args:
        source: index of the newer one.
        target: index of the older one.
        T_target_source: (4, 4) guess; None: the same place, with the heading that the odometry has.
        poses: (k, 4, 4) T_world_imu of all keyframes, corrected so far.
        metres: of odometry between the two.
        limits: ``params.loop`` as plain numbers.
    """
    turn_error = _GUESSED_TURN
    if T_target_source is None:
        turn_error = float(possible_error(metres, limits).heading)
        T_target_source = np.eye(4)
        T_target_source[:3, :3] = poses[target, :3, :3].T @ poses[source, :3, :3]
    return Proposal(source, target, "external", T_target_source, limits["radius"], turn_error, metres)


def described_proposals(
    places: Places,
    poses: NDArray[np.float64],
    old: NDArray[np.bool_],
    metres: NDArray[np.float64],
    limits: dict[str, Any],
) -> list[Proposal]:
    """Return the newest keyframe with the old one that looks most alike, where drift may hide its distance.

    It is compared with all old places, for a place that looks like several is no evidence of any. Another one
    about as much alike that may be the right one as well is proposed too: both being accepted with different
    results tells that they are too similar. One that cannot be the right one is noted as a twin.

    Args:
        places: descriptors of all keyframes.
        poses: (k, 4, 4) T_world_imu of all keyframes, corrected so far.
        old: (k,) which may be compared with the last.
        metres: (k,) of odometry between each and the last.
        limits: ``params.loop`` as plain numbers.
    """
    error = possible_error(metres, limits)
    distance = np.linalg.norm(poses[:, :3, 3] - poses[-1, :3, 3], axis=1)
    possible = distance <= error.position + limits["radius"]
    hidden = old & (error.position > _SHARE_OF_RADIUS * limits["radius"])
    if not np.any(hidden & possible):
        return []
    (compared,) = np.nonzero(hidden)
    everywhere = places.compared(poses, compared, error.heading[compared])
    found = everywhere.among(possible[everywhere.index])
    best = _most_alike(found, limits["descriptor_distance"])
    if best is None:
        return []
    likeness = found.distance[best]

    def elsewhere(some: Likeness) -> Likeness:
        away = np.linalg.norm(poses[some.index, :3, 3] - poses[found.index[best], :3, 3], axis=1)
        return some.among(away > 2 * limits["radius"])

    impossible = elsewhere(everywhere.among(~possible[everywhere.index]))
    twin = _most_alike(impossible, _TWIN * likeness)
    first = _described(found, best, poses, metres)
    if twin is not None:
        return [replace(first, twin=int(impossible.index[twin]))]
    rivals = elsewhere(found)
    rival = _most_alike(rivals, _RIVAL * likeness)
    return [first] if rival is None else [first, _described(rivals, rival, poses, metres)]


def _most_alike(found: Likeness, limit: float) -> int | None:
    if not len(found.distance) or not np.min(found.distance) <= limit:
        return None
    return int(np.argmin(found.distance))


def _described(
    found: Likeness, row: int, poses: NDArray[np.float64], metres: NDArray[np.float64]
) -> Proposal:
    target = int(found.index[row])
    guess = found.T_target_source(row, poses)
    return Proposal(
        len(poses) - 1, target, "descriptor", guess, _DESCRIBED_SHIFT, _GUESSED_TURN, float(metres[target])
    )
