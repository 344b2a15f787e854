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
_FEWEST = 8
"""So few votes may come from one vehicle that moves along."""
_FINE_CELL, _FINE_STEP, _FINE_REACH = 0.1, 0.05, 0.35
"""Edge length of a cell, distance between displacements and largest correction where one is refined, m."""
_ABOVE_GROUND = 0.3
"""Points lower than this above their cell's lowest one are left out there: scan lines on the ground, m."""
_REFINED_POINTS = 3000
"""A displacement is refined with about so many points."""


class PlanView(NamedTuple):
    """The cells of one scan in which something stands."""

    occupied: NDArray[np.bool_]
    """(n, n) True where something stands; the sensor is in the middle."""
    centers: NDArray[np.float32]
    """(k, 2) mean positions of the points of these cells, m, level axes."""
    points: NDArray[np.float32]
    """(m, 2) positions of the points above the ground in these cells, m, level axes."""


class Displacement(NamedTuple):
    """The best displacement between two plan views."""

    shift: NDArray[np.float64]
    """(2,) m, from the first sensor position to the second, level axes."""
    votes: int
    """Number of cells of the second view that are occupied in the first view after the displacement."""
    share: float
    """The same over the number of all cells of the second view."""
    own_votes: int
    """Number of cells that vote for this displacement and not for its strongest rival, which is the
    displacement with the most votes of those more than 1.2 m away."""
    rival_votes: int
    """Number of cells that vote for that rival and not for this displacement."""

    @property
    def is_certain(self) -> bool:
        """Return whether no rival explains the views nearly as well."""
        # cells of a wall along the way vote for both, and say nothing
        lead = self.own_votes - self.rival_votes
        is_seen = self.votes > _FEWEST and self.share > 0.5
        return is_seen and lead > 0.15 * self.votes and leads(self.own_votes, self.rival_votes)


def leads(votes: int, rival: int) -> bool:
    """Return whether chance does not explain by how many votes one displacement leads another."""
    return votes - rival > 2.5 * (2 * rival + 2) ** 0.5


