"""GPS fixes: the choice of those that are used, their covariances, and the alignment of their frame.

:class:`GpsGate` chooses a fix for each keyframe. :func:`alignment` finds the yaw and the translation between
the odometry's frame and the fixes' frame once the yaw is observable.
"""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lio_jax.core.xla import programs
from lio_jax.loops.edge_noise import fix_covariance
from lio_jax.pose_graph.graduated import truncated_weights

_Array = NDArray[np.float64]

_CONFIDENCE = 0.99
"""Share of correct fixes whose squared whitened residual is below the limit."""
_MEDIAN = float(chi2.median(3))
"""Median of the squared whitened residual of a correct fix."""
_GROWTH = 1.4
"""Factor of the control parameter from one set of weights to the next."""
_ROUNDS = 100
"""Largest number of sets of weights."""
_STEPS = 16
"""Largest number of Levenberg-Marquardt steps after the closed form."""
_PRECISION = 1e-9
"""Change of the yaw (rad), of the translation (m) and of the cost, relative and absolute, below which the
solver stops."""
_SETTLED = 1e-3
"""Distance from 0 or 1 below which a weight counts as final."""
_MOST_ALIKE = 0.98
"""Largest correlation of one residual with the next that is used."""


class EnuAlignment(NamedTuple):
    """The level frame of the odometry in the fixes' frame."""

    T_enu_odom: _Array
    """(4, 4) pose of the odometry's frame in the fixes' frame, m; its rotation is about the vertical."""
    covariance: _Array
    """(4, 4) covariance of yaw (rad) and of the odometry's origin to the east, north and up (m)."""
    inlier: NDArray[np.bool_]
    """(k,) True for fixes that agree with the alignment."""


class _Pairs(NamedTuple):
    """Positions of the antenna in both frames."""

    odometry: _Array
    """(k, 3) positions by the odometry, m."""
    fix: _Array
    """(k, 3) positions of the fixes, m."""
    root: _Array
    """(k, 3, 3) factor L of each fix's information L L'."""

    def residual(self, yaw: float, shift: _Array) -> _Array:
        """Return (k, 3) whitened residuals L' (Rz(yaw) p + t - f)."""
        return np.asarray(_whitened(np, np.array([yaw, *shift]), self.odometry, self.fix, self.root))

    def slope(self, yaw: float) -> _Array:
        """Return the (k, 3, 4) derivatives of the whitened residuals by yaw and t."""
        turned = self.odometry @ _about_z(yaw).T
        by_yaw = np.stack([-turned[:, 1], turned[:, 0], np.zeros(len(turned))], -1)
        by_yaw = np.einsum("kji,kj->ki", self.root, by_yaw)
        return np.concatenate([by_yaw[:, :, None], self.root.transpose(0, 2, 1)], -1)


def alignment(
    positions_odom: _Array, fixes: _Array, covariances: _Array, yaw_sigma: float
) -> EnuAlignment | None:
    """Return the yaw and translation that align an odometry with fixes; None while the yaw is not observable.

    The alignment minimises the sum of r' C^-1 r with r = Rz(yaw) p + t - f. The terms of fixes that
    contradict the others are truncated, by graduated non-convexity (Yang et al., RA-L 2020). The covariance
    is multiplied by the ratio of the residuals' variance to the stated one if that is above one, and by (1 +
    a) / (1 - a), because the errors of fixes are correlated; a is the correlation of one residual with the
    next.

    The yaw counts as not observable if its standard deviation is above ``yaw_sigma``, or if fewer than half
    of the fixes agree with it.

    Args:
        positions_odom: (k, 3) positions of the antenna by the odometry, m, z up, in order of time.
        fixes: (k, 3) positions of the fixes, m, east, north, up.
        covariances: (k, 3, 3) covariances of the fixes, m^2, positive definite.
        yaw_sigma: largest standard deviation of an observable yaw, rad.
    """
    if len(fixes) < 2:
        return None
    pairs = _Pairs(positions_odom, fixes, np.linalg.cholesky(np.linalg.inv(covariances)))
    yaw, shift, weights = _robust(pairs)
    inlier = weights > 0.5
    if 2 * np.sum(inlier) < len(fixes):
        return None
    covariance = _covariance(pairs, inlier, yaw, shift)
    if covariance is None or covariance[0, 0] > yaw_sigma**2:
        return None
    T_enu_odom = np.eye(4)
    T_enu_odom[:3, :3], T_enu_odom[:3, 3] = _about_z(yaw), shift
    return EnuAlignment(T_enu_odom, covariance, inlier)


