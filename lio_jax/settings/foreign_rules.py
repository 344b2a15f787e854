"""Rules that turn keys of another system's parameter file into settings, and their shared parts."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import UsageError

Take = Callable[[Any, str, Mapping[str, Any]], tuple[dict[str, Any], str]]
"""Function of a key's value, of its place (for messages) and of all values by name.

It returns this project's settings by path, and a remark on the conversion or on why there are no settings.
"""


@dataclass(frozen=True)
class Rule:
    """What is done with one key."""

    take: Take
    """Function that converts the key's value."""
    method: bool = False
    """Whether the key belongs to the system's own method, not to the sensors."""
    paths: tuple[str, ...] = ()
    """Settings that always take the key's value, converted or not."""


@dataclass(frozen=True, eq=False)
class System:
    """Another program and the rules for its parameters."""

    name: str
    """The program's name in messages."""
    recipe: str
    """The recipe that follows this program's method."""
    rules: Mapping[str, Rule]
    """Rules by the key's name without sections."""
    sections: tuple[str, ...] = ()
    """Names of the sections that a file must have."""
    other_sections: Mapping[str, Rule] = field(default_factory=dict)
    """Rules for sections whose keys are all treated alike."""


def same(*paths: str, word: str = "", method: bool = False) -> Rule:
    """Return the rule of a key that has the same meaning here, under the names ``paths``."""
    return Rule(lambda value, place, values: (dict.fromkeys(paths, value), word), method, paths)


def converted(*paths: str, by: Callable[[Any, str], Any], word: str, method: bool = False) -> Rule:
    """Return the rule of a key whose value is converted by ``by(value, place)``."""
    return Rule(lambda value, place, values: (dict.fromkeys(paths, by(value, place)), word), method, paths)


def nothing(why: str) -> Rule:
    """Return the rule of a key that has no counterpart here."""
    return Rule(lambda value, place, values: ({}, why))


def number(value: Any, place: str) -> float:
    """Return a finite number; YAML reads 1e-3 as text.

    Raises:
        UsageError: the value is no finite number.
    """
    try:
        result = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        result = math.nan
    if not math.isfinite(result):
        raise UsageError(f"{place} = {value!r} must be a number.")
    return result


def whole_number(value: Any, place: str) -> int:
    """Return a whole number.

    Raises:
        UsageError: the value is no whole number.
    """
    result = number(value, place)
    if result != int(result):
        raise UsageError(f"{place} = {value!r} must be a whole number.")
    return int(result)


def flag(value: Any, place: str) -> bool:
    """Return true or false.

    Raises:
        UsageError: the value is neither.
    """
    if not isinstance(value, bool):
        raise UsageError(f"{place} = {value!r} must be true or false.")
    return value


def vector(value: Any, place: str, count: int = 3) -> NDArray[np.float64]:
    """Return a list of ``count`` numbers, (count,).

    Raises:
        UsageError: the value is no such list.
    """
    if not isinstance(value, list) or len(value) != count:
        raise UsageError(f"{place} = {value!r} must be a list of {count} numbers.")
    return np.array([number(item, f"{place}, number {at}") for at, item in enumerate(value, 1)])


_ROUNDING = 1e-3
"""Largest accepted deviation from an orthonormal matrix: files write as few as three digits."""


_LARGEST_ENTRY = 1e6
"""Beyond this the nearest rotation is not computed: squares may overflow."""


def rotation(value: Any, place: str) -> Rotation:
    """Return the rotation given by nine numbers, row by row, or by three rows; the nearest rotation is taken.

    Raises:
        UsageError: wrong shape, or not orthonormal; the message suggests the nearest rotation.
    """
    if isinstance(value, list) and len(value) == 3 and all(isinstance(row, list) for row in value):
        value = [item for row in value for item in row]
    matrix = vector(value, place, 9).reshape(3, 3)
    if (largest := float(np.abs(matrix).max())) > _LARGEST_ENTRY:
        raise UsageError(
            f"{place} is not a rotation: it holds {largest:.4g}, but no number of one is beyond 1; write "
            "three perpendicular rows of length 1."
        )
    determinant = float(np.linalg.det(matrix))
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if error < _ROUNDING and determinant > 0:
        return Rotation.from_matrix(matrix)
    broken = f"{place} is not a rotation: its determinant is {determinant:.4g}"
    if error < _ROUNDING:
        raise UsageError(f"{broken}, so it mirrors an axis; change the sign of one row.")
    broken += f" and its rows are off orthonormal by {error:.2g}"
    left, scale, right = np.linalg.svd(matrix)
    if scale[-1] < 0.1 or determinant < 0:
        raise UsageError(f"{broken}; write three perpendicular rows of length 1.")
    nearest = [float(item) for item in np.round(left @ right, 6).ravel() + 0.0]
    raise UsageError(f"{broken}; the nearest rotation is {nearest}.")


def quaternion(turn: Rotation) -> list[float]:
    """Return the quaternion x y z w with w not negative, the form of ``params.extrinsics.rotation``."""
    return [float(item) for item in turn.as_quat(canonical=True) + 0.0]
