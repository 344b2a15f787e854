"""Assemble a World of float64 arrays from the rows that builders write."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import ArrayLike, NDArray

from lio_jax.sim.primitives import Boxes, Cylinders, Grounds, Panes, Planes, Spheres, TiltedBoxes
from lio_jax.sim.worlds import Movers, Solids, World

Rows = NDArray[np.float64] | Sequence[Sequence[float | int]]
"""A table with one solid in each row."""


@dataclass(frozen=True)
class Terrain:
    """A sloping ground: z = sum of amplitude sin(wave . (x, y) + phase)."""

    amplitude: NDArray[np.float64]
    """Amplitude of each wave, (w,) m."""
    wave: NDArray[np.float64]
    """Wave vectors, (w, 2) rad/m."""
    phase: NDArray[np.float64]
    """Phase of each wave at the builder's origin, (w,) rad."""
    reflectivity: float
    """Share of the light that comes back at normal incidence, 0 to 1."""

    def height(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the height (m) at (..., 2) positions (m)."""
        return np.sum(self.amplitude * np.sin(points @ self.wave.T + self.phase), axis=-1)

    def slope(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the gradient (..., 2) of the height at (..., 2) positions (m)."""
        return (self.amplitude * np.cos(points @ self.wave.T + self.phase)) @ self.wave


@dataclass(frozen=True)
class Traffic:
    """Bodies on closed paths and the boxes they are made of; see Movers."""

    path: NDArray[np.float64]
    """Positions of each body at equal steps of its period, (m, k, 3) m, builder's frame."""
    yaw: NDArray[np.float64]
    """Heading of each body at those positions, (m, k) rad."""
    period: NDArray[np.float64]
    """Duration of a lap of each body, (m,) s."""
    body: NDArray[np.int64]
    """Index of the body to which each box belongs, (n,)."""
    boxes: NDArray[np.float64]
    """Box rows in their body's frame, (n, 8): centre 3, half size 3 (m), yaw (rad), reflectivity."""


def assembled(
    origin: ArrayLike,
    *,
    planes: Rows = (),
    terrain: Terrain | None = None,
    boxes: Rows = (),
    tilted: Rows = (),
    cylinders: Rows = (),
    spheres: Rows = (),
    traffic: Traffic | None = None,
    glass: Rows = (),
) -> World:
    """Return the world whose origin is at ``origin`` of the builder's frame.

    Args:
        origin: the world's origin in the builder's frame, (3,) m.
        planes: rows of point 3, normal 3, reflectivity.
        terrain: the ground, if it is not a plane or boxes.
        boxes: rows of centre 3, half size 3, yaw, reflectivity.
        tilted: rows of centre 3, half size 3, rotation matrix row by row 9, reflectivity.
        cylinders: rows of base centre 3, radius, height, reflectivity.
        spheres: rows of centre 3, radius, reflectivity.
        traffic: the bodies that move; None: nothing moves.
        glass: rows of centre 3, half of one edge 3, half of the other edge 3, mirrored share, missing share.

    Returns:
        The world in float64 arrays, in every mode of JAX; angles in rad, lengths in m.
    """
    origin = np.asarray(origin, float)
    point, *plane = _columns(planes, 3, 3, 1)
    center, *box = _columns(boxes, 3, 3, 1, 1)
    middle, half_size, rotation, reflectivity = _columns(tilted, 3, 3, 9, 1)
    base, *cylinder = _columns(cylinders, 3, 1, 1, 1)
    heart, *sphere = _columns(spheres, 3, 1, 1)
    solids = Solids(
        Planes(*_double([point - origin, *plane])),
        _ground(terrain, origin),
        Boxes(*_double([center - origin, *box])),
        TiltedBoxes(*_double([middle - origin, half_size, rotation.reshape(-1, 3, 3), reflectivity])),
        Cylinders(*_double([base - origin, *cylinder])),
        Spheres(*_double([heart - origin, *sphere])),
    )
    middle, *pane = _columns(glass, 3, 3, 3, 1, 1)
    panes = Panes(*_double([middle - origin, *pane])) if len(middle) else None
    return World(solids, _movers(traffic, origin), panes)


def upright(
    low: ArrayLike, high: ArrayLike, reflectivity: ArrayLike, yaw: ArrayLike = 0.0
) -> NDArray[np.float64]:
    """Return box rows from opposite corners (..., 3) m; ``yaw`` (rad) turns each about its own centre."""
    low, high = np.broadcast_arrays(np.atleast_2d(np.asarray(low, float)), np.atleast_2d(high))
    rows = len(low)
    return np.column_stack(
        [(low + high) / 2, (high - low) / 2, np.broadcast_to(yaw, rows), np.broadcast_to(reflectivity, rows)]
    )


def draws(rng: np.random.Generator, rows: int, *ranges: tuple[float, float]) -> list[NDArray[np.float64]]:
    """Return one (rows,) array of uniform draws for each range."""
    return [rng.uniform(low, high, rows) for low, high in ranges]


def _columns(rows: Rows, *widths: int) -> list[NDArray[np.float64]]:
    table = np.reshape(np.asarray(rows, float), (-1, sum(widths)))
    parts = np.split(table, np.cumsum(widths)[:-1], axis=1)
    return [part[:, 0] if width == 1 else part for part, width in zip(parts, widths, strict=True)]


def _double(parts: Sequence[NDArray[np.float64]]) -> list[Array]:
    with jax.enable_x64(True):
        return [jnp.asarray(part, jnp.float64) for part in parts]


def _ground(terrain: Terrain | None, origin: NDArray[np.float64]) -> Grounds:
    if terrain is None:
        return Grounds(*_double([np.zeros(shape) for shape in ((0,), (0, 1), (0, 1, 2), (0, 1), (0,))]))
    phase = np.mod(terrain.phase + terrain.wave @ origin[:2], 2 * np.pi)
    parts = (-origin[2], terrain.amplitude, terrain.wave, phase, terrain.reflectivity)
    return Grounds(*_double([np.asarray(part)[None] for part in parts]))


def _movers(traffic: Traffic | None, origin: NDArray[np.float64]) -> Movers:
    if traffic is None:
        traffic = Traffic(
            np.zeros((1, 1, 3)), np.zeros((1, 1)), np.ones(1), np.zeros(0, np.int64), np.zeros((0, 8))
        )
    path, yaw, period = _double([traffic.path - origin, traffic.yaw, traffic.period])
    boxes = Boxes(*_double(_columns(traffic.boxes, 3, 3, 1, 1)))
    return Movers(path, yaw, period, jnp.asarray(traffic.body, jnp.int32), boxes)
