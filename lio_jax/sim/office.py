"""An office floor: rooms, doors and furniture."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.assembly import assembled, upright
from lio_jax.sim.traffic import Loop, traffic
from lio_jax.sim.worlds import Route, Scene

HALF_THICKNESS = 0.06
"""Half the thickness of a wall, m."""
DOOR_HEIGHT = 2.1
"""Height of a door opening, m."""


def wall(
    begin: tuple[float, float],
    end: tuple[float, float],
    heights: tuple[float, float],
    reflectivity: float,
    doors: Sequence[tuple[float, float]] = (),
) -> NDArray[np.float64]:
    """Return the box rows of a wall along x or y.

    Args:
        begin: the end with the lower coordinates, m.
        end: the other end, m.
        heights: heights of foot and top, m.
        reflectivity: 0 to 1.
        doors: for each opening in order: distance of its middle from ``begin`` and its width, m.
    """
    axis = 0 if end[0] != begin[0] else 1
    across = 1 - axis
    length = end[axis] - begin[axis]
    edges = [0.0, *(middle + side * width / 2 for middle, width in doors for side in (-1, 1)), length]
    piers = [(low, high, heights[0]) for low, high in zip(edges[::2], edges[1::2], strict=True)]
    lintels = [
        (low - HALF_THICKNESS, high + HALF_THICKNESS, heights[0] + DOOR_HEIGHT)
        for low, high in zip(edges[1:-1:2], edges[2:-1:2], strict=True)
    ]
    # walls reach into the walls they meet, and lintels into their piers, so that no ray passes between them
    piers[0] = (-HALF_THICKNESS, *piers[0][1:])
    piers[-1] = (piers[-1][0], length + HALF_THICKNESS, heights[0])
    rows = []
    for low, high, foot in piers + lintels:
        near, far = np.array([*begin, foot]), np.array([*begin, heights[1]])
        near[axis], far[axis] = begin[axis] + low, begin[axis] + high
        near[across], far[across] = begin[across] - HALF_THICKNESS, begin[across] + HALF_THICKNESS
        rows.append(upright(near, far, reflectivity))
    return np.concatenate(rows)


def open_leaf(
    hinge: tuple[float, float], heading: float, width: float, foot: float, reflectivity: float
) -> NDArray[np.float64]:
    """Return the box row of a door leaf that points from its hinge towards ``heading`` (rad)."""
    x = hinge[0] + np.cos(heading) * width / 2
    y = hinge[1] + np.sin(heading) * width / 2
    return np.array([[x, y, foot + DOOR_HEIGHT / 2, width / 2, 0.02, DOOR_HEIGHT / 2, heading, reflectivity]])


_WIDTH, _LENGTH = 24.0, 12.0
"""Size of the block of rooms inside the ring corridor, m; its low corner is the builder's origin."""
_CORRIDOR, _DEPTH = 2.0, 5.0
"""Width of the corridor and depth of the rooms outside it, m."""
_HALL = (8.0, 16.0)
"""Where the big hall inside the ring begins and ends along x, m."""
_LANES = (10.0, 13.6)
"""Where the walk passes the hall's double doors, m along x."""
_TURN = 3.0
"""Where the walk goes from one lane to the other, m along y."""
_HEIGHTS = (0.0, 2.8)
_HAND = 1.4
"""Height at which the sensor is carried, m."""
_PAINT = 0.75


def office(seed: int) -> Scene:
    """Return the floor and a walk with a hand-held sensor around its corridors and through the hall."""
    rng = np.random.default_rng(seed)
    edge = _CORRIDOR + _DEPTH
    shell = upright([-edge, -edge, _HEIGHTS[0]], [_WIDTH + edge, _LENGTH + edge, _HEIGHTS[1]], _PAINT)
    start = np.array([6.0, -_CORRIDOR / 2, _HAND])
    people = [np.array([[0, 0, 0.875, 0.15, 0.25, 0.875, 0, 0.4]])] * 2
    loops = [Loop((17.2, 1.2), (22.8, 4.8), 0.5, 1.0, 1), Loop((1.2, 7.2), (6.8, 10.8), 0.5, 0.8, 1)]
    world = assembled(
        start,
        boxes=np.concatenate([shell, _inner(rng), _outer(rng)]),
        cylinders=[[x, y, 0, 0.25, _HEIGHTS[1], 0.6] for x in (11.8,) for y in (4.4, 11.0)],
        traffic=traffic(loops, lambda points: np.zeros(len(points)), people, rng),
    )
    return Scene(world, Route(_route() - start, closed=True, radius=0.6, speed=1.2, dynamics="handheld"))


def _route() -> NDArray[np.float64]:
    middle = _CORRIDOR / 2
    plan = [
        [6.0, -middle],
        [_WIDTH + middle, -middle],
        [_WIDTH + middle, _LENGTH + middle],
        [_LANES[1], _LENGTH + middle],
        [_LANES[1], _TURN],
        [_LANES[0], _TURN],
        [_LANES[0], _LENGTH + middle],
        [-middle, _LENGTH + middle],
        [-middle, -middle],
    ]
    height = _HAND + 0.08 * np.sin(np.arange(len(plan)))
    return np.column_stack([plan, height])


