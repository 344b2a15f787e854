"""The motion that plan views show, beside the scan match: at the start, and as a check of the estimate.

A scan match that starts from rest may stay there: the scan lines on the ground fit best where the sensor has
not moved. The plan view of what stands upright shows how far the vehicle went, at any speed.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.types import ImuBatch, Scan
from lio_jax.lidar.plan_view import (
    FINE,
    Displacement,
    PlanView,
    displacement,
    leads,
    met,
    plan_view,
    refined,
    turn,
)

_FASTEST = 45.0
"""Largest speed that is tried, m/s."""
_SLOWEST = 2.0
"""Below this speed a scan match finds the velocity from rest, m/s."""
_LONGEST_INTERVAL = 0.5
"""Longest time between the two scans, s."""
_TURNS = np.arange(-10, 11) * 0.01
"""Turns about the vertical between the two scans that are tried where no gyroscope shows the turn, rad."""
_COARSELY = 250
"""Number of cells with which these turns are compared; views of fewer cells are compared in finer steps."""
_PIECES = 20
"""Number of pieces into which the time between the scans is cut to integrate the angular rate."""


def first_velocity(
    first: Scan,
    second: Scan,
    interval: float,
    before: ImuBatch | None,
    between: ImuBatch | None,
    R_imu_lidar: Rotation,
) -> NDArray[np.float64] | None:
    """Return the lidar's velocity at the first scan's end, (3,) m/s along the IMU's axes, to about 0.3 m/s.

    None: the vehicle is slower than 2 m/s, or the scans do not show a speed without doubt.

    Args:
        first: padded, numpy leaves.
        second: the next one with points.
        interval: time between the ends of the two, s.
        before: samples up to the first scan's end, which show the vertical; None: it is the lidar's z axis.
        between: samples between the scans' ends, which show the turn; None: it is searched.
        R_imu_lidar: rotation of the lidar in the IMU frame.
    """
    if not 0 < interval <= _LONGEST_INTERVAL:
        return None
    clouds = _points(first), _points(second)
    level, view = _levelled(clouds[0], before, R_imu_lidar)
    measured = _turn(between, float(second.duration), interval)
    turned = R_imu_lidar.inv() * (measured or Rotation.identity()) * R_imu_lidar
    seen = plan_view(_turned(clouds[1], level * turned))
    if measured is None:
        angle = max(_TURNS, key=lambda angle: _compared(view, seen, angle, interval, _COARSELY).votes)
        turned = level.inv() * Rotation.from_rotvec([0.0, 0.0, angle]) * level
    else:
        angle = 0.0
    found = _compared(view, seen, angle, interval)
    if not found.is_certain:
        return None
    shift = refined(view, seen.points @ turn(angle), found.shift)
    # the velocity stays in the body's own axes: the way points along the mean heading
    half = Rotation.from_rotvec(turned.as_rotvec() / 2)
    way = half.inv().apply(level.inv().apply([*shift, 0.0]))
    velocity: NDArray[np.float64] = R_imu_lidar.apply(way) / interval
    return velocity if np.linalg.norm(velocity) > _SLOWEST else None


def _points(scan: Scan, most: int | None = None) -> NDArray[np.float32]:
    """Return the finite points, (n, 3) m, evenly thinned to at most ``most``."""
    real = np.flatnonzero(scan.mask)
    every = 1 if most is None else max(1, -(-len(real) // most))
    points = np.asarray(scan.points, np.float32)[real[::every]]
    finite = np.isfinite(points)
    return points if finite.all() else points[finite.all(axis=1)]


def _levelled(
    points: NDArray[np.float32], before: ImuBatch | None, R_imu_lidar: Rotation
) -> tuple[Rotation, PlanView]:
    """Return the rotation from the lidar frame to level axes, and the plan view in them.

    In a bend the accelerometer's mean does not point up, and a lidar may be mounted tilted. Of both
    directions that one is vertical in which less stands upright.
    """
    directions = [np.array([0.0, 0.0, 1.0])]
    if before is not None and np.any(before.mask):
        directions.append(
            R_imu_lidar.inv().apply(np.asarray(before.accel)[np.asarray(before.mask)].mean(axis=0))
        )
    levels = [Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0] for up in directions if np.any(up)]
    views = [(level, plan_view(_turned(points, level))) for level in levels]
    return min(views, key=lambda one: len(one[1].centers))


def _turn(between: ImuBatch | None, end: float, interval: float) -> Rotation | None:
    """Return the rotation between two scans' ends, in the IMU frame; None without samples.

    Args:
        between: samples between the two.
        end: the second end on the samples' clock, s.
        interval: time between the two, s.
    """
    if between is None or not np.any(between.mask):
        return None
    mask = np.asarray(between.mask)
    time, rate = np.asarray(between.time)[mask], np.asarray(between.gyro)[mask]
    edges = np.linspace(end - interval, end, _PIECES + 1)
    turn = Rotation.identity()
    for middle, length in zip((edges[1:] + edges[:-1]) / 2, np.diff(edges), strict=True):
        turn = turn * Rotation.from_rotvec([length * np.interp(middle, time, axis) for axis in rate.T])
    return turn


def _compared(
    view: PlanView, seen: PlanView, angle: float, interval: float, most: int | None = None
) -> Displacement:
    """Return the displacement between two views, the second one turned; at most ``most`` cells are used."""
    centers = seen.centers @ turn(angle)
    every = 1 if most is None else -(-max(len(centers), 1) // most)
    return displacement(view, centers[::every], _FASTEST * interval)


def _turned(points: NDArray[np.float32], rotation: Rotation) -> NDArray[np.float32]:
    return points @ rotation.as_matrix().T.astype(np.float32)


_AFTER = 1, 3, 9
"""Numbers of scans after the first reference, one behind an outage and one in a turn, at which the motion
since then is compared."""
_AFTER_LATER, _WAY_LATER = 5, 10.0
"""Number of scans after any other reference at which the motion is compared, less if the way would be longer
than this, m."""
_AFTER_SLOW, _SLOW_M = 10, 2.0
"""Number of scans after such a reference at which the motion is compared once more where the estimate is
slow: over so many scans it moves less than this way, m. A match that stays behind a vehicle that moves off is
noticed earlier over a longer time."""
_TURNING = 0.02
"""A turn between two scans above which the motion is compared too, rad: a wrong gyroscope shows in turns."""
_DISTORTED = 0.05
"""Scans whose turns since the scans before them differ by more than this are not compared: their sweeps are
distorted differently, rad."""
_TURNS_COMPARED, _BETWEEN_TURNS = 5, 20
"""Number of references that are begun for a turn, and the least number of scans between them."""
_TURN_ERRORS = np.delete(np.arange(-15, 16), 15) * 0.02
"""Errors of the turn about the vertical that are searched where the estimated turn explains nothing, rad."""
_LEAST_TURN_ERROR = 0.06
"""Smaller errors of the turn are not told from none, rad."""
_ARM = 15.0
"""Distance at which an error of the turn counts as an error of the motion, m."""
_EVERY, _EVERY_AT_FIRST, _FIRST = 25, 10, 100
"""Number of scans from one reference to the next: in general, and among the first scans, when the vehicle
moves off on a map of one place. Where a comparison shows nothing, the next reference begins at once."""
_REACH = 5.0
"""Largest error that is searched, m."""
_UNSUSPICIOUS = 0.2
"""Smaller errors by cells are not refined, m."""
_STEP = 0.5
"""Distance between two errors that are tried, m."""
_POINTS = 40_000
"""A scan with more points is thinned to at most so many."""


@dataclass(frozen=True)
class _Reference:
    index: int
    view: PlanView
    T_world_lidar: NDArray[np.float64]
    after: tuple[int, ...]
    turned: NDArray[np.float64]
    """(3,) turn since the scan before, rad; not finite where there is none."""

    @property
    def searches_turns(self) -> bool:
        """Return whether a wrong turn is searched too: that takes 30 comparisons."""
        return self.after == _AFTER


class ShownMotion(NamedTuple):
    """What plan views show of the motion between two scans, beside the estimate."""

    error: float
    """Distance by which the estimate misplaces what stands 15 m away, m."""
    way: float
    """Distance between the two positions that the plan views show, m."""
    turn: float
    """Turn about the vertical that the plan views show, rad."""
    scans: int
    """Number of scans from the first of the two to the second."""


class Agreement(NamedTuple):
    """How much of what stands upright is where the estimated motion puts it."""

    cells: int
    """Number of cells of the later plan view in which something stands."""
    met: int
    """Number of those cells that meet one of the earlier view after the estimated motion."""


class Look(NamedTuple):
    """What the comparison of two plan views shows."""

    shown: ShownMotion | None = None
    """The motion; None where nothing was compared, or where it is hidden."""
    is_hidden: bool | None = None
    """Whether the views fit each other at several displacements or at none; None: nothing was compared."""
    agreement: Agreement | None = None
    """How the views fit at the estimated displacement; only where the motion is hidden and the estimate moves
    by less than 2 m, so that both views show the same place."""


class MotionCheck:
    """Compares the estimated motion with the plan views of single scans."""

    def __init__(self) -> None:
        self._reference: _Reference | None = None
        self._next = 0
        self._turns = 0
        self._next_turn = 0
        self._before: NDArray[np.float64] | None = None

    def __call__(self, index: int, scan: Scan, T_world_lidar: NDArray[np.float64], lost: bool) -> Look:
        """Return what plan views show of the motion since the reference.

        Args:
            index: number of the scan.
            scan: padded, numpy leaves.
            T_world_lidar: (4, 4) estimated pose.
            lost: the scan was not matched.
        """
        turned, step = self._motion_since_last(T_world_lidar)
        if lost:
            # the next matched scan is compared with the one after it
            self._reference, self._next = None, index + 1
            return Look()
        reference, look = self._reference, Look()
        since = index - reference.index if reference else 0
        turning = abs(turned[2]) > _TURNING and index >= self._next_turn and self._turns < _TURNS_COMPARED
        begins = index >= self._next or turning
        compared = reference if reference is not None and since in reference.after else None
        if not begins and compared is None:
            return look
        view = _view(scan, T_world_lidar)
        # of the first scan's own turn nothing is known
        if compared is not None and not np.linalg.norm(turned - compared.turned) > _DISTORTED:
            look = _compared_with(compared, view, T_world_lidar, since)
            begins = begins or (bool(look.is_hidden) and not compared.searches_turns)
        if not begins:
            return look
        if turning:
            self._turns, self._next_turn = self._turns + 1, index + _BETWEEN_TURNS
        later = int(np.clip(_WAY_LATER / max(step, 1e-3), 1, _AFTER_LATER))
        slow = (_AFTER_SLOW,) if _AFTER_SLOW * step < _SLOW_M else ()
        after = _AFTER if turning or reference is None else (later, *slow)
        self._reference = _Reference(index, view, T_world_lidar, after, turned)
        self._next = index + (_EVERY_AT_FIRST if index < _FIRST else _EVERY)
        return look

    def _motion_since_last(self, T_world_lidar: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
        """Return the turn since the last scan, (3,) rad in the world's axes, and the distance, m."""
        before, self._before = self._before, T_world_lidar
        if before is None:
            return np.full(3, np.nan), 0.0
        moved = T_world_lidar[:3, 3] - before[:3, 3]
        return _turn_between(before, T_world_lidar), float(np.linalg.norm(moved))


