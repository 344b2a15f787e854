"""Turn a route's polyline into the control points of a smooth path that slows down at corners."""

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, minimum_filter1d

from lio_jax.core.errors import UsageError
from lio_jax.sim.worlds import Route

_KNOTS_PER_RADIUS = 5.0
"""Number of knots per radius of arc length in a corner: the spline cuts the corner by 1 % of the radius."""
_WIDEST = 8.0
"""A gentle bend is rounded with a radius up to this many times the route's radius."""


class TimedPath(NamedTuple):
    """Control points and the constant rate at which they are passed."""

    control: NDArray[np.float64]
    """Control points, (n, 3) m; an open path has two more before its start and three more behind its end."""
    knot_rate: float
    """Number of control points passed in a second at full speed."""


def timed_path(route: Route, lateral: float, braking: float) -> TimedPath:
    """Round the corners of a route and space the control points by the speed that suits each place.

    Args:
        route: the polyline.
        lateral: acceleration in a corner that sets the speed there, m/s^2.
        braking: mean deceleration ahead of a corner, m/s^2.

    Returns:
        The control points. A uniform quintic B-spline through an open path starts at its first vertex and
        ends at its last.

    Raises:
        UsageError: the route has too few points, turns back on itself, or climbs too steeply for its heading
            to be defined.
    """
    points = _checked(route)
    step = route.radius / 100
    path, curvature = _rounded(points, route.closed, route.radius, step)
    if route.closed:
        first = int(np.argmin(np.linalg.norm(path - points[0], axis=1)))
        path, curvature = np.roll(path, -first, axis=0), np.roll(curvature, -first)
        path, curvature = np.vstack([path, path[:1]]), np.append(curvature, curvature[0])
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    places = np.linspace(0, along[-1], math.ceil(along[-1] / step) + 1)
    bend = np.maximum(np.interp(places, along, curvature), lateral / route.speed**2)
    wanted = np.sqrt(lateral / bend)
    corner_speed = min(route.speed, math.sqrt(lateral * route.radius))
    # the distance of gentle braking: the body slows down over it before a corner and speeds up over it after
    reach = max((route.speed**2 - corner_speed**2) / (2 * braking), route.radius / 2)
    speed = _eased(wanted, reach / (places[1] - places[0]), "wrap" if route.closed else "nearest")
    knot_rate = _KNOTS_PER_RADIUS * corner_speed / route.radius
    slowness = knot_rate * (1 / speed[1:] + 1 / speed[:-1]) / 2
    passed = np.concatenate([[0], np.cumsum(slowness * np.diff(places))])
    count = max(8, round(passed[-1]))
    share = np.linspace(0, passed[-1], count + 1)
    at = np.interp(share[:-1] if route.closed else share, passed, places)
    control = np.stack([np.interp(at, along, path[:, axis]) for axis in range(3)], axis=1)
    return TimedPath(control if route.closed else extended(control), knot_rate)


def extended(control: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mirror two rows before the first and three behind the last, so that the spline meets both ends."""
    before = 2 * control[0] - control[2:0:-1]
    after = 2 * control[-1] - control[-2:-5:-1]
    return np.concatenate([before, control, after])


def _checked(route: Route) -> NDArray[np.float64]:
    points = np.asarray(route.points, np.float64)
    least = 3 if route.closed else 2
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < least:
        raise UsageError(f"route.points: shape {points.shape}; give at least {least} points of x y z.")
    if not (route.radius > 0 and route.speed > 0):
        raise UsageError(
            f"route: radius {route.radius} m and speed {route.speed} m/s; both must be greater than zero."
        )
    sides = (np.roll(points, -1, axis=0) if route.closed else points[1:]) - points[
        : None if route.closed else -1
    ]
    level, length = np.linalg.norm(sides[:, :2], axis=1), np.linalg.norm(sides, axis=1)
    for index in np.flatnonzero(level < 0.3 * np.maximum(length, 1e-9)):
        raise UsageError(
            f"route.points: from point {index} to the next the route is upright or stands still, which "
            "leaves the heading open; let it climb at less than 70 degrees."
        )
    return points


def _rounded(
    points: NDArray[np.float64], closed: bool, radius: float, step: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return samples (m) about ``step`` m apart, and the curvature of the path at each sample, 1/m."""
    count = len(points)
    path: list[NDArray[np.float64]] = [] if closed else [points[:1]]
    bends: list[NDArray[np.float64]] = [] if closed else [np.zeros(1)]
    for index in range(count) if closed else range(1, count - 1):
        before, corner, after = points[index - 1], points[index], points[(index + 1) % count]
        arc, arc_curvature = _corner(before, corner, after, radius, step, index)
        if path:
            _join(path, bends, arc[0], step)
        path.append(arc)
        bends.append(np.full(len(arc), arc_curvature))
    _join(path, bends, path[0][0] if closed else points[-1], step)
    if not closed:
        path.append(points[-1:])
        bends.append(np.zeros(1))
    return np.concatenate(path), np.concatenate(bends)


def _corner(
    before: NDArray[np.float64],
    corner: NDArray[np.float64],
    after: NDArray[np.float64],
    radius: float,
    step: float,
    index: int,
) -> tuple[NDArray[np.float64], float]:
    lengths = float(np.linalg.norm(corner - before)), float(np.linalg.norm(after - corner))
    arrive, leave = (corner - before) / lengths[0], (after - corner) / lengths[1]
    across = leave - (leave @ arrive) * arrive
    turn = math.atan2(float(np.linalg.norm(across)), float(leave @ arrive))
    if turn < 1e-6:
        return corner[None], 0.0
    if turn > math.radians(170):
        raise UsageError(f"route.points: the route turns back on itself at point {index}; go around instead.")
    # gentle bends get a wider radius: a change of slope must not slow the body down as a street corner does
    wide = radius * min(_WIDEST, max(1.0, math.sin(math.pi / 4) / math.sin(turn / 2)))
    fitting = min(wide, 0.5 * min(lengths) / math.tan(turn / 2))
    angles = np.linspace(0, turn, max(2, math.ceil(fitting * turn / step)))[:, None]
    entry = corner - fitting * math.tan(turn / 2) * arrive
    side = across / np.linalg.norm(across)
    return entry + fitting * (np.sin(angles) * arrive + (1 - np.cos(angles)) * side), 1 / fitting


def _join(
    path: list[NDArray[np.float64]], bends: list[NDArray[np.float64]], end: NDArray[np.float64], step: float
) -> None:
    start = path[-1][-1]
    count = max(2, math.ceil(np.linalg.norm(end - start) / step))
    path.append(start + np.linspace(0, 1, count, endpoint=False)[1:, None] * (end - start))
    bends.append(np.zeros(count - 1))


def _eased(speed: NDArray[np.float64], reach: float, mode: Literal["wrap", "nearest"]) -> NDArray[np.float64]:
    """Lower the speed smoothly within ``reach`` samples of slower places, never above the wanted speed."""
    half = max(1, round(reach / 2))
    window = np.hanning(2 * half + 3)[1:-1]
    lowest = minimum_filter1d(speed, 2 * half + 1, mode=mode)
    return convolve1d(lowest, window / window.sum(), mode=mode)
