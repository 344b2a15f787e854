"""Find all fits of one place on another, seen from above, with upright objects in a grid.

The method is correlative scan matching (Olson, "Real-time correlative scan matching", ICRA 2009), where
Fourier transforms evaluate all shifts of a rotation at once. It needs a guess only within its window, and it
finds every fit and not only the nearest one. Several good fits indicate a place with repeated structure.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.ndimage import gaussian_filter

_Array = NDArray[np.floating]

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

    turn: _Array
    """(n,) rotations of the source about z, rad."""
    shift: _Array
    """(n, 2) positions of the source's origin in the target, m."""
    share: _Array
    """(n,) share of the source's upright objects that lie on upright objects of the target, 0 to 1."""


def upright_cells(points: NDArray[np.float32]) -> tuple[_Array, NDArray[np.bool_]]:
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
    source: _Array,
    target: _Array,
    turn: float,
    turn_error: float,
    shift: _Array,
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


def _turned(centres: _Array, weight: _Array, angle: float) -> _Array:
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = (np.floor(centres @ np.array([[cos, sin], [-sin, cos]]) / CELL).astype(np.int64) + _SIDE // 2).T
    inside = (x >= 0) & (x < _SIDE) & (y >= 0) & (y < _SIDE)
    cells = np.bincount(x[inside] * _SIDE + y[inside], weight[inside], _SIDE * _SIDE)
    return cells.reshape(_SIDE, _SIDE).astype(np.float32)
