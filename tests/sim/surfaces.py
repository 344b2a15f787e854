"""How far points are from a world's surfaces: brute force in float64, in numpy, one shape after another."""

from collections.abc import Iterator

import jax
import numpy as np
from numpy.typing import NDArray

from lio_jax.sim.worlds import World

Points = NDArray[np.float64]


def surface_distance(
    world: World, points: Points, moving: tuple[Points, Points, Points] | None = None
) -> NDArray[np.float64]:
    """Return the distance (n,) m of points (n, 3) in the world frame to the nearest surface.

    Args:
        world: its movers are left out.
        points: m.
        moving: centre (k, n, 3) when each point was measured, half size (k, 3) and yaw (k,) of moving boxes;
            None: there are none.
    """
    nearest = np.full(len(points), np.inf)
    for signed in _signed(world, points):
        nearest = np.minimum(nearest, np.abs(signed))
    if moving is not None:
        for center, half, yaw in zip(*moving, strict=True):
            nearest = np.minimum(nearest, np.abs(_box(_turned(points - center, yaw), half)))
    return nearest


def clearance(world: World, points: Points) -> NDArray[np.float64]:
    """Return the distance (n,) m to the nearest solid at rest, negative inside one."""
    return np.min(list(_signed(world, points)), axis=0)


def _signed(world: World, points: Points) -> Iterator[NDArray[np.float64]]:
    solids = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), world.solids)
    for point, normal in zip(solids.planes.point, solids.planes.normal, strict=True):
        yield (points - point) @ normal
    grounds = solids.grounds
    for height, amplitude, wave, phase in zip(
        grounds.height, grounds.amplitude, grounds.wave, grounds.phase, strict=True
    ):
        angle = points[:, :2] @ wave.T + phase
        slope = (amplitude * np.cos(angle)) @ wave
        above = points[:, 2] - height - np.sin(angle) @ amplitude
        yield above / np.sqrt(1 + np.sum(slope**2, axis=1))
    boxes = solids.boxes
    for center, half, yaw in zip(boxes.center, boxes.half_size, boxes.yaw, strict=True):
        yield _box(_turned(points - center, yaw), half)
    tilted = solids.tilted
    for center, half, rotation in zip(tilted.center, tilted.half_size, tilted.rotation, strict=True):
        yield _box((points - center) @ rotation, half)
    cylinders = solids.cylinders
    for base, radius, height in zip(cylinders.base, cylinders.radius, cylinders.height, strict=True):
        x, y, z = (points - base).T
        gap = np.stack([np.hypot(x, y) - radius, np.abs(z - height / 2) - height / 2], axis=1)
        yield _outside(gap)
    for center, radius in zip(solids.spheres.center, solids.spheres.radius, strict=True):
        yield np.linalg.norm(points - center, axis=1) - radius


def _turned(offset: Points, yaw: float) -> Points:
    x, y, z = offset.T
    return np.stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x, z], axis=1)


def _box(local: Points, half: NDArray[np.float64]) -> NDArray[np.float64]:
    return _outside(np.abs(local) - half)


def _outside(gap: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.linalg.norm(np.maximum(gap, 0), axis=1) + np.minimum(gap.max(axis=1), 0)
