"""A procedurally built quarter: houses along streets and side streets, poles, trees and parked cars."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.trajectory import Drive, rounded_lap
from lio_jax.sim.worlds import Boxes, Cylinders, Planes, World

_PITCH = np.array([80.0, 60.0])
"""Distance between street axes along x and y, m."""
_HALF_STREET = 7.0
"""From a street's axis to the building line, m."""
_BLOCKS = [(i, j) for i in range(-1, 3) for j in range(-1, 3)]
_LANE = 1.5
"""From a street's axis to the axis of the driven (right) lane, m."""
_CORNERS = np.array([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]])
"""Crossings where the drive turns: five left turns and one right turn a lap."""
_START = np.array([2 * _PITCH[0] - 27.0, -_LANE])
_BODY_HEIGHT = 1.5
"""Of the body frame above the ground at rest, m."""


@dataclass(frozen=True)
class _Sides:
    """Block sides seen from the street: start, direction along the side, direction into the block."""

    start: NDArray[np.float64]
    along: NDArray[np.float64]
    inward: NDArray[np.float64]
    length: NDArray[np.float64]

    def points(
        self, side: NDArray[np.int64], along: NDArray[np.float64], inward: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return self.start[side] + along[:, None] * self.along[side] + inward[:, None] * self.inward[side]

    def yaw(self, side: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.arctan2(self.along[side, 1], self.along[side, 0])


def street(seed: int) -> tuple[World, Drive]:
    """Return the quarter and a drive through it whose first body pose is the world's origin.

    Args:
        seed: of the quarter; the drive is the same for all.

    Returns:
        World (float32) and drive (float64 where JAX's x64 mode is on).
    """
    origin = np.append(_START, _BODY_HEIGHT)
    sides = _block_sides()
    keys = jax.random.split(jax.random.key(seed), 3)
    boxes = np.concatenate([_houses(sides, keys[0]), _cars(sides, keys[1])])
    cylinders = _poles_and_trees(sides, keys[2])
    boxes[:, :3] -= origin
    cylinders[:, :3] -= origin
    world = World(
        Planes(
            jnp.asarray([-origin], jnp.float32),
            jnp.array([[0.0, 0.0, 1.0]], jnp.float32),
            jnp.array([0.2], jnp.float32),
        ),
        Boxes(*(jnp.asarray(part, jnp.float32) for part in _columns(boxes, 3, 3, 1, 1))),
        Cylinders(*(jnp.asarray(part, jnp.float32) for part in _columns(cylinders, 3, 1, 1, 1))),
    )
    return world, _drive()


def _drive() -> Drive:
    corners = _CORNERS * _PITCH
    arrive = np.sign(corners - np.roll(corners, 1, axis=0))
    leave = np.sign(np.roll(corners, -1, axis=0) - corners)
    right = np.stack([(arrive + leave)[:, 1], -(arrive + leave)[:, 0]], axis=1)
    control = rounded_lap(corners + _LANE * right, 9.0, _START, spacing=2.8, corner_spacing=1.8)
    return Drive(
        control=jnp.asarray(control - _START),
        knot_rate=jnp.asarray(2.2),
        standstill=jnp.asarray(1.5),
        pull_away=jnp.asarray(5.0),
        sway=jnp.array([[0.015, 1.4], [0.008, 0.9], [0.006, 1.1]]),
    )


def _block_sides() -> _Sides:
    starts, alongs = [], []
    for block in _BLOCKS:
        low = np.array(block) * _PITCH + _HALF_STREET
        high = (np.array(block) + 1) * _PITCH - _HALF_STREET
        ring = np.array([low, [high[0], low[1]], high, [low[0], high[1]]])
        starts.append(ring)
        alongs.append(np.roll(ring, -1, axis=0) - ring)
    start, along = np.concatenate(starts), np.concatenate(alongs)
    length = np.linalg.norm(along, axis=1)
    along = along / length[:, None]
    return _Sides(start, along, np.stack([-along[:, 1], along[:, 0]], axis=1), length)


def _slots(
    sides: _Sides, pitch: float, margin: float
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Cut every side, less a margin at both ends, into equal slots: index of side, middle, width."""
    counts = np.maximum(1, np.round((sides.length - 2 * margin) / pitch)).astype(int)
    width = (sides.length - 2 * margin) / counts
    side = np.repeat(np.arange(len(counts)), counts)
    number = np.concatenate([np.arange(count) for count in counts])
    return side, margin + (number + 0.5) * width[side], width[side]


def _draws(key: jax.Array, rows: int, *ranges: tuple[float, float]) -> NDArray[np.float64]:
    unit = np.asarray(jax.random.uniform(key, (rows, len(ranges)), jnp.float32), np.float64)
    low, high = np.array(ranges).T
    return (low + unit * (high - low)).T


def _houses(sides: _Sides, key: jax.Array) -> NDArray[np.float64]:
    side, middle, width = _slots(sides, pitch=12.0, margin=0.0)
    setback, gap, depth, height, reflectivity = _draws(
        key, len(side), (0.0, 2.5), (0.0, 2.5), (7.0, 11.0), (6.0, 20.0), (0.2, 0.7)
    )
    center = sides.points(side, middle, setback + depth / 2)
    half = np.stack([(width - gap) / 2, depth / 2, height / 2], axis=1)
    return np.column_stack([center, height / 2, half, sides.yaw(side), reflectivity])


def _cars(sides: _Sides, key: jax.Array) -> NDArray[np.float64]:
    side, middle, _ = _slots(sides, pitch=6.5, margin=8.0)
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


def _poles_and_trees(sides: _Sides, key: jax.Array) -> NDArray[np.float64]:
    side, middle, width = _slots(sides, pitch=9.0, margin=4.0)
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


def _columns(rows: NDArray[np.float64], *widths: int) -> list[NDArray[np.float64]]:
    parts = np.split(rows, np.cumsum(widths)[:-1], axis=1)
    return [part[:, 0] if width == 1 else part for part, width in zip(parts, widths, strict=True)]
