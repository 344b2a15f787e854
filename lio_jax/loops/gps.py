"""Which GPS fix a keyframe is tied to, and why another one is not.

The gates are LIO-SAM's (Shan et al., "LIO-SAM: tightly-coupled lidar inertial odometry via smoothing and
mapping", IROS 2020), and one against fixes that contradict the odometry: distances do not depend on the
heading, so it works before that is known. It is the pairwise consistency of Mangelson et al., "Pairwise
consistent measurement set maximization for robust multi-robot map merging", ICRA 2018, by majority among the
latest.
"""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

_Array = NDArray[np.float64]

_WITNESSES = 20
"""So many of the latest fixes say whether the next one is possible."""


class Fix(NamedTuple):
    """Where the antenna was at a keyframe."""

    position: _Array
    """(3,) m, in the fixes' frame: east, north, up."""
    covariance: _Array
    """(3, 3) m^2."""


class Refusal(StrEnum):
    """Why a keyframe gets no fix."""

    TRAVEL = "the trajectory is still shorter than params.gps.min_travel"
    CERTAIN = "the pose is more certain than params.gps.pose_variance"
    NEAR = "the last fix used is nearer than params.gps.spacing"
    TIME = "no fix within params.gps.time_gap"
    VARIANCE = "its variance exceeds params.gps.max_variance"
    JUMP = "it contradicts the odometry and the fixes before"


@dataclass(frozen=True, eq=False)
class _Witness:
    fix: Fix
    antenna: _Array
    way: float


