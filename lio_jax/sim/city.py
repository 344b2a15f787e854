"""A hilly quarter: houses with balconies, kerbs, poles, trees, parked cars and traffic."""

import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.assembly import Terrain, Traffic, assembled, draws
from lio_jax.sim.blocks import HALF_STREET, LANE, LAP_BLOCKS, Sides, block_corners, block_sides, lap
from lio_jax.sim.traffic import Loop, car_boxes, traffic
from lio_jax.sim.worlds import Route, Scene

_BODY_HEIGHT = 1.6
"""Height of the body frame above the ground, m."""
_KERB_LINE = 1.9
"""Distance from the building line to the kerb, m."""
_KERB_HEIGHT = 0.14
_SIDE_BLOCKS = [(-1, -1), (2, -1), (2, 1), (1, 2)]
"""Blocks at crossings of the lap: a clockwise loop around one of them never crosses the lap."""
_ASPHALT, _PAVEMENT = 0.15, 0.3


def city(seed: int) -> Scene:
    """Return the quarter and a car's lap through it; the lap's plan is the same for every seed.

    Traffic keeps to clockwise loops around blocks, which never touch the lap's counterclockwise lane.
    """
    rng = np.random.default_rng(seed)
    sides, terrain = block_sides(), _terrain(rng)
    houses = _houses(sides, terrain, rng)
    cars = _parked_cars(sides, terrain, rng)
    poles, crowns = _poles_and_trees(sides, terrain, rng)
    route = _route(terrain)
    world = assembled(
        route[0],
        terrain=terrain,
        boxes=np.concatenate([houses, cars]),
        tilted=_pavements(sides, terrain),
        cylinders=poles,
        spheres=crowns,
        traffic=_traffic(terrain, rng),
    )
    return Scene(world, Route(route - route[0], closed=True, radius=9.0, speed=8.0, dynamics="car"))


def _terrain(rng: np.random.Generator) -> Terrain:
    heading = rng.uniform(0, np.pi) + np.array([0.0, 1.3])
    number = 2 * np.pi / np.array([360.0, 250.0])
    wave = number[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1)
    return Terrain(np.array([2.0, 0.9]), wave, rng.uniform(0, 2 * np.pi, 2), _ASPHALT)


def _route(terrain: Terrain) -> NDArray[np.float64]:
    corners = lap()
    path = []
    for here, there in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        length = float(np.linalg.norm(there - here))
        # vertices about every 12 m follow the slope; none is so near a turn that it limits the radius
        passed = np.append(0.0, np.linspace(14, length - 14, int((length - 28) / 12) + 1))
        path.append(here + passed[:, None] * (there - here) / length)
    plan = np.concatenate(path)
    return np.column_stack([plan, terrain.height(plan) + _BODY_HEIGHT])


def _houses(sides: Sides, terrain: Terrain, rng: np.random.Generator) -> NDArray[np.float64]:
    side, middle, width = sides.slots(pitch=13.0, margin=0.0)
    rows = len(side)
    setback, gap, depth, height, reflectivity = draws(
        rng, rows, (0.0, 2.5), (0.0, 2.5), (7.0, 11.0), (6.0, 20.0), (0.2, 0.7)
    )
    center = sides.points(side, middle, setback + depth / 2)
    foot = terrain.height(center) - 1.5
    yaw = sides.yaw(side)
    half = np.stack([(width - gap) / 2, depth / 2, (height + 1.5) / 2], axis=1)
    houses = np.column_stack([center, foot + half[:, 2], half, yaw, reflectivity])
    present, wide, deep, up = draws(rng, rows, (0.0, 1.0), (1.2, 2.5), (0.8, 1.4), (3.0, 5.0))
    front = sides.points(side, middle, setback)
    balcony = np.stack([wide, deep, np.full(rows, 0.5)], axis=1)
    balconies = np.column_stack([front, foot + 1.5 + up, balcony, yaw, 0.8 * reflectivity])
    return np.concatenate([houses, balconies[present < 0.4]])


