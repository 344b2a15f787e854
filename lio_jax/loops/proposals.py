"""Pairs of keyframes that may show the same place: near by distance, similar by descriptor, or from a file.

The length of the odometry between two keyframes bounds the error of their relative pose, and so the places
that are possible. Closed loops shorten that length.
"""

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
from lio_jax.core.files import read_text
from lio_jax.core.timestamps import seconds_to_ns
from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.place_descriptor import DescribedPlaces, Likeness

_ACROSS = 1.0
"""Length of odometry that has the same uncertainty as a closed loop, m."""


class Error(NamedTuple):
    """The largest possible error of relative poses."""

    position: NDArray[np.float64]
    """Largest error of the position, m."""
    heading: NDArray[np.float64]
    """Largest error of the heading, rad."""


AT_LEAST = Error(np.array(1.0), np.array(0.1))
"""Possible error of a relative pose after no odometry, because the keyframes' clouds are thinned."""


def possible_error(metres: NDArray[np.float64] | float, limits: Mapping[str, Any]) -> Error:
    """Return the largest possible error of relative poses after some metres of odometry.

    Args:
        metres: length of the odometry between the two poses, m.
        limits: ``params.loop`` as plain numbers.
    """
    run = np.asarray(metres, np.float64)
    position = np.asarray(AT_LEAST.position + limits["drift"] * run)
    heading = np.minimum(AT_LEAST.heading + limits["heading_drift"] * run, np.pi)
    return Error(position, np.asarray(heading))


def metres_of(keyframe: Keyframe, limits: Mapping[str, Any]) -> float:
    """Return the length of odometry after which drift is as large as the error of an outage, m.

    It is 0 where no outage ends with the keyframe. A drift of zero cannot stand for an outage's error; the
    other one of the two then decides.

    Args:
        keyframe: the first one after the outage.
        limits: ``params.loop`` as plain numbers.
    """
    errors = (keyframe.position_error, limits["drift"]), (keyframe.heading_error, limits["heading_drift"])
    return max((error / drift for error, drift in errors if drift > 0), default=0.0)


