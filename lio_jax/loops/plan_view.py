"""How two places may fit on each other, seen from above: upright things in a grid, all shifts at once.

Correlative scan matching (Olson, "Real-time correlative scan matching", ICRA 2009) with the shifts of each
turn found together by Fourier transforms. It needs no guess nearer than its window and shows every fit, not
only the nearest: rivals of the best one tell of places that repeat themselves.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, rfft2
from scipy.ndimage import gaussian_filter

_Array = NDArray[np.floating]

CELL = 1.0
"""Of the grid, m."""
_SIDE = 128
"""Cells of the grid."""
WINDOW = 16
"""Largest shift either way, cells: at the grid's edge so many are left for it."""
SOURCE_REACH = (_SIDE // 2 - WINDOW) * CELL
"""Of the points that are shifted, m ..."""
TARGET_REACH = _SIDE // 2 * CELL
"""... and of those they are laid upon."""
_UPRIGHT = (0.4, 2.0)
"""Differences of height within a cell from which a thing is upright, and from which it counts in full, m."""
_TURN = 0.05
"""Between the turns that are tried, rad."""
_APART = 3.0
"""Fits nearer to a better one than this are the same fit, m."""
_BLUR = 0.8
"""Of the grid that is laid upon, cells: half a cell and half a turn's step are lost otherwise."""


class Fits(NamedTuple):
    """Shifts and turns of the source at which it fits on the target, the best first."""

    turn: _Array
    """(n,) rad, about z."""
    shift: _Array
    """(n, 2) m."""
    share: _Array
    """(n,) of the source's upright things that have such under them, 0 to 1."""


def upright_cells(points: NDArray[np.float32]) -> tuple[_Array, NDArray[np.bool_]]:
    """Return how much each cell of the grid holds of upright things, and which points belong to them.

    Args:
        points: (n, 3) m, within ``TARGET_REACH`` of the origin in plan, z up.

    Returns:
        (cells, cells) from 0 to 1, by x and y, the origin being the corner of the four cells in the middle.
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
        source: (cells, cells) of things within ``SOURCE_REACH``.
        target: (cells, cells).
        turn: guess, rad.
        turn_error: by how much it may be wrong, rad.
        shift: (2,) guess, m: where the source's origin lies in the target; within the window.
        shift_error: by how much it may be wrong, m.
        most: number of fits at most.
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
