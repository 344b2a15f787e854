"""Does an alignment of two places hold? Points that agree, and things where the scan saw through."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

_NEAR = 1.0
"""Farther than this from the map a point has no counterpart there, m."""
_BIN = np.deg2rad(4.0)
"""Of the view from the sensor: a keyframe's points are thinned, and what lies near is as sparse as this."""
_SEEN_THROUGH = 2.0
"""So far before the nearest point that was seen in a direction nothing can have stood, m."""
_VIEW = (3.0, 40.0)
"""Ranges at which the map's points are looked for in the view, m."""


class Agreement:
    """Points of a map, arranged to be found by place."""

    def __init__(self, target: NDArray[np.float32]) -> None:
        """Arrange a map's points, (m, 3) m."""
        self._tree = cKDTree(target, balanced_tree=False, compact_nodes=False)

    def distances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return each point's distance to the nearest of the map's, infinite beyond 1 m, (n,) m."""
        return np.asarray(self._tree.query(points, distance_upper_bound=_NEAR)[0])


def fitness_of(distances: NDArray[np.float64]) -> float:
    """Return the mean squared distance of the points that have a counterpart, m^2; infinite if none has."""
    near = distances[np.isfinite(distances)]
    return float(np.mean(near**2)) if len(near) else np.inf


def conflict(
    seen: NDArray[np.float32], target: NDArray[np.float32], T_target_source: NDArray[np.float64]
) -> float:
    """Return the share of a map's points, of those in view, that stand where a keyframe saw through.

    In view are those at or before what the keyframe saw in the same direction; what is behind that may be
    hidden and says nothing.

    Args:
        seen: (n, 3) m, of one keyframe, from its sensor.
        target: (m, 3) m, of things that would hide what is behind them.
        T_target_source: (4, 4).
    """
    rotation, position = T_target_source[:3, :3], T_target_source[:3, 3]
    columns, rows = round(2 * np.pi / _BIN), round(np.pi / _BIN)
    nearest = np.full(columns * rows, np.inf)
    place, away = _directions(seen, columns, rows)
    np.minimum.at(nearest, place, away)
    place, away = _directions((target - position) @ rotation, columns, rows)
    least, most = _VIEW
    wanted = (away > least) & (away < most) & np.isfinite(nearest[place])
    ahead = nearest[place[wanted]] - away[wanted]
    through, met = np.sum(ahead > _SEEN_THROUGH), np.sum(np.abs(ahead) <= _SEEN_THROUGH)
    return float(through / max(through + met, 1))


def _directions(
    points: NDArray[np.floating], columns: int, rows: int
) -> tuple[NDArray[np.int64], NDArray[np.floating]]:
    """Return in which bin of the view points lie, and their distance, m."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    column = np.floor((azimuth / (2 * np.pi) + 0.5) * columns).astype(np.int64) % columns
    row = np.minimum(np.floor((elevation / np.pi + 0.5) * rows).astype(np.int64), rows - 1)
    return column * rows + row, np.linalg.norm(points, axis=1)
