"""A random city quarter: houses along streets and side streets, poles, trees and parked cars."""

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.assembly import assembled
from lio_jax.sim.blocks import Sides, block_sides, lap
from lio_jax.sim.worlds import Route, Scene

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