class GpsGate:
    """Chooses keyframe by keyframe, in order; each choice depends on the keyframes until then alone."""

    def __init__(
        self,
        stamp_ns: NDArray[np.int64],
        position: _Array,
        covariance: _Array,
        values: Mapping[str, Any],
        elevation: bool = True,
    ) -> None:
        """Take a recording's fixes.

        Args:
            stamp_ns: (m,) ascending.
            position: (m, 3) m, east north up, of the antenna.
            covariance: (m, 3, 3) m^2, positive definite.
            values: numbers of :class:`lio_jax.core.backend_params.GpsParams` by name.
            elevation: whether the fixes' height counts; false: the height is that of the keyframe's pose.
        """
        self._stamp_ns, self._position, self._covariance = stamp_ns, position, covariance
        self._values = values
        self._elevation = elevation
        self._lever = np.asarray(values["lever_arm"], np.float64)
        self._way = 0.0
        self._speed = 0.0
        self._last: tuple[int, _Array] | None = None
        self._last_used: _Array | None = None
        self._witnesses: deque[_Witness] = deque(maxlen=_WITNESSES)
        self.refusals: Counter[Refusal] = Counter()
        """How many keyframes got no fix, by reason."""

    def used_fix(
        self, stamp_ns: int, T_odom_imu: _Array, T_world_imu: _Array, pose_covariance: _Array | None = None
    ) -> Fix | Refusal:
        """Return the fix that the next keyframe is tied to, or why there is none.

        Args:
            stamp_ns: of the keyframe.
            T_odom_imu: (4, 4) its pose by the smooth odometry, which says how far the vehicle moved.
            T_world_imu: (4, 4) its pose as corrected so far; its height counts where the fixes' does not.
            pose_covariance: (3, 3) m^2 of its position in the fixes' frame; None: nothing ties it there yet.
        """
        antenna = T_odom_imu[:3, :3] @ self._lever + T_odom_imu[:3, 3]
        self._move(stamp_ns, antenna)
        found = self._chosen(stamp_ns, antenna, T_world_imu, pose_covariance)
        if isinstance(found, Refusal):
            self.refusals[found] += 1
        else:
            self._last_used = antenna
        return found

    def _move(self, stamp_ns: int, antenna: _Array) -> None:
        if self._last is not None:
            before_ns, before = self._last
            moved = float(np.linalg.norm(antenna - before))
            self._way += moved
            self._speed = moved / max((stamp_ns - before_ns) * 1e-9, 1e-3)
        self._last = stamp_ns, antenna

    def _chosen(
        self, stamp_ns: int, antenna: _Array, T_world_imu: _Array, pose_covariance: _Array | None
    ) -> Fix | Refusal:
        values = self._values
        if self._way < values["min_travel"]:
            return Refusal.TRAVEL
        if pose_covariance is not None and np.all(np.diag(pose_covariance)[:2] < values["pose_variance"]):
            return Refusal.CERTAIN
        if self._last_used is not None and _apart(antenna, self._last_used) < values["spacing"]:
            return Refusal.NEAR
        fix = self._at(stamp_ns)
        if fix is None:
            return Refusal.TIME
        if np.any(np.diag(fix.covariance)[:2] > values["max_variance"]):
            return Refusal.VARIANCE
        height = T_world_imu[2, :3] @ self._lever + T_world_imu[2, 3]
        fix = self._trusted(fix, float(height))
        witness = _Witness(fix, antenna, self._way)
        possible = self._fits_most(witness)
        if not self._witnesses or _apart(antenna, self._witnesses[-1].antenna) >= values["spacing"]:
            self._witnesses.append(witness)
        return fix if possible else Refusal.JUMP

    def _at(self, stamp_ns: int) -> Fix | None:
        """Return the fix at a time: between two, or the nearest one, less certain by what was moved since."""
        later = int(np.searchsorted(self._stamp_ns, stamp_ns))
        around = [k for k in (later - 1, later) if 0 <= k < len(self._stamp_ns)]
        away = [abs(int(self._stamp_ns[k]) - stamp_ns) * 1e-9 for k in around]
        if not around or min(away) > self._values["time_gap"]:
            return None
        if len(around) == 2 and self._one_way(around, sum(away)):
            share = away[0] / sum(away)
            weights = np.array([1 - share, share])
            # their errors are taken as one: they hardly change from one fix to the next
            return Fix(weights @ self._position[around], np.tensordot(weights, self._covariance[around], 1))
        nearest = around[int(np.argmin(away))]
        missed = (self._speed * min(away)) ** 2
        return Fix(self._position[nearest], self._covariance[nearest] + missed * np.eye(3))

    def _one_way(self, around: list[int], seconds: float) -> bool:
        """Return whether the vehicle can have gone from one fix to the next one."""
        if seconds > self._values["interpolation"]:
            return False
        moved = _apart(*self._position[around])
        variance = max(
            float(np.linalg.eigvalsh(np.sum(self._covariance[around], axis=0))[-1]),
            2 * self._values["min_variance"],
        )
        return bool(moved - self._speed * seconds <= self._values["jump_sigmas"] * np.sqrt(variance))

    def _trusted(self, fix: Fix, height: float) -> Fix:
        """Return the fix with no smaller variance than is believed, and with the height that counts."""
        position, covariance = fix.position.copy(), fix.covariance.copy()
        if not self._elevation:
            position[2] = height
            covariance[2, :] = covariance[:, 2] = 0.0
            covariance[2, 2] = self._values["height_variance"]
        lacking = np.maximum(self._values["min_variance"] - np.diag(covariance), 0.0)
        return Fix(position, covariance + np.diag(lacking))

    def _fits_most(self, witness: _Witness) -> bool:
        fitting = sum(self._fit(witness, other) for other in self._witnesses)
        return not self._witnesses or 2 * fitting > len(self._witnesses)

    def _fit(self, one: _Witness, other: _Witness) -> bool:
        # without elevation both heights are the odometry's own and say nothing
        axes = slice(3 if self._elevation else 2)
        by_fixes = _apart(one.fix.position[axes], other.fix.position[axes])
        by_odometry = _apart(one.antenna[axes], other.antenna[axes])
        variance = np.linalg.eigvalsh((one.fix.covariance + other.fix.covariance)[axes, axes])[-1]
        allowed = self._values["jump_sigmas"] * np.sqrt(variance) + self._values["drift"] * (
            one.way - other.way
        )
        return bool(abs(by_fixes - by_odometry) <= allowed)


def _apart(one: _Array, other: _Array) -> float:
    return float(np.linalg.norm(one - other))