def aligned(positions_odom: _Array, fixes: _Array, covariances: _Array) -> tuple[_Array, float]:
    """Return the (4, 4) T_enu_odom by least squares over all fixes, and the standard deviation of its yaw.

    Unlike :func:`alignment` it leaves no fix out, so that a trajectory which contradicts the fixes gets an
    alignment, too. The standard deviation, rad, is infinite where the positions do not show the yaw at all.

    Args:
        positions_odom, fixes, covariances: as in :func:`alignment`, at least one of each.
    """
    pairs = _Pairs(positions_odom, fixes, np.linalg.cholesky(np.linalg.inv(covariances)))
    everything = np.ones(len(fixes), bool)
    yaw, shift = _solved(pairs, everything.astype(float))
    covariance = _covariance(pairs, everything, yaw, shift)
    T_enu_odom = np.eye(4)
    T_enu_odom[:3, :3], T_enu_odom[:3, 3] = _about_z(yaw), shift
    return T_enu_odom, np.inf if covariance is None else float(np.sqrt(covariance[0, 0]))


def _robust(pairs: _Pairs) -> tuple[float, _Array, _Array]:
    """Return yaw (rad), translation (m) and the weights of the pairs, rarely between 0 and 1."""
    limit = float(chi2.ppf(_CONFIDENCE, 3))
    weights = np.ones(len(pairs.fix))
    control = 0.0
    for _ in range(_ROUNDS):
        yaw, shift = _solved(pairs, weights)
        squared = np.sum(pairs.residual(yaw, shift) ** 2, -1)
        # before the last rounds all weights may be small, and only their ratios matter
        if control >= 1 and np.all(np.minimum(weights, 1 - weights) < _SETTLED):
            break
        # all errors may be larger than stated: the limit grows with their median
        share = squared / (limit * max(1.0, float(np.median(squared)) / _MEDIAN))
        largest = float(share.max())
        if not control:
            control = 1 / (2 * largest - 1) if largest > 1 else np.inf
        weights = truncated_weights(share, control)
        if not np.any(weights):
            break
        control *= _GROWTH
    return yaw, shift, weights


def _solved(pairs: _Pairs, weights: _Array) -> tuple[float, _Array]:
    """Return yaw and translation by least squares.

    The start is the closed form for covariances that are equal in east and north.
    """
    p, f = pairs.odometry, pairs.fix
    share = weights * np.sum(pairs.root[:, :2, :2] ** 2, axis=(1, 2))
    share = share / share.sum()
    (x, y, _), (east, north, _) = (p - share @ p).T, (f - share @ f).T
    yaw = float(np.arctan2(share @ (x * north - y * east), share @ (x * east + y * north)))
    shift = share @ f - _about_z(yaw) @ (share @ p)
    root = np.sqrt(weights)[:, None, None] * pairs.root
    # a program is compiled for a shape: lengths are rounded up to powers of two by pairs without weight
    lacking = (1 << (len(p) - 1).bit_length()) - len(p)
    padded = [np.pad(part, [(0, lacking)] + [(0, 0)] * (part.ndim - 1)) for part in (p, f, root)]
    with jax.enable_x64(True):
        found = programs(_refined)(np.array([yaw, *shift]), *padded)
    return float(found[0]), np.array(found[1:])


def _refined(start: jax.Array, odometry: jax.Array, fix: jax.Array, root: jax.Array) -> jax.Array:
    """Return the yaw and translation (4,) that minimise the sum of squares of root' (Rz(yaw) p + t - f)."""
    import optimistix as optx  # takes 0.3 s, and only recordings with fixes need it

    return optx.least_squares(
        lambda x, _: _whitened(jnp, x, odometry, fix, root),
        optx.LevenbergMarquardt(_PRECISION, _PRECISION),
        start,
        max_steps=_STEPS,
        throw=False,
    ).value