def turn(angle: float) -> NDArray[np.float32]:
    """Return the (2, 2) matrix that turns (k, 2) positions on its left about the vertical, rad."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, sin], [-sin, cos]], np.float32)


def plan_view(points: NDArray[np.float32]) -> PlanView:
    """Return the cells in which something stands.

    Args:
        points: (m, 3) m, in level axes about the sensor; finite.
    """
    x, y, height = np.ascontiguousarray(points.T)
    squared = x * x + y * y
    in_range = np.flatnonzero((squared > _NEAREST**2) & (squared < _FARTHEST**2))
    x, y, height = x[in_range], y[in_range], height[in_range]
    width = _width(CELL)
    occupied = np.zeros((width, width), np.bool_)
    row, column = _index_of(x, CELL), _index_of(y, CELL)
    cell = row * width + column
    lowest, highest = np.full(width**2, np.inf, np.float32), np.full(width**2, -np.inf, np.float32)
    np.minimum.at(lowest, cell, height)
    np.maximum.at(highest, cell, height)
    upright = highest - lowest > _UPRIGHT
    (found,) = np.nonzero(upright)
    occupied.ravel()[found] = True
    count, *sums = (np.bincount(cell, weights, width**2)[found] for weights in (None, x, y))
    centers = (np.stack(sums, axis=-1) / count[:, None]).astype(np.float32)
    stands = np.flatnonzero(upright[cell] & (height > lowest[cell] + _ABOVE_GROUND))
    return PlanView(occupied, centers, np.stack([x[stands], y[stands]], axis=-1))


def displacement(
    first: PlanView, centers: NDArray[np.float32], reach: float, step: float = FINE
) -> Displacement:
    """Return the displacement with the most votes; its precision is about 0.1 m.

    Args:
        first: the view from the first position.
        centers: (k, 2) those of the view from the second position, in the same axes, m.
        reach: longest displacement to try, m, above 1.2 m; at most 20 m is tried.
        step: distance between two displacements that are tried, m.
    """
    tried = _disc(min(reach, _LONGEST), step)
    votes = np.count_nonzero(_hits(first.occupied, CELL, centers, tried), axis=1)
    best = int(np.argmax(votes))
    apart = np.linalg.norm(tried - tried[best], axis=1)
    peak = (apart <= _PEAK) & (votes >= 0.9 * votes[best])
    rival = int(np.argmax(np.where(apart > _APART, votes, -1)))
    of_best, of_rival = _hits(first.occupied, CELL, centers, tried[[best, rival]])
    return Displacement(
        shift=np.average(tried[peak], axis=0, weights=np.maximum(votes[peak], 1)),
        votes=int(votes[best]),
        share=float(votes[best] / max(len(centers), 1)),
        own_votes=int(np.count_nonzero(of_best & ~of_rival)),
        rival_votes=int(np.count_nonzero(of_rival & ~of_best)),
    )


def met(first: PlanView, centers: NDArray[np.float32]) -> int:
    """Return how many of (k, 2) positions lie in an occupied cell of a view, or within about 0.3 m of one."""
    nearby = _disc(1.5 * FINE, FINE)
    return int(np.count_nonzero(_hits(first.occupied, CELL, centers, nearby).any(axis=0)))


def refined(first: PlanView, points: NDArray[np.float32], shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a displacement (2,), m, moved to where most points meet others; its precision is about 0.03 m.

    Args:
        first: the view from the first position.
        points: (m, 2) those of the view from the second position, in the same axes, m.
        shift: (2,) the displacement with the most votes by cells, m.
    """
    width = _width(_FINE_CELL)
    occupied = np.zeros((width, width), np.bool_)
    occupied[tuple(_index_of(first.points.T, _FINE_CELL))] = True
    tried = shift + _disc(_FINE_REACH, _FINE_STEP)
    some = points[:: max(1, len(points) // _REFINED_POINTS)]
    votes = np.count_nonzero(_hits(occupied, _FINE_CELL, some, tried), axis=1)
    weights = np.maximum(votes - 0.8 * votes.max(), 0)
    found: NDArray[np.float64] = np.average(tried, axis=0, weights=weights) if weights.any() else shift
    return found


def _disc(radius: float, step: float) -> NDArray[np.float64]:
    """Return the (n, 2) displacements of a square grid that are not longer than a radius, m."""
    steps = int(radius / step + 1e-9)
    axis = np.arange(-steps, steps + 1) * step
    all_of_them = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    return all_of_them[np.linalg.norm(all_of_them, axis=1) <= radius + 1e-9]


def _hits(
    occupied: NDArray[np.bool_], cell: float, positions: NDArray[np.float32], tried: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return (n, k) which of (k, 2) positions each of (n, 2) displacements moves into occupied cells."""
    numbers = []
    for axis, stride in ((0, len(occupied)), (1, 1)):
        # the displacements lie on a grid: an axis has few different ones
        different, which = np.unique(tried[:, axis], return_inverse=True)
        index = _index_of(positions[:, axis] + different[:, None].astype(np.float32), cell)
        numbers.append((index * stride)[which])
    hits: NDArray[np.bool_] = occupied.ravel()[numbers[0] + numbers[1]]
    return hits


_LONGEST = 20.0


def _width(cell: float) -> int:
    """Return the number of cells along an edge of the grid: no displaced point falls outside."""
    return int(2 * (_FARTHEST + _LONGEST + _FINE_REACH) / cell) + 2


def _index_of(positions: NDArray[np.float32], cell: float) -> NDArray[np.int32]:
    """Return the row or the column of the cell of each coordinate, m."""
    return np.floor(positions * np.float32(1 / cell)).astype(np.int32) + _width(cell) // 2
