"""Pairs of times at which another method, or a person, found the same place: a text file of loops to try."""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.timestamps import seconds_to_ns
from lio_jax.loops.keyframe import Keyframe

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
