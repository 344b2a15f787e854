"""Worlds as sets of analytic primitives: one pytree of arrays per kind."""

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int


class Planes(eqx.Module):
    """Infinite planes."""

    point: Float[Array, "n 3"]
    """Any point of the plane, world frame, m."""
    normal: Float[Array, "n 3"]
    """Unit normal, world frame."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""


class Boxes(eqx.Module):
    """Upright boxes, turned about the vertical."""

    center: Float[Array, "n 3"]
    """World frame, m."""
    half_size: Float[Array, "n 3"]
    """Half the edge lengths along the box's own axes, m."""
    yaw: Float[Array, " n"]
    """Rotation world from box about +z, rad."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""


class Cylinders(eqx.Module):
    """Upright solid cylinders."""

    base: Float[Array, "n 3"]
    """Centre of the lower cap, world frame, m."""
    radius: Float[Array, " n"]
    """m."""
    height: Float[Array, " n"]
    """m."""
    reflectivity: Float[Array, " n"]
    """Share of the light that comes back at normal incidence, 0 to 1."""


class World(eqx.Module):
    """Everything a ray can hit."""

    planes: Planes
    boxes: Boxes
    cylinders: Cylinders


_Rows = TypeVar("_Rows", Boxes, Cylinders)


def nearest_part(
    world: World, position: Float[Array, "3"], box_count: int, cylinder_count: int
) -> tuple[World, Float[Array, ""]]:
    """Return the planes, the nearest boxes and cylinders, moved so that ``position`` is the origin.

    Casting near the origin keeps float32 ranges exact; leaving far primitives out makes casting cheap.

    Args:
        world: everything.
        position: world frame, m.
        box_count: number of boxes kept.
        cylinder_count: number of cylinders kept.

    Returns:
        The part, and the radius (m) around ``position`` within which nothing was left out.
    """
    boxes, box_reach = _nearest_rows(world.boxes, _box_gap(world.boxes, position), box_count)
    cylinders, cylinder_reach = _nearest_rows(
        world.cylinders, _cylinder_gap(world.cylinders, position), cylinder_count
    )
    part = World(
        eqx.tree_at(lambda planes: planes.point, world.planes, world.planes.point - position),
        eqx.tree_at(lambda rows: rows.center, boxes, boxes.center - position),
        eqx.tree_at(lambda rows: rows.base, cylinders, cylinders.base - position),
    )
    return part, jnp.minimum(box_reach, cylinder_reach)


def counts_within(
    world: World, position: Float[Array, "3"], radius: float | Float[Array, ""]
) -> Int[Array, "2"]:
    """Count the boxes and cylinders that reach into the horizontal circle of ``radius`` m at ``position``."""
    boxes = jnp.sum(_box_gap(world.boxes, position) < radius)
    cylinders = jnp.sum(_cylinder_gap(world.cylinders, position) < radius)
    return jnp.stack([boxes, cylinders])


def _box_gap(boxes: Boxes, position: Float[Array, "3"]) -> Float[Array, " n"]:
    offset = jnp.linalg.norm(boxes.center[:, :2] - position[:2], axis=1)
    return offset - jnp.linalg.norm(boxes.half_size[:, :2], axis=1)


def _cylinder_gap(cylinders: Cylinders, position: Float[Array, "3"]) -> Float[Array, " n"]:
    return jnp.linalg.norm(cylinders.base[:, :2] - position[:2], axis=1) - cylinders.radius


def _nearest_rows(rows: _Rows, gap: Float[Array, " n"], count: int) -> tuple[_Rows, Float[Array, ""]]:
    order = jnp.argsort(gap)
    reach = gap[order[count]] if count < gap.shape[0] else jnp.array(jnp.inf, gap.dtype)
    return jax.tree.map(lambda leaf: leaf[order[:count]], rows), reach
