"""Analytic ray casting: the first surface that each ray meets.

A scan over primitives with a running minimum over rays: memory grows with the rays alone, and each step is
one fused, vectorised pass. Surfaces are seen from both sides, so a ray may start inside a box or cylinder.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lio_jax.sim.worlds import Boxes, Cylinders, Planes, World

_TINY = 1e-12
"""Stands in for a zero direction component: 1/_TINY stays finite in float32."""


class Hit(eqx.Module):
    """What each ray met first."""

    distance: Float[Array, " n"]
    """m along the unit direction; inf where nothing was met."""
    normal: Float[Array, "n 3"]
    """Unit surface normal that faces the ray's origin, world frame; zero where nothing was met."""
    reflectivity: Float[Array, " n"]
    """Of the surface; zero where nothing was met."""


class Rays(NamedTuple):
    """Origins and unit directions, one array per coordinate: the layout that vectorises."""

    x: Float[Array, " n"]
    y: Float[Array, " n"]
    z: Float[Array, " n"]
    dx: Float[Array, " n"]
    dy: Float[Array, " n"]
    dz: Float[Array, " n"]


def cast(world: World, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"]) -> Hit:
    """Return the first hit of each ray.

    Args:
        world: primitives, of the same dtype as the rays.
        origins: world frame, m.
        directions: unit vectors, world frame.

    Returns:
        Distance, surface normal and reflectivity per ray.
    """
    rays = Rays(*origins.T, *directions.T)
    kinds: list[tuple[Any, Callable[..., Array], Callable[..., Array]]] = [
        (world.planes, plane_distance, _plane_normal),
        (world.boxes, box_distance, _box_normal),
        (world.cylinders, cylinder_distance, _cylinder_normal),
    ]
    best = jnp.full(rays.x.shape, jnp.inf, rays.x.dtype)
    normal = jnp.zeros_like(directions)
    reflectivity = jnp.zeros_like(best)
    for primitives, distance_to, normal_at in kinds:
        if primitives.reflectivity.shape[0] == 0:
            continue
        distance, index = _nearest(primitives, rays, distance_to)
        met = jax.tree.map(lambda leaf, index=index: leaf[index], primitives)
        closer = distance < best
        point = origins + jnp.where(closer, distance, 0)[:, None] * directions
        normal = jnp.where(closer[:, None], normal_at(met, point), normal)
        reflectivity = jnp.where(closer, met.reflectivity, reflectivity)
        best = jnp.minimum(distance, best)
    away = jnp.sum(normal * directions, axis=1) > 0
    return Hit(best, jnp.where(away[:, None], -normal, normal), reflectivity)


def plane_distance(plane: Planes, rays: Rays) -> Float[Array, " n"]:
    """Return the distance along each ray to one plane (a row of Planes), inf on a miss."""
    point, normal = plane.point, plane.normal
    closing = rays.dx * normal[0] + rays.dy * normal[1] + rays.dz * normal[2]
    gap = (point[0] - rays.x) * normal[0] + (point[1] - rays.y) * normal[1] + (point[2] - rays.z) * normal[2]
    distance = gap / _away_from_zero(closing)
    return jnp.where((distance > 0) & (jnp.abs(closing) > _TINY), distance, jnp.inf)


def box_distance(box: Boxes, rays: Rays) -> Float[Array, " n"]:
    """Return the distance along each ray to one box (a row of Boxes), inf on a miss; slab method."""
    cos, sin = jnp.cos(box.yaw), jnp.sin(box.yaw)
    east, north = rays.x - box.center[0], rays.y - box.center[1]
    slabs = (
        _slab(cos * east + sin * north, cos * rays.dx + sin * rays.dy, box.half_size[0]),
        _slab(cos * north - sin * east, cos * rays.dy - sin * rays.dx, box.half_size[1]),
        _slab(rays.z - box.center[2], rays.dz, box.half_size[2]),
    )
    return _first_of_interval(*slabs)


def cylinder_distance(cylinder: Cylinders, rays: Rays) -> Float[Array, " n"]:
    """Return the distance along each ray to one solid cylinder (a row of Cylinders), inf on a miss.

    The discriminant comes from the ray's closest approach to the axis, a r^2 - cross^2: the textbook
    b^2 - ac loses thin poles to cancellation in float32.
    """
    east, north = rays.x - cylinder.base[0], rays.y - cylinder.base[1]
    level = rays.dx**2 + rays.dy**2
    a = jnp.maximum(level, _TINY)
    b = east * rays.dx + north * rays.dy
    cross = east * rays.dy - north * rays.dx
    discriminant = a * cylinder.radius**2 - cross**2
    root = jnp.sqrt(jnp.maximum(discriminant, 0))
    missed = jnp.where(level < _TINY, east**2 + north**2 > cylinder.radius**2, discriminant < 0)
    wall = (jnp.where(missed, jnp.inf, (-b - root) / a), jnp.where(missed, -jnp.inf, (-b + root) / a))
    half = cylinder.height / 2
    return _first_of_interval(wall, _slab(rays.z - cylinder.base[2] - half, rays.dz, half))


def _nearest(
    primitives: Any, rays: Rays, distance_to: Callable[..., Array]
) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    def closer_of(best: tuple[Array, Array], item: tuple[Array, Any]) -> tuple[tuple[Array, Array], None]:
        index, primitive = item
        distance = distance_to(primitive, rays)
        closer = distance < best[0]
        return (jnp.where(closer, distance, best[0]), jnp.where(closer, index, best[1])), None

    count = primitives.reflectivity.shape[0]
    start = (jnp.full(rays.x.shape, jnp.inf, rays.x.dtype), jnp.zeros(rays.x.shape, jnp.int32))
    items = (jnp.arange(count, dtype=jnp.int32), primitives)
    return jax.lax.scan(closer_of, start, items, unroll=min(8, count))[0]


def _away_from_zero(value: Float[Array, " n"]) -> Float[Array, " n"]:
    return jnp.where(jnp.abs(value) < _TINY, _TINY, value)


def _slab(
    offset: Float[Array, " n"], direction: Float[Array, " n"], half: Float[Array, ""]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    inverse = 1 / _away_from_zero(direction)
    middle, reach = -offset * inverse, half * jnp.abs(inverse)
    return middle - reach, middle + reach


def _first_of_interval(*intervals: tuple[Float[Array, " n"], Float[Array, " n"]]) -> Float[Array, " n"]:
    enter, leave = intervals[0]
    for start, end in intervals[1:]:
        enter, leave = jnp.maximum(enter, start), jnp.minimum(leave, end)
    distance = jnp.where(enter > 0, enter, leave)
    return jnp.where((enter <= leave) & (distance > 0), distance, jnp.inf)


def _plane_normal(planes: Planes, point: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    return planes.normal


def _box_normal(boxes: Boxes, point: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    cos, sin = jnp.cos(boxes.yaw), jnp.sin(boxes.yaw)
    east, north, up = (point - boxes.center).T
    local = jnp.stack([cos * east + sin * north, cos * north - sin * east, up], axis=1)
    face = jnp.argmin(boxes.half_size - jnp.abs(local), axis=1)
    x, y, z = (jnp.sign(local) * jax.nn.one_hot(face, 3, dtype=local.dtype)).T
    return jnp.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1)


def _cylinder_normal(cylinders: Cylinders, point: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
    offset = point - cylinders.base
    radial = offset.at[:, 2].set(0)
    length = jnp.linalg.norm(radial, axis=1)
    above = offset[:, 2] - cylinders.height / 2
    on_wall = jnp.abs(cylinders.radius - length) < cylinders.height / 2 - jnp.abs(above)
    cap = jnp.zeros_like(offset).at[:, 2].set(jnp.sign(above))
    return jnp.where(on_wall[:, None], radial / jnp.maximum(length, _TINY)[:, None], cap)