def _whitened(xp: Any, x: Any, odometry: Any, fix: Any, root: Any) -> Any:
    """Return (k, 3) residuals root' (Rz(x[0]) p + x[1:] - f); ``xp`` is numpy, or jax.numpy in a program."""
    cosine, sine = xp.cos(x[0]), xp.sin(x[0])
    east = cosine * odometry[:, 0] - sine * odometry[:, 1]
    north = sine * odometry[:, 0] + cosine * odometry[:, 1]
    missed = xp.stack([east, north, odometry[:, 2]], axis=-1) + x[1:] - fix
    return xp.einsum("kji,kj->ki", root, missed)


def _covariance(pairs: _Pairs, inlier: NDArray[np.bool_], yaw: float, shift: _Array) -> _Array | None:
    """Return the (4, 4) covariance of yaw and translation; None if the yaw is not observable."""
    A = pairs.slope(yaw)[inlier].reshape(-1, 4)
    scale = np.linalg.norm(A, axis=0) + np.finfo(float).tiny
    _, singular, right = np.linalg.svd(A / scale, full_matrices=False)
    if not singular[-1] > len(A) * np.finfo(float).eps:
        return None
    root = right.T / singular / scale[:, None]
    residual = pairs.residual(yaw, shift)[inlier]
    larger = max(1.0, float(np.sum(residual**2)) / max(residual.size - 4, 1))
    return np.asarray(root @ root.T * larger * _alike(residual))


def _alike(residual: _Array) -> float:
    """Return the factor by which first-order autoregressive correlation increases the variance of a mean."""
    power = float(np.sum(residual**2))
    if power == 0:
        return 1.0
    a = min(max(float(np.sum(residual[1:] * residual[:-1])) / power, 0.0), _MOST_ALIKE)
    return (1 + a) / (1 - a)


def _about_z(yaw: float) -> _Array:
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


_WITNESSES = 20
"""Number of earlier fixes with which a new fix is compared."""


class Fix(NamedTuple):
    """The measured position of the antenna at a keyframe."""

    position: _Array
    """(3,) position in the fixes' frame, m: east, north, up."""
    covariance: _Array
    """(3, 3) covariance of the position that is believed, m^2."""
    stated: _Array
    """(3, 3) covariance of the position that the receiver states, m^2."""


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
    lost: float
    """Sum of the outages' largest errors up to here, m."""


