"""The motion that the inertial samples feel, beside the estimated one: where the scans see something else.

In a lift or on a ferry the surroundings move with the sensor, and the scans show rest. A scan match may also
follow a moving body, or a map that repeats itself. The estimate then moves otherwise than the samples feel,
in the same direction for seconds, while each single innovation stays small.

The velocity cannot serve for the comparison, because the filter has already adapted it. Over two successive
spans of the lengths T1 and T2 the samples say by themselves how much farther the second one leads:

    (p2 - p1) - (T2 / T1) (p1 - p0) = a12 + T2 v01 - (T2 / T1) a01,

with the estimated positions p, and with the acceleration of a span integrated once, v, and twice, a. The
acceleration is R f + g with the estimated attitude R and gravity g and the specific force f without its bias.
An error of the attitude by 1 deg or of the bias by 0.17 m/s^2 changes it by 0.17 m where both spans last 1 s.
"""

from collections import deque
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.types import ImuBatch, Scan

Array = NDArray[np.float64]

_SPAN_S = 1.0
"""Length of each of the two spans, s: in a shorter one a lift is not told from a tilt, and a longer one tells
it later."""
_UNEQUAL = 0.2
"""Largest difference of the two spans, as a share of their length."""
_LONGEST_STEP_S = 0.03
"""Longest time between two samples, s: vibration between slower ones is not known."""
_SHOCK = 40.0
"""Specific force that counts as a shock, m/s^2: what happens between the samples then is not known."""


class FeltMotion(NamedTuple):
    """How the estimated motion differs from the felt one over two successive spans of about a second."""

    error: Array
    """(3,) change of the way from span to span, estimated minus felt, world axes, m."""
    start_ns: int
    """Begin of the first span, ns."""


class _Interval(NamedTuple):
    """The motion that was felt between the ends of two scans."""

    seconds: float
    velocity: Array
    """(3,) its change, world axes, m/s."""
    position: Array
    """(3,) its change beyond that by the velocity at the begin, world axes, m."""


class _Place(NamedTuple):
    stamp_ns: int
    position: Array
    since: _Interval
    """Since the place before."""


class FeltMotionCheck:
    """Compares the estimated motion with the inertial samples, scan by scan."""

    def __init__(self) -> None:
        self._places: deque[_Place] = deque()
        self._rotation: Array | None = None

    def __call__(
        self, stamp_ns: int, scan: Scan, imu: ImuBatch | None, nav: Any, T_world_imu: Array, breaks: bool
    ) -> FeltMotion | None:
        """Return how the motion up to a scan differs; None where the samples or the scans do not tell.

        Args:
            stamp_ns: the scan's end, ns.
            scan: padded, numpy leaves.
            imu: samples since the last scan's end, numpy leaves; None: there are none.
            nav: estimate at the scan's end, numpy leaves.
            T_world_imu: (4, 4) pose of ``nav``.
            breaks: the pose is not that of a scan match in all directions, or does not go on from the last.
        """
        if imu is None:
            return None
        before, self._rotation = self._rotation, None
        if breaks or not np.isfinite(T_world_imu).all():
            self._places.clear()
            return None
        self._rotation = T_world_imu[:3, :3]
        since = None if before is None else _felt(imu, scan, nav, before)
        places = self._places
        if since is None:
            places.clear()
            since = _Interval(0.0, np.zeros(3), np.zeros(3))
        places.append(_Place(stamp_ns, T_world_imu[:3, 3], since))
        stamps = np.array([place.stamp_ns for place in places]) * 1e-9
        middle = int(np.argmin(np.abs(stamps - (stamps[-1] - _SPAN_S))))
        first = int(np.argmin(np.abs(stamps - (2 * stamps[middle] - stamps[-1]))))
        for _ in range(first):
            places.popleft()
        return _compared(list(places), middle - first)


def _compared(places: list[_Place], middle: int) -> FeltMotion | None:
    """Return the comparison of the spans from the first place to the middle one, and on to the last."""
    if not 0 < middle < len(places) - 1:
        return None
    before = _joined([place.since for place in places[1 : middle + 1]])
    after = _joined([place.since for place in places[middle + 1 :]])
    short = min(before.seconds, after.seconds) < (1 - _UNEQUAL) * _SPAN_S
    if short or abs(before.seconds - after.seconds) > _UNEQUAL * _SPAN_S:
        return None
    ratio = after.seconds / before.seconds
    p0, p1, p2 = places[0].position, places[middle].position, places[-1].position
    felt = after.position + after.seconds * before.velocity - ratio * before.position
    return FeltMotion((p2 - p1) - ratio * (p1 - p0) - felt, places[0].stamp_ns)


def _felt(imu: ImuBatch, scan: Scan, nav: Any, R_world_start: Array) -> _Interval | None:
    """Return the motion felt since the last scan's end; None where samples are missing, slow or a shock.

    Args:
        imu: samples, numpy leaves.
        scan: its end and the time since the last one's.
        nav: estimate at the end: biases, gravity and clock.
        R_world_start: (3, 3) estimated attitude at the begin.
    """
    mask = np.asarray(imu.mask)
    time = np.asarray(imu.time, np.float64)[mask]
    end = float(scan.duration) + float(nav.time_offset)
    start = end - float(scan.interval)
    if not start < end or len(time) < 2:
        return None
    known = np.concatenate([[start], time[(time > start) & (time < end)], [end]])
    seconds = np.diff(known)
    beyond = max(time[0] - start, end - time[-1])
    if max(seconds.max(), np.diff(time).max(), beyond) > _LONGEST_STEP_S:
        return None
    values = np.concatenate([np.asarray(imu.gyro), np.asarray(imu.accel)], axis=1)[mask]
    at_known = np.stack([np.interp(known, time, column) for column in values.T], axis=1)
    if np.abs(at_known[:, 3:]).max() > _SHOCK:
        return None
    means = (at_known[1:] + at_known[:-1]) / 2
    turned = (means[:, :3] - nav.gyro_bias) * seconds[:, None]
    # within a sweep the turns hardly change their axis
    middles = Rotation.from_rotvec(np.cumsum(turned, axis=0) - turned / 2)
    acceleration = middles.apply(means[:, 3:] - nav.accel_bias) @ R_world_start.T + nav.gravity
    left = end - known[1:] + seconds / 2
    return _Interval(end - start, seconds @ acceleration, (seconds * left) @ acceleration)


def _joined(intervals: list[_Interval]) -> _Interval:
    """Return the motion felt over consecutive intervals."""
    seconds = np.array([one.seconds for one in intervals])
    velocity = np.array([one.velocity for one in intervals])
    # each change of the velocity acts until the end
    left = np.cumsum(seconds[::-1])[::-1] - seconds
    position = np.sum([one.position for one in intervals], axis=0) + left @ velocity
    return _Interval(float(seconds.sum()), velocity.sum(axis=0), position)