def _view(scan: Scan, T_world_lidar: NDArray[np.float64]) -> PlanView:
    return plan_view(_turned(_points(scan, _POINTS), Rotation.from_matrix(T_world_lidar[:3, :3])))


def _compared_with(
    reference: _Reference, view: PlanView, T_world_lidar: NDArray[np.float64], scans: int
) -> Look:
    """Return what two views show of the motion between them."""
    moved = (T_world_lidar - reference.T_world_lidar)[:2, 3].astype(np.float32)
    if np.linalg.norm(moved) > _FAR:
        return Look()
    estimated = float(_turn_between(reference.T_world_lidar, T_world_lidar)[2])
    step = FINE if len(view.centers) < _COARSELY else _STEP

    def compared(angle: float, every: int = 1) -> Displacement:
        centers = (view.centers @ turn(angle))[::every]
        return displacement(reference.view, centers + moved, _REACH, step)

    def hidden() -> Look:
        if np.linalg.norm(moved) > _SLOW_M:
            return Look(is_hidden=True)
        meeting = met(reference.view, view.centers + moved)
        return Look(is_hidden=True, agreement=Agreement(len(view.centers), meeting))

    found, angle = compared(0.0), 0.0
    if not found.is_certain and not reference.searches_turns:
        return hidden()
    if not found.is_certain:
        every = max(1, len(view.centers) // _COARSELY)
        angle = float(max(_TURN_ERRORS, key=lambda one: compared(one, every).votes))
        straight, found = found.votes, compared(angle)
        is_turned = abs(angle) >= _LEAST_TURN_ERROR
        if not found.is_certain or (is_turned and not leads(found.votes, straight)):
            return hidden()
    shift = found.shift
    if np.linalg.norm(shift) > _UNSUSPICIOUS:
        shift = refined(reference.view, view.points @ turn(angle) + moved, shift)
    error, way = float(np.linalg.norm(shift)), float(np.linalg.norm(moved + shift))
    if abs(angle) < _LEAST_TURN_ERROR:
        return Look(ShownMotion(error, way, estimated, scans), False)
    return Look(ShownMotion(error + _ARM * abs(angle), way, estimated + angle, scans), False)


def _turn_between(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the turn between two poses (4, 4), (3,) rad in the world's axes."""
    turned: NDArray[np.float64] = Rotation.from_matrix(after[:3, :3] @ before[:3, :3].T).as_rotvec()
    return turned


_FAR = 15.0
"""Motion beyond which two views have too little in common, m."""
