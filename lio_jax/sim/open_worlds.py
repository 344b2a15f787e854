"""Worlds of a few shapes: a room with closed-form distances, a street and an open field."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.assembly import Terrain, assembled, draws, upright
from lio_jax.sim.blocks import Sides, block_sides, lap
from lio_jax.sim.worlds import Route, Scene

SIZE = np.array([12.0, 8.0, 3.5])
"""Size of the room along x, y and z, m; the builder's frame has its origin at the floor's centre."""
PILLAR = (0.0, 0.0, 0.4)
"""Position x, y and radius of the pillar, m; it reaches from floor to ceiling."""
BALL = (4.9, 2.9, 0.6, 0.5)
"""Centre x, y, z and radius of the ball, m."""
START = np.array([-1.0, -2.2, 1.4])
"""Start of the route, m."""


def room(seed: int) -> Scene:
    """Return the room and a walk around its pillar; ``seed`` changes the reflectivities only."""
    reflectivity = np.random.default_rng(seed).uniform(0.2, 0.9, 3)
    half = SIZE / 2
    world = assembled(
        START,
        boxes=upright([-half[0], -half[1], 0], [half[0], half[1], SIZE[2]], reflectivity[0]),
        cylinders=[[PILLAR[0], PILLAR[1], 0, PILLAR[2], SIZE[2], reflectivity[1]]],
        spheres=[[*BALL, reflectivity[2]]],
    )
    points = np.array(
        [[-1.0, -2.2, 1.4], [3.4, -2.2, 1.5], [3.4, 2.2, 1.3], [-3.6, 2.4, 1.45], [-4.0, -2.2, 1.4]]
    )
    return Scene(world, Route(points - START, closed=True, radius=0.8, speed=1.1, dynamics="handheld"))


_BODY_HEIGHT = 1.5
"""Height of the body frame above the ground at rest, m."""


def street(seed: int) -> Scene:
    """Return the quarter and a car's lap through it; ``seed`` changes the quarter but not the lap."""
    route = np.insert(lap(), 2, _BODY_HEIGHT, axis=1)
    sides = block_sides()
    keys = jax.random.split(jax.random.key(seed), 3)
    boxes = np.concatenate([_houses(sides, keys[0]), _cars(sides, keys[1])])
    cylinders = _poles_and_trees(sides, keys[2])
    world = assembled(route[0], planes=[[0, 0, 0, 0, 0, 1, 0.2]], boxes=boxes, cylinders=cylinders)
    return Scene(world, Route(route - route[0], closed=True, radius=9.0, speed=6.2, dynamics="car"))


def _draws(key: jax.Array, rows: int, *ranges: tuple[float, float]) -> NDArray[np.float64]:
    unit = np.asarray(jax.random.uniform(key, (rows, len(ranges)), jnp.float32), np.float64)
    low, high = np.array(ranges).T
    return (low + unit * (high - low)).T


def _houses(sides: Sides, key: jax.Array) -> NDArray[np.float64]:
    side, middle, width = sides.slots(pitch=12.0, margin=0.0)
    setback, gap, depth, height, reflectivity = _draws(
        key, len(side), (0.0, 2.5), (0.0, 2.5), (7.0, 11.0), (6.0, 20.0), (0.2, 0.7)
    )
    center = sides.points(side, middle, setback + depth / 2)
    half = np.stack([(width - gap) / 2, depth / 2, height / 2], axis=1)
    return np.column_stack([center, height / 2, half, sides.yaw(side), reflectivity])


def _cars(sides: Sides, key: jax.Array) -> NDArray[np.float64]:
    side, middle, _ = sides.slots(pitch=6.5, margin=8.0)
    present, shift, turn, length, height, reflectivity = _draws(
        key, len(side), (0.0, 1.0), (-0.5, 0.5), (-0.04, 0.04), (3.8, 4.8), (1.4, 1.8), (0.1, 0.9)
    )
    center = sides.points(side, middle + shift, np.full(len(side), -3.0))
    yaw = sides.yaw(side) + turn
    body = np.stack([length / 2, np.full(len(side), 0.9), np.full(len(side), 0.35)], axis=1)
    cabin = np.stack([length / 4, np.full(len(side), 0.75), (height - 0.9) / 2], axis=1)
    bodies = np.column_stack([center, np.full(len(side), 0.55), body, yaw, reflectivity])
    cabins = np.column_stack([center, (height + 0.9) / 2, cabin, yaw, reflectivity])
    parked = present < 0.45
    return np.concatenate([bodies[parked], cabins[parked]])