def metres_from(
    source: int, run: NDArray[np.float64], closed: Sequence[tuple[int, int]]
) -> NDArray[np.float64]:
    """Return the (k,) length of the odometry between a keyframe and every keyframe by the shortest path, m.

    A path may pass through closed loops, which stop the drift.

    Args:
        source: index of the keyframe.
        run: (k,) length of the odometry's path from the first keyframe to each one, m.
        closed: pairs of keyframes between which a loop is closed.
    """
    count = len(run)
    if not closed:
        return np.abs(run - run[source])
    first = np.arange(count - 1)
    loops = np.array(closed, np.int64).reshape(-1, 2)
    rows, columns = np.concatenate([first, loops[:, 0]]), np.concatenate([first + 1, loops[:, 1]])
    # a sparse matrix takes a length of zero as no edge
    lengths = np.concatenate([np.maximum(np.diff(run), 1e-6), np.full(len(loops), _ACROSS)])
    # a sparse matrix adds the lengths of an edge that is given twice
    key, index = np.unique(rows * count + columns, return_index=True)
    ways = csr_array((lengths[index], (key // count, key % count)), shape=(count, count))
    return dijkstra(ways, directed=False, indices=[source])[0]


_FORM = "time_a time_b [x y z qx qy qz qw]"


@dataclass(frozen=True, eq=False)
class Pair:
    """Two times at one place, from one line of the file."""

    line: int
    """Number of the line, from 1."""
    earlier_ns: int
    """Earlier time, ns."""
    later_ns: int
    """Later time, ns."""
    T_earlier_later: NDArray[np.float64] | None
    """(4, 4) guess of the later pose in the earlier one's frame, m; None if the line has none."""


def read_pairs(path: Path) -> list[Pair]:
    """Read lines ``time_a time_b [x y z qx qy qz qw]``.

    The times are in s. The pose T_a_b, in m, is that of the body at time b in its frame at time a. Commas may
    separate the numbers, and ``#`` begins a comment. The two times may come in either order.

    Args:
        path: path of the file.

    Returns:
        The pairs, ordered by their later time.

    Raises:
        UsageError: the file cannot be opened.
        LioJaxError: a line has another form; the message names it.
    """
    try:
        text = read_text(path, "give lines of 'time_a time_b [x y z qx qy qz qw]'")
    except OSError as error:
        raise UsageError(f"{path}: the pairs of times cannot be read ({error.strerror}).") from None
    pairs = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split("#")[0].replace(",", " ").split()
        if words:
            pairs.append(_pair(words, number, f"{path}, line {number}"))
    return sorted(pairs, key=lambda pair: pair.later_ns)


def keyframe_at(keyframes: Sequence[Keyframe], stamp_ns: int) -> int | None:
    """Return the index of the last keyframe at or before a time; None before the first keyframe.

    The body is near that keyframe at the time: otherwise there would be a later keyframe.

    Args:
        keyframes: at least all keyframes up to the time.
        stamp_ns: the time, ns.
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
    try:
        a, b = seconds_to_ns(words[0]), seconds_to_ns(words[1])
    except ValueError as error:
        raise LioJaxError(f"{place}: {error}.") from None
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
"""Possible error of a place, as a share of the radius, above which it is also searched by descriptor."""
_RIVAL = 1.25
"""Largest descriptor distance of a second place that is proposed too, over that of the best place."""
_TWIN = 1.1
"""Largest descriptor distance of an impossible place that makes the best place doubtful, over that of the
best place."""
_DESCRIBED_SHIFT = 12.0
"""Largest error of a position that follows from a descriptor, m."""
_GUESSED_TURN = 0.25
"""Largest error of a heading from a descriptor or from a file, rad."""


@dataclass(frozen=True, eq=False)
class Proposal:
    """Two keyframes that may have seen the same place."""

    source: int
    """Index of the newer keyframe."""
    target: int
    """Index of the older keyframe."""
    origin: Origin
    """How the pair was found."""
    T_target_source: NDArray[np.float64]
    """(4, 4) first guess of the newer pose in the older one's frame, m."""
    shift_error: float
    """Largest error of the guess in position, m."""
    turn_error: float
    """Largest error of the guess in heading, rad."""
    metres: float
    """Length of the odometry between the two by the shortest path, which may pass through closed loops, m."""
    twin: int | None = None
    """Index of another keyframe that is as similar, but too far away for the odometry's error; or None."""


def is_old(keyframes: Sequence[Keyframe], source: int, time_gap: float) -> NDArray[np.bool_]:
    """Return the (k,) mask of keyframes that are older than one of them by more than a time.

    Args:
        keyframes: all so far.
        source: index of the keyframe with which the others are compared.
        time_gap: least difference of age, s.
    """
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
        poses: (k, 4, 4) T_world_imu of all keyframes, corrected so far, m.
        old: (k,) True for keyframes that may be compared with the last.
        metres: (k,) length of the odometry between each keyframe and the last, m.
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
    """Return the proposal of two keyframes from a file.

    Args:
        source: index of the newer keyframe.
        target: index of the older keyframe.
        T_target_source: (4, 4) guess, m; None: the same position, with the heading by the odometry.
        poses: (k, 4, 4) T_world_imu of all keyframes, corrected so far, m.
        metres: length of the odometry between the two, m.
        limits: ``params.loop`` as plain numbers.
    """
    turn_error = _GUESSED_TURN
    if T_target_source is None:
        turn_error = float(possible_error(metres, limits).heading)
        T_target_source = np.eye(4)
        T_target_source[:3, :3] = poses[target, :3, :3].T @ poses[source, :3, :3]
    return Proposal(source, target, "external", T_target_source, limits["radius"], turn_error, metres)


def described_proposals(
    places: DescribedPlaces,
    poses: NDArray[np.float64],
    old: NDArray[np.bool_],
    metres: NDArray[np.float64],
    limits: Mapping[str, Any],
) -> list[Proposal]:
    """Return the newest keyframe with the most similar old one whose distance drift makes uncertain.

    The newest place is compared with all old places, because a place that is similar to several is no
    evidence for one of them. A second place that is about as similar, and that is possible, is proposed too:
    if both are accepted with different results, they are too similar. A second place that is not possible is
    noted as a twin.

    Args:
        places: descriptors of all keyframes.
        poses: (k, 4, 4) T_world_imu of all keyframes, corrected so far, m.
        old: (k,) True for keyframes that may be compared with the last.
        metres: (k,) length of the odometry between each keyframe and the last, m.
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
