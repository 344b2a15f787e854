"""Solids grown by what float32 may misplace them: whatever a ray meets, it meets grown in float32, too."""

from typing import TypeVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.sim.movers import MovingBoxes
from lio_jax.sim.primitives import Boxes, Cylinders, Grounds, Planes, Spheres, TiltedBoxes

_SHARE = 2.0**-19
"""Of a coordinate's size: sixteen times what float32 rounds it by, for the sums and products of a few."""

_Box = TypeVar("_Box", Boxes, TiltedBoxes)
_Endless = TypeVar("_Endless", Planes, Grounds)


def endless_grown(surfaces: _Endless, reach: Float[Array, ""]) -> _Endless:
    """Return planes and grounds as they are: they have no outline to miss."""
    return surfaces


def box_grown(boxes: _Box, reach: Float[Array, ""]) -> _Box:
    """Return the boxes grown on all sides; rays start within ``reach`` m of the origin."""
    size = jnp.linalg.norm(boxes.half_size, axis=1)
    by = _margin(boxes.center, size, reach)
    return eqx.tree_at(lambda rows: rows.half_size, boxes, boxes.half_size + by[:, None])


def moving_grown(moving: MovingBoxes, reach: Float[Array, ""]) -> MovingBoxes:
    """Return the moving boxes grown on all sides; rays start within ``reach`` m of the origin."""
    return MovingBoxes(box_grown(moving.boxes, reach), moving.velocity)


def cylinder_grown(cylinders: Cylinders, reach: Float[Array, ""]) -> Cylinders:
    """Return the cylinders grown on all sides; rays start within ``reach`` m of the origin."""
    by = _margin(cylinders.base, cylinders.radius + cylinders.height, reach)
    base = cylinders.base.at[:, 2].add(-by)
    return Cylinders(base, cylinders.radius + by, cylinders.height + 2 * by, cylinders.reflectivity)


def sphere_grown(spheres: Spheres, reach: Float[Array, ""]) -> Spheres:
    """Return the balls grown; rays start within ``reach`` m of the origin."""
    by = _margin(spheres.center, spheres.radius, reach)
    return Spheres(spheres.center, spheres.radius + by, spheres.reflectivity)


def _margin(
    place: Float[Array, "n 3"], size: Float[Array, " n"], reach: Float[Array, ""]
) -> Float[Array, " n"]:
    return _SHARE * (jnp.linalg.norm(place, axis=1) + size + reach)