class GpsGate:
    """The choice of a fix for each keyframe, in order; a choice depends on earlier keyframes only."""

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
            stamp_ns: (m,) times of the fixes, ns, ascending.
            position: (m, 3) positions of the antenna, m, east, north, up.
            covariance: (m, 3, 3) covariances of the positions, m^2, positive definite.
            values: values of :class:`lio_jax.loops.params.GpsParams` by name.
            elevation: True: the fixes' height is used. False: the height is that of the keyframe's pose.
        """
        self._stamp_ns, self._position, self._covariance = stamp_ns, position, covariance
        self._values = values
        self._elevation = elevation
        self._lever = np.asarray(values["lever_arm"], np.float64)
        self._way = 0.0
        self._lost = 0.0
        self._speed = 0.0
        self._last: tuple[int, _Array] | None = None
        self._last_used: _Array | None = None
        self._witnesses: deque[_Witness] = deque(maxlen=_WITNESSES)
        self.refusals: Counter[Refusal] = Counter()
        """Number of keyframes without a fix, by reason."""

    def used_fix(
        self,
        stamp_ns: int,
        T_odom_imu: _Array,
        T_world_imu: _Array,
        pose_covariance: _Array | None = None,
        position_error: float = 0.0,
    ) -> Fix | Refusal:
        """Return the fix of the next keyframe, or the reason why it has none.

        Args:
            stamp_ns: time of the keyframe, ns.
            T_odom_imu: (4, 4) its pose by the odometry without corrections, m, which measures the distance
                travelled.
            T_world_imu: (4, 4) its pose, corrected so far, m; its height is used if that of the fixes is not.
            pose_covariance: (3, 3) covariance of its position in the fixes' frame, m^2; None before the
                alignment.
            position_error: largest error of the odometry's position since the keyframe before, beyond its
                drift, m; above 0 after an outage.
        """
        self._lost += position_error
        antenna = T_odom_imu[:3, :3] @ self._lever + T_odom_imu[:3, 3]
        self._move(stamp_ns, antenna)
        found = self._chosen(stamp_ns, antenna, T_world_imu, pose_covariance)
        if isinstance(found, Refusal):
            self.refusals[found] += 1
        else:
            self._last_used = antenna
        return found

    def doubt(self, stamp_ns: int, T_odom_imu: _Array) -> Refusal | None:
        """Return why the fix of the next pose cannot be believed, without using it; None where it can.

        Args:
            stamp_ns: time of the pose, ns.
            T_odom_imu: (4, 4) the pose by the odometry, m.
        """
        antenna = T_odom_imu[:3, :3] @ self._lever + T_odom_imu[:3, 3]
        self._move(stamp_ns, antenna)
        found = self._chosen(stamp_ns, antenna, T_odom_imu, None)
        return found if isinstance(found, Refusal) else None

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
        witness = _Witness(fix, antenna, self._way, self._lost)
        possible = self._fits_most(witness)
        if not self._witnesses or _apart(antenna, self._witnesses[-1].antenna) >= values["spacing"]:
            self._witnesses.append(witness)
        return fix if possible else Refusal.JUMP

    def _at(self, stamp_ns: int) -> Fix | None:
        """Return the fix at a time: interpolated, or the nearest one with the distance travelled as error."""
        later = int(np.searchsorted(self._stamp_ns, stamp_ns))
        around = [k for k in (later - 1, later) if 0 <= k < len(self._stamp_ns)]
        away = [abs(int(self._stamp_ns[k]) - stamp_ns) * 1e-9 for k in around]
        if not around or min(away) > self._values["time_gap"]:
            return None
        if len(around) == 2 and self._one_way(around, sum(away)):
            share = away[0] / sum(away)
            weights = np.array([1 - share, share])
            # the errors of both are taken as equal, because they hardly change from one fix to the next
            stated = np.tensordot(weights, self._covariance[around], 1)
            return Fix(weights @ self._position[around], stated, stated)
        nearest = around[int(np.argmin(away))]
        stated = self._covariance[nearest] + (self._speed * min(away)) ** 2 * np.eye(3)
        return Fix(self._position[nearest], stated, stated)

    def _one_way(self, around: list[int], seconds: float) -> bool:
        """Return whether the vehicle can have travelled from one fix to the next one."""
        if seconds > self._values["interpolation"]:
            return False
        moved = _apart(*self._position[around])
        variance = max(
            float(np.linalg.eigvalsh(np.sum(self._covariance[around], axis=0))[-1]),
            2 * self._values["min_variance"],
        )
        return bool(moved - self._speed * seconds <= self._values["jump_sigmas"] * np.sqrt(variance))

    def _trusted(self, fix: Fix, height: float) -> Fix:
        """Return the fix with at least the smallest allowed variance, and with the height that is used."""
        position = fix.position.copy()
        if not self._elevation:
            position[2] = height
        least = self._values["min_variance"], self._values["height_variance"]
        return Fix(position, fix_covariance(fix.stated, self._elevation, *least), fix.stated)

    def _fits_most(self, witness: _Witness) -> bool:
        fitting = sum(self._fit(witness, other) for other in self._witnesses)
        return not self._witnesses or 2 * fitting > len(self._witnesses)

    def _fit(self, one: _Witness, other: _Witness) -> bool:
        # without elevation both heights are the odometry's own and contain no information
        axes = slice(3 if self._elevation else 2)
        by_fixes = _apart(one.fix.position[axes], other.fix.position[axes])
        by_odometry = _apart(one.antenna[axes], other.antenna[axes])
        variance = np.linalg.eigvalsh((one.fix.covariance + other.fix.covariance)[axes, axes])[-1]
        drift = self._values["drift"] * (one.way - other.way) + one.lost - other.lost
        return bool(abs(by_fixes - by_odometry) <= self._values["jump_sigmas"] * np.sqrt(variance) + drift)


def _apart(one: _Array, other: _Array) -> float:
    return float(np.linalg.norm(one - other))
