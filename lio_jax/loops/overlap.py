"""How well two places overlap: the share of points that agree, and the share that contradict."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lio_jax.loops.alignment import Alignments
from lio_jax.pose_graph.graph import heading_of

_NEAR = 1.0
"""Distance from the map's points beyond which a point has no counterpart, m."""
_BIN = np.deg2rad(4.0)
"""Size of a bin of the sensor's view, rad: thinned points near the sensor are as far apart as this."""
_SEEN_THROUGH = 2.0
"""Distance before the nearest measured point of a direction from which on space is taken as empty, m."""
_VIEW = (3.0, 40.0)
"""Smallest and largest range of the map's points that are compared with the view, m."""


class OverlapAgreement:
    """Points of a map, in a tree for nearest neighbours."""

    def __init__(self, target: NDArray[np.float32]) -> None:
        """Build the tree of a map's points, (m, 3) m."""
        self._tree = cKDTree(target, balanced_tree=False, compact_nodes=False)

    def distances(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (n,) distances to the nearest point of the map, m; infinite beyond 1 m.

        Args:
            points: (n, 3) m, in the map's frame.
        """
        return np.asarray(self._tree.query(points, distance_upper_bound=_NEAR)[0])


def fitness_of(distances: NDArray[np.float64]) -> float:
    """Return the mean squared distance of the points that have a counterpart, m^2; infinite if none has one.

    Args:
        distances: (n,) m, infinite for points without a counterpart.
    """
    near = distances[np.isfinite(distances)]
    return float(np.mean(near**2)) if len(near) else np.inf


def conflict(
    seen: NDArray[np.float32], target: NDArray[np.float32], T_target_source: NDArray[np.float64]
) -> float:
    """Return the share of a map's visible points that lie in space which a keyframe measured as empty.

    A point of the map is visible if it is not farther than what the keyframe measured in the same direction.
    Points behind that may be occluded, so they are not counted.

    Args:
        seen: (n, 3) points of one keyframe, m, from its sensor.
        target: (m, 3) points of the map on objects that occlude what is behind them, m.
        T_target_source: (4, 4) pose of the keyframe in the map's frame, m.
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
    """Return the bin of the view in which each point lies, and its distance, m."""
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    column = np.floor((azimuth / (2 * np.pi) + 0.5) * columns).astype(np.int64) % columns
    row = np.minimum(np.floor((elevation / np.pi + 0.5) * rows).astype(np.int64), rows - 1)
    return column * rows + row, np.linalg.norm(points, axis=1)


_Array = NDArray[np.float64]

_SEEN_WELL = 25.0
"""Largest distance of a compared point from the target's keyframes, m: farther away the map is too sparse."""
LEAST_POINTS = 100
"""Least number of points on upright objects for a comparison."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """An alignment with its scores, in level axes."""

    T_target_source: _Array
    """(4, 4) aligned pose, m."""
    information: _Array
    """(6, 6) inverse covariance of its right perturbation, rotation (rad) before translation (m)."""
    degenerate: bool
    """True if a direction is not observable."""
    overlap: float
    """Share of the source's points that agree with the target, 0 to 1."""
    fitness: float
    """Mean squared distance of the points that have a counterpart, m^2."""
    shift: float
    """Distance of the source's aligned position from its current one, m."""
    turn: float
    """Angle between the source's aligned heading and its current one, rad."""
    tilt: float
    """Angle between the source's aligned vertical and its current one, rad."""


class CloudComparison:
    """The surroundings of two keyframes, which can be compared under any alignment."""

    def __init__(
        self, theirs: NDArray[np.float32], stations: _Array, ours: NDArray[np.float32], within: float
    ) -> None:
        """Take the points of target and source.

        Args:
            theirs: (m, 3) points of the target, m, in its level axes.
            stations: (k, 3) positions of the target's keyframes, m, in the same axes.
            ours: (n, 3) points on upright objects of the source, m, in its level axes.
            within: largest distance to a target's point at which a source's point agrees, m.
        """
        self._agreement, self._stations = OverlapAgreement(theirs), cKDTree(stations)
        self._ours, self._within = ours, within

    def candidates(self, result: Alignments, poses: _Array) -> list[Candidate]:
        """Return the alignments that converged, ordered by decreasing overlap.

        Args:
            result: alignments in level axes.
            poses: (2, 4, 4) current T_world_imu of the target and of the source, m.
        """
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
