"""Bodies that drive or walk on closed loops: their paths, and the boxes that form them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.assembly import Traffic

_STEPS = 512
"""Number of path points in a lap."""

_Height = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@dataclass(frozen=True)
class Loop:
    """A rectangle with rounded corners, driven clockwise by bodies that are evenly spaced in time."""

    low: tuple[float, float]
    """Corner with the lowest x and y, m."""
    high: tuple[float, float]
    """Corner with the highest x and y, m."""
    radius: float
    """Radius of the rounded corners, m."""
    speed: float
    """Speed of the bodies, m/s."""
    bodies: int
    """Number of bodies on the loop."""


def car_boxes(
    center: NDArray[np.float64],
    yaw: NDArray[np.float64],
    length: NDArray[np.float64],
    height: NDArray[np.float64],
    reflectivity: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return box rows of cars (body and cabin) that stand on the points ``center`` (n, 3), m."""
    rows = len(center)
    body = np.stack([length / 2, np.full(rows, 0.9), np.full(rows, 0.4)], axis=1)
    cabin = np.stack([length / 4, np.full(rows, 0.75), (height - 0.95) / 2], axis=1)
    bodies = np.column_stack([center + np.array([0, 0, 0.55]), body, yaw, reflectivity])
    above = np.stack([np.zeros(rows), np.zeros(rows), (height + 0.95) / 2], axis=1)
    return np.concatenate([bodies, np.column_stack([center + above, cabin, yaw, reflectivity])])


def traffic(
    loops: Sequence[Loop], height: _Height, bodies: Sequence[NDArray[np.float64]], rng: np.random.Generator
) -> Traffic:
    """Return the traffic on the loops.

    Args:
        loops: the closed paths.
        height: function that returns the ground's height at (n, 2) positions, m.
        bodies: box rows of each body in its own frame, loop by loop.
        rng: draws where on its loop the first body starts.
    """
    paths, yaws, periods = [], [], []
    for loop in loops:
        points, yaw, length = _rounded_rectangle(loop)
        path = np.column_stack([points, height(points)])
        begin = int(rng.integers(_STEPS))
        for number in range(loop.bodies):
            shift = begin + number * _STEPS // loop.bodies
            paths.append(np.roll(path, -shift, axis=0))
            yaws.append(np.roll(yaw, -shift))
            periods.append(length / loop.speed)
    body = np.repeat(np.arange(len(bodies)), [len(rows) for rows in bodies])
    return Traffic(np.array(paths), np.array(yaws), np.array(periods), body, np.concatenate(bodies))


def _rounded_rectangle(loop: Loop) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return points (m) at equal steps, headings (rad) and length (m) of the loop, from its low corner up."""
    low, high = np.array(loop.low) + loop.radius, np.array(loop.high) - loop.radius
    straight = high - low
    arc = np.pi / 2 * loop.radius
    length = 2 * straight.sum() + 4 * arc
    # the pieces in order: west side up, arc, north side, arc, ...; the position in a piece gives the point
    centers = np.array([[low[0], high[1]], high, [high[0], low[1]], low])
    begins = np.array([[low[0], low[1]], [low[0], high[1]], high, [high[0], low[1]]])
    headings = np.pi / 2 - np.pi / 2 * np.arange(4)
    passed = np.arange(_STEPS) * length / _STEPS
    points, yaw = np.zeros((_STEPS, 2)), np.zeros(_STEPS)
    start = 0.0
    for side in range(4):
        run = straight[1] if side % 2 == 0 else straight[0]
        ahead = np.array([np.cos(headings[side]), np.sin(headings[side])])
        left = np.array([-ahead[1], ahead[0]])
        here = passed - start
        on_line, on_arc = (here >= 0) & (here < run), (here >= run) & (here < run + arc)
        points[on_line] = begins[side] + loop.radius * left + here[on_line, None] * ahead
        yaw[on_line] = headings[side]
        turned = (here[on_arc, None] - run) / loop.radius
        points[on_arc] = centers[side] + loop.radius * (np.cos(turned) * left + np.sin(turned) * ahead)
        yaw[on_arc] = headings[side] - turned[:, 0]
        start += run + arc
    return points, yaw, float(length)
