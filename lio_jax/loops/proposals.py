"""Pairs of keyframes that may show the same place: by distance, by descriptor, from a file."""

import math
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.timestamps import seconds_to_ns
from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.place_descriptor import Likeness, Places

_ACROSS = 1.0
"""A closed loop is as sure as this much odometry, m."""


class Error(NamedTuple):
    """Largest error of a relative pose that is believed."""

    position: NDArray[np.float64]
    """m."""
    heading: NDArray[np.float64]
    """rad."""


AT_LEAST = Error(np.array(1.0), np.array(0.1))
"""What is possible however short the way: the keyframes' clouds are thinned."""


def possible_error(metres: NDArray[np.float64] | float, limits: Mapping[str, Any]) -> Error:
    """Return how wrong relative poses may be after so many metres of odometry.

    Args:
        metres: run between the two poses.
        limits: ``params.loop`` as plain numbers.
    """
    run = np.asarray(metres, np.float64)
    position = np.asarray(AT_LEAST.position + limits["drift"] * run)
    heading = np.minimum(AT_LEAST.heading + limits["heading_drift"] * run, np.pi)
    return Error(position, np.asarray(heading))


def metres_from(
    source: int, run: NDArray[np.float64], closed: Sequence[tuple[int, int]]
) -> NDArray[np.float64]:
    """Return the odometry between a keyframe and every other along the shortest way, (k,) m.

    A way may take closed loops as short cuts: after one the drift begins anew.

    Args:
        source: number of the keyframe.
        run: (k,) what the odometry has run up to each, m.
        closed: pairs of keyframes that loops tie together.
    """
    count = len(run)
    if not closed:
        return np.abs(run - run[source])
    first = np.arange(count - 1)
    loops = np.array(closed, np.int64).reshape(-1, 2)
    rows, columns = np.concatenate([first, loops[:, 0]]), np.concatenate([first + 1, loops[:, 1]])
    # a sum of none would be no edge at all
    lengths = np.concatenate([np.maximum(np.diff(run), 1e-6), np.full(len(loops), _ACROSS)])
    # of edges given twice a sparse matrix takes the sum
    key, index = np.unique(rows * count + columns, return_index=True)
    ways = csr_array((lengths[index], (key // count, key % count)), shape=(count, count))
    return dijkstra(ways, directed=False, indices=[source])[0]


_FORM = "time_a time_b [x y z qx qy qz qw]"


@dataclass(frozen=True, eq=False)
class Pair:
    """One line of the file."""

    line: int
    earlier_ns: int
    later_ns: int
    T_earlier_later: NDArray[np.float64] | None
    """(4, 4) guess of the later pose in the earlier one's frame."""


def read_pairs(path: Path) -> list[Pair]:
    """Read lines ``time_a time_b [x y z qx qy qz qw]``: s, m, pose T_a_b of the body at b in its frame at a.

    Commas may separate the numbers; ``#`` begins a comment. The two times may come in either order.

    Returns:
        The pairs by their later time.

    Raises:
        UsageError: there is no such file.
        LioJaxError: a line is something else; the message names it.
    """
    try:
        text = path.read_text()
    except OSError as error:
        raise UsageError(f"{path}: the pairs of times cannot be read ({error.strerror}).") from None
    except UnicodeDecodeError:
        raise LioJaxError(
            f"{path}: not a text file; give lines of 'time_a time_b [x y z qx qy qz qw]'."
        ) from None
    pairs = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            pairs.append(_pair(words, number, f"{path}, line {number}"))
    return sorted(pairs, key=lambda pair: pair.later_ns)


def keyframe_at(keyframes: Sequence[Keyframe], stamp_ns: int) -> int | None:
    """Return the last keyframe up to a time: had the body moved away, there would be a later one.

    Args:
        keyframes: all up to the time, at least.
        stamp_ns: the time.

    Returns:
        Its index; None before the first.
    """
    after = bisect_right(keyframes, stamp_ns, key=lambda keyframe: keyframe.stamp_ns)
    return after - 1 if after else None


def _pair(words: list[str], number: int, place: str) -> Pair:
    if len(words) not in (2, 9):
        raise LioJaxError(
            f"{place}: {len(words)} numbers; give two times and, if it is known, the pose between them: "
            f"{_FORM}."
        )
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise LioJaxError(f"{place}: '{' '.join(words)}' are not all numbers.") from None
    if not all(math.isfinite(value) for value in values):
        raise LioJaxError(f"{place}: '{' '.join(words)}' are not all finite.")
    a, b = seconds_to_ns(words[0]), seconds_to_ns(words[1])
    if a == b:
        raise LioJaxError(f"{place}: both times are {words[0]}; a loop needs two.")
    T_a_b = _pose(values[2:], place) if len(values) > 2 else None
    if a < b:
        return Pair(number, a, b, T_a_b)
    T_b_a = None if T_a_b is None else np.linalg.inv(T_a_b).astype(np.float64)
    return Pair(number, b, a, T_b_a)


def _pose(values: list[float], place: str) -> NDArray[np.float64]:
    pose = np.eye(4)
    pose[:3, 3] = values[:3]
    quaternion = np.array(values[3:])
    norm = np.linalg.norm(quaternion)
    if not abs(norm - 1) < 1e-2:
        raise LioJaxError(f"{place}: the quaternion x y z w has norm {norm:.4g}; give one of unit length.")
    pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    return pose


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
    limits: Mapping[str, Any],
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
    limits: Mapping[str, Any],
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
    limits: Mapping[str, Any],
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