def _pavements(sides: Sides, terrain: Terrain) -> NDArray[np.float64]:
    """Return slabs along all sides, each tilted as the ground is at the slab's middle."""
    ring = Sides(
        sides.start - _KERB_LINE * (sides.along + sides.inward),
        sides.along,
        sides.inward,
        sides.length + 2 * _KERB_LINE,
    )
    side, middle, width = ring.slots(pitch=16.0, margin=0.0)
    half = np.stack([width / 2, np.full(len(side), 2.5), np.full(len(side), 0.5)], axis=1)
    center = ring.points(side, middle, half[:, 1])
    slope = terrain.slope(center)
    up = np.column_stack([-slope, np.ones(len(side))])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    level = np.column_stack([ring.along[side], np.zeros(len(side))])
    along = level - np.sum(level * up, axis=1, keepdims=True) * up
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    rotation = np.stack([along, np.cross(up, along), up], axis=2)
    top = np.column_stack([center, terrain.height(center) + _KERB_HEIGHT])
    rows = [top - half[:, 2:] * up, half, rotation.reshape(-1, 9), np.full((len(side), 1), _PAVEMENT)]
    return np.concatenate(rows, axis=1)


def _parked_cars(sides: Sides, terrain: Terrain, rng: np.random.Generator) -> NDArray[np.float64]:
    side, middle, _ = sides.slots(pitch=6.5, margin=8.0)
    present, shift, turn, length, height, reflectivity = draws(
        rng, len(side), (0.0, 1.0), (-0.5, 0.5), (-0.04, 0.04), (3.8, 4.8), (1.4, 1.8), (0.1, 0.9)
    )
    parked = present < 0.4
    center = sides.points(side, middle + shift, np.full(len(side), -3.0))
    standing = np.column_stack([center, terrain.height(center)])
    parts = (standing, sides.yaw(side) + turn, length, height, reflectivity)
    return car_boxes(*(part[parked] for part in parts))


def _poles_and_trees(
    sides: Sides, terrain: Terrain, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    side, middle, width = sides.slots(pitch=9.0, margin=4.0)
    rows = len(side)
    present, shift, trunk, trunk_height, crown, reflectivity = draws(
        rng, rows, (0.0, 1.0), (-0.25, 0.25), (0.1, 0.25), (2.2, 3.2), (1.0, 1.7), (0.2, 0.6)
    )
    position = sides.points(side, middle + shift * width, np.full(rows, -1.3))
    ground = terrain.height(position) - 0.5
    poles = np.column_stack([position, ground, trunk / 2, np.full(rows, 7.0), reflectivity])
    trunks = np.column_stack([position, ground, trunk, trunk_height + 1.0, reflectivity])
    crowns = np.column_stack([position, ground + 0.5 + trunk_height + 0.8 * crown, crown, reflectivity])
    is_pole, is_tree = present < 0.3, present > 0.6
    return np.concatenate([poles[is_pole], trunks[is_tree]]), crowns[is_tree]


def _traffic(terrain: Terrain, rng: np.random.Generator) -> Traffic:
    loops = []
    for number, block in enumerate([*LAP_BLOCKS, *_SIDE_BLOCKS]):
        low, high = block_corners(block)
        reach = HALF_STREET - LANE
        cars = 2 if number < len(LAP_BLOCKS) else 1
        (left, bottom), (right, top) = low - reach, high + reach
        loops.append(Loop((left, bottom), (right, top), 4.5, float(rng.uniform(5, 9)), cars))
    count = sum(loop.bodies for loop in loops)
    length, height, reflectivity = draws(rng, count, (3.8, 4.8), (1.4, 1.8), (0.1, 0.9))
    boxes = car_boxes(np.zeros((count, 3)), np.zeros(count), length, height, reflectivity)
    # each car has a body and a cabin
    bodies = [boxes[[number, number + count]] for number in range(count)]
    return traffic(loops, terrain.height, bodies, rng)
