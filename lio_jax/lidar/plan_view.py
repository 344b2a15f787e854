"""Plan view of a scan: the cells of a level grid in which something stands upright, and how two such views
match.

Scan lines on the ground and on low rails move with the sensor, so that they fit best where nothing has moved.
Walls, trunks, poles and cars do not depend on where the scan lines fall.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

CELL = 0.5
"""Edge length of a cell, m."""
_UPRIGHT = 1.0
"""Vertical extent of the points of a cell in which something stands, m. Guard rails are lower."""
_NEAREST, _FARTHEST = 2.0, 60.0
"""Horizontal range of the points that are used, m."""
FINE = 0.25
"""Distance between two displacements that are tried, m."""
_PEAK, _APART = 0.8, 1.2
"""Displacements nearer to the best one belong to it; farther ones are rivals, m."""


class PlanView(NamedTuple):
    """The cells of one scan in which something stands."""

    occupied: NDArray[np.bool_]
    """(n, n) True where something stands; the sensor is in the middle."""
    centers: NDArray[np.float32]
    """(k, 2) mean positions of the points of these cells, m, level axes."""

    def turned(self, angle: float) -> NDArray[np.float32]:
        """Return the centers after a turn about the vertical, (k, 2) m.

        Args:
            angle: rad.
        """
        cos, sin = np.cos(angle), np.sin(angle)
        return self.centers @ np.array([[cos, sin], [-sin, cos]], np.float32)


class Displacement(NamedTuple):
    """The best displacement between two plan views."""

    shift: NDArray[np.float64]
    """(2,) m, from the first sensor position to the second, level axes."""
    votes: int
    """Number of cells of the second view that are occupied in the first view after the displacement."""
    share: float
    """The same over the number of all cells of the second view."""
    votes_of_rival: int
    """Largest number of votes of a displacement that is more than 1.2 m from the best one."""

    @property
    def is_certain(self) -> bool:
        """Return whether no rival explains the views nearly as well."""
        return self.share > 0.5 and self.votes - self.votes_of_rival > self.least_lead

    @property
    def least_lead(self) -> float:
        """Number of votes by which the best displacement has to lead."""
        return max(3 * self.votes**0.5, 0.15 * self.votes)


def plan_view(points: NDArray[np.float32]) -> PlanView:
    """Return the cells in which something stands.

    Args:
        points: (m, 3) m, in level axes about the sensor; finite.
    """
    horizontal = np.hypot(points[:, 0], points[:, 1])
    points = points[(horizontal > _NEAREST) & (horizontal < _FARTHEST)]
    occupied = np.zeros((_WIDTH, _WIDTH), np.bool_)
    if not len(points):
        return PlanView(occupied, np.zeros((0, 2), np.float32))
    cell = _cell_of(points[:, :2])
    order = np.argsort(cell, kind="stable")
    cell, points = cell[order], points[order]
    first = np.flatnonzero(np.diff(cell, prepend=-1))
    height = np.maximum.reduceat(points[:, 2], first) - np.minimum.reduceat(points[:, 2], first)
    count = np.diff(first, append=len(points))
    centers = np.add.reduceat(points[:, :2], first) / count[:, None]
    upright = height > _UPRIGHT
    occupied.ravel()[cell[first][upright]] = True
    return PlanView(occupied, centers[upright].astype(np.float32))


def displacement(
    first: PlanView, centers: NDArray[np.float32], reach: float, step: float = FINE
) -> Displacement:
    """Return the displacement with the most votes; its precision is about 0.1 m.

    Args:
        first: the view from the first position.
        centers: (k, 2) those of the view from the second position, in the same axes, m.
        reach: longest displacement to try, m; at most 20 m is tried.
        step: distance between two displacements that are tried, m.
    """
    steps = int(min(reach, _LONGEST) / step)
    axis = np.arange(-steps, steps + 1) * step
    tried = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    length = np.linalg.norm(tried, axis=1)
    tried, length = tried[length <= reach + 1e-9], length[length <= reach + 1e-9]
    moved = centers + tried[:, None].astype(np.float32)
    votes = first.occupied.ravel()[_cell_of(moved)].sum(axis=1)
    best = int(np.argmax(votes))
    apart = np.linalg.norm(tried - tried[best], axis=1)
    peak = (apart <= _PEAK) & (votes >= 0.9 * votes[best])
    return Displacement(
        shift=np.average(tried[peak], axis=0, weights=np.maximum(votes[peak], 1)),
        votes=int(votes[best]),
        share=float(votes[best] / max(len(centers), 1)),
        votes_of_rival=int(votes[apart > _APART].max(initial=0)),
    )


_LONGEST = 20.0
_WIDTH = int(2 * (_FARTHEST + _LONGEST) / CELL) + 2
"""Number of cells along an edge of the grid: no displaced point falls outside."""


def _cell_of(positions: NDArray[np.float32]) -> NDArray[np.int32]:
    """Return the number of the cell of each (..., 2) position."""
    index = np.floor(positions / np.float32(CELL)).astype(np.int32) + _WIDTH // 2
    return index[..., 0] * _WIDTH + index[..., 1]
