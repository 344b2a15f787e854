"""How a key of another system's parameter file becomes settings; what the rules for all systems share."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import UsageError

Take = Callable[[Any, str, Mapping[str, Any]], tuple[dict[str, Any], str]]
"""From a key's value, its place for messages and all values by name: our settings by path, and a word on the
conversion, or on why there are none."""


@dataclass(frozen=True)
class Rule:
    """What is done with a key."""

    take: Take
    method: bool = False
    """The key belongs to the system's own method, not to the sensors."""


@dataclass(frozen=True, eq=False)
class System:
    """Another program and its parameters."""

    name: str
    recipe: str
    """The recipe that stands for it."""
    rules: Mapping[str, Rule]
    """By the key's name without sections."""
    sections: tuple[str, ...] = ()
    """Those that a file has to have."""
    other_sections: Mapping[str, Rule] = field(default_factory=dict)
    """Sections of which all keys go the same way."""


def same(*paths: str, word: str = "", method: bool = False) -> Rule:
    """Return the rule of a key that means the same here: under the names ``paths``."""
    return Rule(lambda value, place, values: (dict.fromkeys(paths, value), word), method)


def converted(*paths: str, by: Callable[[Any, str], Any], word: str, method: bool = False) -> Rule:
    """Return the rule of a key whose value is converted: ``by(value, place)``."""
    return Rule(lambda value, place, values: (dict.fromkeys(paths, by(value, place)), word), method)


def nothing(why: str) -> Rule:
    """Return the rule of a key without counterpart."""
    return Rule(lambda value, place, values: ({}, why))


def number(value: Any, place: str) -> float:
    """Return a finite number; YAML reads 1e-3 as text.

    Raises:
        UsageError: it is none.
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
        UsageError: it is none.
    """
    result = number(value, place)
    if result != int(result):
        raise UsageError(f"{place} = {value!r} must be a whole number.")
    return int(result)


def flag(value: Any, place: str) -> bool:
    """Return true or false.

    Raises:
        UsageError: it is neither.
    """
    if not isinstance(value, bool):
        raise UsageError(f"{place} = {value!r} must be true or false.")
    return value


def vector(value: Any, place: str, count: int = 3) -> NDArray[np.float64]:
    """Return a list of ``count`` numbers, (count,).

    Raises:
        UsageError: it is none.
    """
    if not isinstance(value, list) or len(value) != count:
        raise UsageError(f"{place} = {value!r} must be a list of {count} numbers.")
    return np.array([number(item, f"{place}, number {at}") for at, item in enumerate(value, 1)])


_ROUNDING = 1e-3
"""Files write matrices with as few as three digits; the nearest rotation is taken."""


def rotation(value: Any, place: str) -> Rotation:
    """Return the rotation of nine numbers, row by row, or of three rows.

    Raises:
        UsageError: wrong shape, or not orthonormal: the message suggests the nearest rotation.
    """
    if isinstance(value, list) and len(value) == 3 and all(isinstance(row, list) for row in value):
        value = [item for row in value for item in row]
    matrix = vector(value, place, 9).reshape(3, 3)
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
    """Return x y z w with w not negative, as ``params.extrinsics.rotation`` takes it."""
    return [float(item) for item in turn.as_quat(canonical=True) + 0.0]