def _poles_and_trees(sides: Sides, key: jax.Array) -> NDArray[np.float64]:
    side, middle, width = sides.slots(pitch=9.0, margin=4.0)
    present, shift, radius, height, crown, crown_height, reflectivity = _draws(
        key, len(side), (0.0, 1.0), (-0.25, 0.25), (0.1, 0.25), (2.6, 3.6), (0.8, 1.5), (1.5, 3.0), (0.2, 0.6)
    )
    position = sides.points(side, middle + shift * width, np.full(len(side), -1.6))
    ground = np.zeros(len(side))
    poles = np.column_stack([position, ground, radius / 2, np.full(len(side), 6.5), reflectivity])
    trunks = np.column_stack([position, ground, radius, height, reflectivity])
    crowns = np.column_stack([position, height, crown, crown_height, reflectivity])
    is_pole, is_tree = present < 0.35, present > 0.55
    return np.concatenate([poles[is_pole], trunks[is_tree], crowns[is_tree]])


_EXTENT = 110.0
"""Half the width of the field, m."""
_TREES, _POSTS, _BALES = 14, 10, 6
_ROUTE = np.array(
    [
        [-20.0, -40.0, 5.0],
        [30.0, -40.0, 6.0],
        [55.0, -20.0, 9.0],
        [50.0, 25.0, 7.0],
        [10.0, 10.0, 5.0],
        [-10.0, 45.0, 8.0],
        [-50.0, 30.0, 10.0],
        [-55.0, -30.0, 7.0],
    ]
)
"""Vertices (x, y, height above ground), m."""
_CLEAR = 6.0
"""Horizontal distance from the route within which nothing grows, m."""


def field(seed: int) -> Scene:
    """Return the field and a drone's flight over it; the flight's plan is the same for every seed."""
    rng = np.random.default_rng(seed)
    terrain = _terrain(rng)
    radius, height, crown, yaw, reflectivity = draws(
        rng, _TREES + _POSTS + _BALES, (0.15, 0.3), (2.5, 4.5), (1.5, 2.8), (0.0, np.pi), (0.2, 0.7)
    )
    position = _clear_positions(rng, _TREES + _POSTS + _BALES)
    ground = terrain.height(position) - 0.5
    tree, post, bale = np.split(np.arange(len(position)), [_TREES, _TREES + _POSTS])
    trunks = np.column_stack([position, ground, radius, height + 0.5, reflectivity])[tree]
    posts = np.column_stack([position, ground, radius / 3, np.full(len(position), 2.3), reflectivity])[post]
    crowns = np.column_stack([position, ground + height + 0.7 * crown, crown, reflectivity])[tree]
    size = np.tile([1.2, 0.8, 1.0], (len(position), 1))
    bales = np.column_stack([position, ground + 0.6, size, yaw, reflectivity])[bale]
    route = _ROUTE + np.column_stack([np.zeros((len(_ROUTE), 2)), terrain.height(_ROUTE[:, :2])])
    world = assembled(
        route[0],
        terrain=terrain,
        boxes=bales,
        cylinders=np.concatenate([trunks, posts]),
        spheres=crowns,
    )
    return Scene(world, Route(route - route[0], closed=True, radius=10.0, speed=5.0, dynamics="drone"))


def _terrain(rng: np.random.Generator) -> Terrain:
    heading = rng.uniform(0.0, np.pi) + np.array([0.0, 1.2, 2.1])
    number = 2 * np.pi / np.array([180.0, 110.0, 45.0])
    wave = number[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return Terrain(np.array([1.8, 0.8, 0.2]), wave, rng.uniform(0, 2 * np.pi, 3), 0.25)


def _clear_positions(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return positions (count, 2) away from the route's polyline, m."""
    begin, end = _ROUTE[:, :2], np.roll(_ROUTE[:, :2], -1, axis=0)
    along = end - begin
    chosen: list[np.ndarray] = []
    while len(chosen) < count:
        point = rng.uniform(-_EXTENT, _EXTENT, 2)
        share = np.clip(np.sum((point - begin) * along, axis=1) / np.sum(along**2, axis=1), 0, 1)
        if np.linalg.norm(begin + share[:, None] * along - point, axis=1).min() > _CLEAR:
            chosen.append(point)
    return np.array(chosen)
