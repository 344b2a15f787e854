"""Compare what two keyframes' surroundings hold under each of several alignments."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from lio_jax.loops.alignment import Alignments
from lio_jax.loops.evidence import Agreement, fitness_of
from lio_jax.loops.host_poses import heading_of

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
