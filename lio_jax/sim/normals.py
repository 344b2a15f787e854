"""Unit normals of primitives, one primitive and one point on its surface per row, m.

``time`` (s) is when each point was met; only what moves needs it.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.sim.intersect import TINY
from lio_jax.sim.movers import MovingBoxes
from lio_jax.sim.primitives import Boxes, Cylinders, Grounds, Planes, Spheres, TiltedBoxes


def plane_normal(planes: Planes, point: Float[Array, "n 3"], time: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """Return the planes' own normals."""
    return planes.normal


def ground_normal(
    grounds: Grounds, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the upward normals."""
    angle = grounds.wave[..., 0] * point[:, :1] + grounds.wave[..., 1] * point[:, 1:2] + grounds.phase
    slope = jnp.sum((grounds.amplitude * jnp.cos(angle))[..., None] * grounds.wave, axis=1)
    upward = jnp.concatenate([-slope, jnp.ones_like(slope[:, :1])], axis=1)
    return upward / jnp.linalg.norm(upward, axis=1, keepdims=True)


def box_normal(boxes: Boxes, point: Float[Array, "n 3"], time: Float[Array, " n"]) -> Float[Array, "n 3"]:
    """Return the outward normals of the faces nearest to the points."""
    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    east, north, up = (point - boxes.center).T
    local = jnp.stack([cos * east + sin * north, cos * north - sin * east, up], axis=1)
    x, y, z = _face_normal(local, boxes.half_size).T
    return jnp.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)


def tilted_normal(
    boxes: TiltedBoxes, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the outward normals of the faces nearest to the points."""
    offset = point - boxes.center
    local = jnp.sum(boxes.rotation * offset[:, :, None], axis=1)
    return jnp.sum(boxes.rotation * _face_normal(local, boxes.half_size)[:, None, :], axis=2)


def moving_normal(
    moving: MovingBoxes, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the outward normals of the faces nearest to the points when they were met."""
    return box_normal(moving.boxes, point - moving.velocity * time[:, None], time)


def cylinder_normal(
    cylinders: Cylinders, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the outward normals of wall or cap, whichever is nearer."""
    offset = point - cylinders.base
    radial = offset.at[:, 2].set(0)
    length = jnp.linalg.norm(radial, axis=1)
    above = offset[:, 2] - cylinders.height / 2
    on_wall = jnp.abs(cylinders.radius - length) < cylinders.height / 2 - jnp.abs(above)
    cap = jnp.zeros_like(offset).at[:, 2].set(jnp.sign(above))
    return jnp.where(on_wall[:, None], radial / jnp.maximum(length, TINY)[:, None], cap)


def sphere_normal(
    spheres: Spheres, point: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Float[Array, "n 3"]:
    """Return the outward normals."""
    outward = point - spheres.center
    return outward / jnp.maximum(jnp.linalg.norm(outward, axis=1, keepdims=True), TINY)


def _face_normal(local: Float[Array, "n 3"], half_size: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    face = jnp.argmin(half_size - jnp.abs(local), axis=1)
    return jnp.sign(local) * jax.nn.one_hot(face, 3, dtype=local.dtype)
