"""Straight walls with door openings, as boxes."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.assembly import upright

HALF_THICKNESS = 0.06
"""Of a wall, m."""
DOOR_HEIGHT = 2.1
"""m."""


def wall(
    begin: tuple[float, float],
    end: tuple[float, float],
    heights: tuple[float, float],
    reflectivity: float,
    doors: Sequence[tuple[float, float]] = (),
) -> NDArray[np.float64]:
    """Return the box rows of a wall along x or y.

    Args:
        begin: one end, of the lower coordinates, m.
        end: the other, m.
        heights: of foot and top, m.
        reflectivity: 0 to 1.
        doors: distance of each opening's middle from ``begin`` and its width, in order, m.
    """
    axis = 0 if end[0] != begin[0] else 1
    across = 1 - axis
    length = end[axis] - begin[axis]
    edges = [0.0, *(middle + side * width / 2 for middle, width in doors for side in (-1, 1)), length]
    piers = [(low, high, heights[0]) for low, high in zip(edges[::2], edges[1::2], strict=True)]
    lintels = [
        (low - HALF_THICKNESS, high + HALF_THICKNESS, heights[0] + DOOR_HEIGHT)
        for low, high in zip(edges[1:-1:2], edges[2:-1:2], strict=True)
    ]
    # walls reach into what they meet, lintels into their piers, so that no ray slips through
    piers[0] = (-HALF_THICKNESS, *piers[0][1:])
    piers[-1] = (piers[-1][0], length + HALF_THICKNESS, heights[0])
    rows = []
    for low, high, foot in piers + lintels:
        near, far = np.array([*begin, foot]), np.array([*begin, heights[1]])
        near[axis], far[axis] = begin[axis] + low, begin[axis] + high
        near[across], far[across] = begin[across] - HALF_THICKNESS, begin[across] + HALF_THICKNESS
        rows.append(upright(near, far, reflectivity))
    return np.concatenate(rows)


def open_leaf(
    hinge: tuple[float, float], heading: float, width: float, foot: float, reflectivity: float
) -> NDArray[np.float64]:
    """Return the box row of a door leaf that stands off its hinge towards ``heading`` (rad)."""
    x = hinge[0] + np.cos(heading) * width / 2
    y = hinge[1] + np.sin(heading) * width / 2
    return np.array([[x, y, foot + DOOR_HEIGHT / 2, width / 2, 0.02, DOOR_HEIGHT / 2, heading, reflectivity]])
