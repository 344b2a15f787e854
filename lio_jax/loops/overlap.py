"""How well two places overlap: shares of agreeing points, contradictions, compared candidates."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lio_jax.loops.alignment import Alignments
from lio_jax.pose_graph.graph import heading_of

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


_Array = NDArray[np.float64]

_SEEN_WELL = 25.0
"""Only what is nearer than this to a keyframe of the target is judged, m: the rest was seen thinly."""
LEAST_POINTS = 100
"""Points of upright things without which there is nothing to compare."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """An alignment and what speaks for it, in level axes."""

    T_target_source: _Array
    information: _Array
    degenerate: bool
    overlap: float
    fitness: float
    shift: float
    """From where the poses so far have the source, m."""
    turn: float
    """From the heading they have, rad."""
    tilt: float
    """Against the vertical they have, rad."""


class Comparison:
    """The surroundings of two keyframes, to be compared under any alignment."""

    def __init__(
        self, theirs: NDArray[np.float32], stations: _Array, ours: NDArray[np.float32], within: float
    ) -> None:
        """Take what both saw, and where.

        Args:
            theirs: (m, 3) m, in the target's level axes.
            stations: (k, 3) m, where the target's keyframes were.
            ours: (n, 3) m, of upright things in the source's level axes.
            within: a point agrees if theirs has one nearer than this, m.
        """
        self._agreement, self._stations = Agreement(theirs), cKDTree(stations)
        self._ours, self._within = ours, within

    def candidates(self, result: Alignments, poses: _Array) -> list[Candidate]:
        """Return the alignments that converged, the one that agrees best first."""
        offset = poses[1, :3, 3] - poses[0, :3, 3]
        candidates = []
        for row in np.flatnonzero(result.converged):
            T = result.T_target_source[row]
            placed = self._ours @ T[:3, :3].T + T[:3, 3]
            judged = placed[self._stations.query(placed, distance_upper_bound=_SEEN_WELL)[0] < _SEEN_WELL]
            if len(judged) < LEAST_POINTS:
                continue
            distances = self._agreement.distances(judged)
            candidates.append(
                Candidate(
                    T_target_source=T,
                    information=result.information[row],
                    degenerate=bool(result.degenerate[row]),
                    overlap=float(np.mean(distances < self._within)),
                    fitness=fitness_of(distances),
                    shift=float(np.linalg.norm(T[:3, 3] - offset)),
                    turn=abs(heading_of(T)),
                    tilt=float(np.arccos(np.clip(T[2, 2], -1, 1))),
                )
            )
        return sorted(candidates, key=lambda candidate: -candidate.overlap)
