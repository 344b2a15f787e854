"""Names for the directions of motion that a scan does not show."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

_NAMED = 0.8
"""Share of an axis that must lie in the unobserved directions to name them after it."""
_MOVING = 0.5
"""Slower than this the direction of motion is not known, m/s."""


def unobserved_directions(registration: Any, nav: Any) -> list[str]:
    """Return words for the degenerate directions of a scan match, as many as there are.

    Horizontal ones are told from the direction of motion, at rest from the IMU's x axis; the vertical is the
    world's z. A direction beside these axes is given by its components.

    Args:
        registration: a scan match whose degenerate directions hold no information, or the least.
        nav: navigation state at the scan's end.
    """
    weak = weak_directions(registration)
    missing = weak.shape[1]

    heading, name = _heading(nav)
    axes = np.stack([heading, np.cross([0.0, 0.0, 1.0], heading), [0.0, 0.0, 1.0]])
    named: list[str] = []
    for row, words in (
        (3, (f"along {name}", f"across {name}", "along the vertical")),
        (0, ("in roll", "in pitch", "in yaw")),
    ):
        for axis, word in zip(axes, words, strict=True):
            within = weak[row : row + 3].T @ axis
            if len(named) < missing and within @ within > _NAMED:
                named.append(word)
                weak = _without(weak, np.concatenate([axis * (row == 0), axis * (row == 3)]))
    return named + [_components(vector) for vector in weak.T[: missing - len(named)]]


def weak_directions(registration: Any) -> NDArray[np.float64]:
    """Return the (6, k) directions a scan match does not observe, rotation before translation, in world axes.

    Rotations are scaled to metres of a typical point, so that the six compare.
    """
    missing = int(np.sum(registration.degenerate))
    R_world_lidar = Rotation.from_quat(
        np.asarray(registration.T_world_lidar.wxyz_xyz)[:4], scalar_first=True
    ).as_matrix()
    to_world = np.kron(np.eye(2), R_world_lidar)
    information = to_world @ np.asarray(registration.information, np.float64) @ to_world.T
    arm = np.sqrt(np.trace(information[:3, :3]) / max(np.trace(information[3:, 3:]), 1e-300)) + 1e-6
    scale = np.repeat([1 / arm, 1.0], 3)
    _, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    return vectors[:, :missing]


def _heading(nav: Any) -> tuple[NDArray[np.float64], str]:
    """Return a horizontal unit vector in world, and what it is."""
    wxyz = np.asarray(nav.T_world_imu.wxyz_xyz, np.float64)[:4]
    moving = np.asarray(nav.velocity, np.float64) * [1, 1, 0]
    x_axis = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()[:, 0] * [1, 1, 0]
    for vector, least, name in ((moving, _MOVING, "the motion"), (x_axis, 0.1, "the IMU's x axis")):
        if (length := np.linalg.norm(vector)) > least:
            return vector / length, name
    return np.array([1.0, 0.0, 0.0]), "the world's x axis"


def _without(weak: NDArray[np.float64], direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the basis (6, k) of what is left of a space once its part along ``direction`` is named."""
    along = weak.T @ direction
    along /= np.linalg.norm(along)
    rest, _, _ = np.linalg.svd(np.eye(len(along)) - np.outer(along, along))
    return weak @ rest[:, : len(along) - 1]


def _components(vector: NDArray[np.float64]) -> str:
    turn, move = vector[:3], vector[3:]
    kind, part = ("along", move) if np.linalg.norm(move) > np.linalg.norm(turn) else ("turning about", turn)
    # either sign means the same; adding zero turns a rounded -0.0 into 0.0
    unit = part / np.linalg.norm(part) * np.sign(part[np.argmax(np.abs(part))])
    x, y, z = np.round(unit, 2) + 0.0
    return f"{kind} ({x:.2f}, {y:.2f}, {z:.2f}) in world"
