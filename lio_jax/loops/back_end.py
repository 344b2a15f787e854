"""Correct the drift of an odometry: keyframes in, one by one, and one consistent trajectory out.

The block diagram of LIO-SAM's map optimisation (Shan et al., "LIO-SAM: Tightly-coupled lidar inertial odometry
via smoothing and mapping", IROS 2020, III-D and III-E): odometry between keyframes, loops, GPS, pose graph.
What becomes of a keyframe depends on those before it alone, never on the clock.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.settings import Settings
from lio_jax.loops.drift_correction import levelled_onto
from lio_jax.loops.gps import Fix, FixChooser, alignment
from lio_jax.loops.graph import LOOP, ODOMETRY, POSITION, PRIOR
from lio_jax.loops.keyframe import Keyframe
from lio_jax.loops.keyframe_graph import Edge, solved
from lio_jax.loops.place_recogniser import PlaceRecogniser
from lio_jax.loops.verification import Verdict

_Array = NDArray[np.float64]

_SOLVE_EVERY = 20
"""Keyframes from one solve to the next, while loops or fixes come in and agree with the poses."""


@dataclass(frozen=True, eq=False)
class Correction:
    """What the back end made of a drive."""

    stamp_ns: NDArray[np.int64]
    """(k,) of the keyframes."""
    T_odom_imu: _Array
    """(k, 4, 4) by the odometry."""
    T_world_imu: _Array
    """(k, 4, 4) corrected, in a z-up world where the first keyframe has the odometry's position and heading."""
    edges: list[Edge]
    weights: _Array
    """(e,) of the edges: 1, or below where one contradicts the others."""
    verdicts: list[Verdict]
    """Of all proposed loops, in the order of proposal."""
    fixes: dict[str, int]
    """How many GPS fixes were used or refused, by reason."""
    T_enu_world: _Array | None
    """(4, 4) from world to east-north-up about the recording's origin; None without GPS."""


class BackEnd:
    """Takes keyframes in order."""

    def __init__(self, settings: Settings, recogniser: PlaceRecogniser | None, fixes: FixChooser | None):
        """Begin without keyframes.

        Args:
            settings: sigmas of ``params.backend``.
            recogniser: of places seen before; None: no loops are closed.
            fixes: of the recording's GPS; None: it is not used.
        """
        sigmas = settings.values["backend"]
        self._first_tilt_sigma: float = sigmas["tilt_sigma"]
        self._recogniser, self._fixes = recogniser, fixes
        self._keyframes: list[Keyframe] = []
        self._poses = np.zeros((0, 4, 4))
        self._edges: list[Edge] = []
        self._positions: list[tuple[int, Fix]] = []
        self._verdicts: list[Verdict] = []
        self._T_enu_odom: _Array | None = None
        self._unsolved_since: int | None = None

    def add(self, keyframe: Keyframe) -> None:
        """Take the next keyframe; its loops and fix enter the graph, which is solved where it is due."""
        self._append(keyframe)
        if self._recogniser:
            self._close_loops(self._recogniser)
        if self._fixes:
            self._fix(self._fixes)
        if self._due():
            self._solve()

    def _append(self, keyframe: Keyframe) -> None:
        if self._keyframes:
            last = self._keyframes[-1]
            T_last_this = np.linalg.inv(last.T_odom_imu) @ keyframe.T_odom_imu
            information = np.linalg.inv(keyframe.covariance)
            self._edges.append(Edge(ODOMETRY, last.index, keyframe.index, T_last_this, information))
            pose = self._poses[-1] @ T_last_this
        else:
            pose = keyframe.T_odom_imu
        self._keyframes.append(keyframe)
        self._poses = np.concatenate([self._poses, pose[None]])

    def _close_loops(self, recogniser: PlaceRecogniser) -> None:
        verdicts = recogniser.loops_at(self._keyframes, self._poses)
        self._verdicts += verdicts
        for verdict in verdicts:
            if verdict.accepted:
                of = verdict.proposal
                self._edges.append(
                    Edge(LOOP, of.target, of.source, verdict.T_target_source, verdict.information)
                )
                self._waits()

    def _fix(self, fixes: FixChooser) -> None:
        fix = fixes.used_fix(self._keyframes[-1], self._poses)
        if fix is None:
            return
        self._positions.append((self._keyframes[-1].index, fix))
        if self._T_enu_odom is not None:
            self._waits()
            return
        aligned = alignment(...)
        if aligned is not None:
            self._T_enu_odom = aligned.T_enu_odom
            self._poses = self._T_enu_odom @ self._poses
            self._waits()
