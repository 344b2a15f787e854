"""Worlds from rows of numbers, and rays cast into them."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from lio_jax.sim.primitives import Boxes, Cylinders, Grounds, Planes, Spheres, TiltedBoxes
from lio_jax.sim.raycast import Hit, cast
from lio_jax.sim.worlds import Counts, Movers, Solids, World, nearest_part

DTYPES = [(jnp.float64, 1e-9), (jnp.float32, 1e-4)]
"""Precision of the rays, and what distances are held to, m."""

HILLS = np.array([[1.5, 0.03, 0.01, 0.4], [0.6, -0.02, 0.05, 2.0], [0.15, 0.1, 0.08, 1.0]])
"""A ground: amplitude (m), wave vector (rad/m), phase (rad) of each wave."""


def world_of(dtype, planes=(), boxes=(), cylinders=(), spheres=(), tilted=(), ground=None, moving=()):
    """Return a world from rows.

    Plane (point 3, normal 3), box (centre 3, half 3, yaw), cylinder (base 3, radius, height), sphere
    (centre 3, radius), tilted (centre 3, half 3, Euler angles xyz 3), ground rows of waves (amplitude,
    wave 2, phase) about z = 0, moving (half 3, start 3, velocity 3): a straight path of 100 s.
    """

    def rows(values, width):
        return np.reshape(np.asarray(values, float), (-1, width))

    def array(values):
        return jnp.asarray(values, dtype)

    def reflectivity(values, value):
        return array(np.full(len(values), value))

    p, b, c, s = rows(planes, 6), rows(boxes, 7), rows(cylinders, 5), rows(spheres, 4)
    t, m = rows(tilted, 9), rows(moving, 9)
    turns = Rotation.from_euler("xyz", t[:, 6:]).as_matrix() if len(t) else np.zeros((0, 3, 3))
    waves = np.zeros((0, 1, 4)) if ground is None else np.asarray(ground, float)[None]
    path = m[:, None, 3:6] + 10.0 * np.arange(10)[None, :, None] * m[:, None, 6:]
    return World(
        Solids(
            Planes(array(p[:, :3]), array(p[:, 3:]), reflectivity(p, 0.1)),
            Grounds(
                array(np.zeros(len(waves))),
                array(waves[..., 0]),
                array(waves[..., 1:3]),
                array(waves[..., 3]),
                reflectivity(waves, 0.5),
            ),
            Boxes(array(b[:, :3]), array(b[:, 3:6]), array(b[:, 6]), reflectivity(b, 0.2)),
            TiltedBoxes(array(t[:, :3]), array(t[:, 3:6]), array(turns), reflectivity(t, 0.4)),
            Cylinders(array(c[:, :3]), array(c[:, 3]), array(c[:, 4]), reflectivity(c, 0.3)),
            Spheres(array(s[:, :3]), array(s[:, 3]), reflectivity(s, 0.6)),
        ),
        Movers(
            array(path if len(m) else np.zeros((1, 10, 3))),
            array(np.zeros((max(1, len(m)), 10))),
            array(np.full(max(1, len(m)), 100.0)),
            jnp.arange(len(m), dtype=jnp.int32),
            Boxes(
                array(np.zeros((len(m), 3))), array(m[:, :3]), array(np.zeros(len(m))), reflectivity(m, 0.7)
            ),
        ),
    )


def _everything(world):
    solids = world.solids
    return Counts(
        *(len(rows.reflectivity) for rows in (solids.boxes, solids.tilted, solids.cylinders, solids.spheres))
    )


def cast_into(world, origins, directions, times=0.0, position=(0, 0, 0), counts=None) -> Hit:
    """Cast rays in the world's precision, seen from ``position``; directions need not be unit vectors."""
    dtype = world.solids.planes.point.dtype
    directions = np.asarray(directions, float)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(np.asarray(origins, float), directions.shape)
    times = np.broadcast_to(times, len(directions))
    arrays = (jnp.asarray(values, dtype) for values in (position, origins, directions, times))
    return _shot(world, *arrays, counts or _everything(world))


@partial(jax.jit, static_argnames="counts")
def _shot(world, position, origins, directions, times, counts):
    part, _ = nearest_part(world, position, jnp.zeros((), position.dtype), counts)
    return cast(part, origins, directions, times)