def _inner(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return walls and furniture of the hall and of the four rooms next to it."""
    west, east = _HALL
    half = _LENGTH / 2
    double = 1.5
    shift = rng.uniform(-0.8, 0.8, 4)
    doors_south = [(4.0 + shift[0], 1.0), (12.0, double), (20.0 + shift[1], 1.4)]
    doors_north = [(4.0 + shift[2], 1.4), (_LANES[0], double), (_LANES[1], double), (20.0 + shift[3], 1.0)]
    rows = [
        wall((0.0, 0.0), (_WIDTH, 0.0), _HEIGHTS, _PAINT, doors_south),
        wall((0.0, _LENGTH), (_WIDTH, _LENGTH), _HEIGHTS, _PAINT, doors_north),
        wall((0.0, 0.0), (0.0, _LENGTH), _HEIGHTS, _PAINT),
        wall((_WIDTH, 0.0), (_WIDTH, _LENGTH), _HEIGHTS, _PAINT),
        wall((west, 0.0), (west, _LENGTH), _HEIGHTS, _PAINT),
        wall((east, 0.0), (east, _LENGTH), _HEIGHTS, _PAINT),
        wall((0.0, half), (west, half), _HEIGHTS, _PAINT),
        wall((east, half), (_WIDTH, half), _HEIGHTS, _PAINT),
        # a long table and cupboards in the hall, a table in each room
        upright([11.2, 5.5, 0.70], [12.4, 10.0, 0.74], 0.5),
        upright([11.3, 7.6, 0], [12.3, 7.9, 0.7], 0.3),
        upright([8.1, 0.3, 0], [8.5, 2.0, 1.9], 0.4),
        upright([15.4, 4.0, 0], [15.9, 9.0, 1.2], 0.4),
    ]
    for x, y in ((4, 3), (4, 9), (20, 3), (20, 9)):
        size = rng.uniform([0.6, 0.4, 0.7], [1.2, 0.8, 1.1])
        rows.append(upright([x - size[0], y - size[1], 0], [x + size[0], y + size[1], size[2]], 0.5))
    return np.concatenate(rows)


def _outer(rng: np.random.Generator) -> NDArray[np.float64]:
    """Return walls, open doors, desks and shelves of the rooms outside the corridor."""
    low = -_CORRIDOR
    right, top = _WIDTH + _CORRIDOR, _LENGTH + _CORRIDOR
    columns, lines = np.linspace(low, right, 7), np.linspace(low, top, 5)
    rows = []
    for side in (low, top):
        middles = (columns[:-1] + columns[1:]) / 2 + rng.uniform(-1, 1, 6)
        away = -1 if side == low else 1
        doors = [(float(middle - low), 1.0) for middle in middles]
        rows.append(wall((low, side), (right, side), _HEIGHTS, _PAINT, doors))
        for x in columns:
            rows.append(
                wall(
                    (x, min(side, side + away * _DEPTH)),
                    (x, max(side, side + away * _DEPTH)),
                    _HEIGHTS,
                    _PAINT,
                )
            )
        for x, middle in zip(columns[:-1], middles, strict=True):
            swing = rng.uniform(0.6, 2.2)
            rows.append(open_leaf((middle - 0.5, side + away * 0.07), away * swing, 0.95, 0.0, 0.5))
            rows.append(_desk_and_shelf(rng, x + 0.1, side + away * 3.0, away))
    for side in (low, right):
        middles = (lines[:-1] + lines[1:]) / 2 + rng.uniform(-0.8, 0.8, 4)
        away = -1 if side == low else 1
        doors = [(float(middle - low), 1.0) for middle in middles]
        rows.append(wall((side, low), (side, top), _HEIGHTS, _PAINT, doors))
        for y in lines[1:-1]:
            rows.append(
                wall(
                    (min(side, side + away * _DEPTH), y),
                    (max(side, side + away * _DEPTH), y),
                    _HEIGHTS,
                    _PAINT,
                )
            )
        for middle in middles:
            rows.append(
                upright(
                    [side + away * 3.6 - 0.5, middle - 0.9, 0],
                    [side + away * 3.6 + 0.5, middle + 0.9, 0.75],
                    0.5,
                )
            )
    return np.concatenate(rows)


def _desk_and_shelf(rng: np.random.Generator, x: float, y: float, away: int) -> NDArray[np.float64]:
    shift, length = rng.uniform(0.6, 1.4), rng.uniform(1.2, 1.8)
    back = y + away * 1.9
    return np.concatenate(
        [
            upright([x + shift, y - 0.4, 0.70], [x + shift + length, y + 0.4, 0.74], 0.5),
            upright(
                [x + shift + 0.1, min(back, back - away * 0.4), 0],
                [x + shift + 1.3, max(back, back - away * 0.4), 1.8],
                0.4,
            ),
        ]
    )
