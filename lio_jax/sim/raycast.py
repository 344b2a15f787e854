"""Analytic ray casting: the first surface that each ray meets.

A scan over primitives with a running minimum over rays: memory grows with the rays alone, and each step is
one fused, vectorised pass. Surfaces are seen from both sides, so a ray may start inside a solid.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lio_jax.sim.intersect import (
    Rays,
    box_distance,
    cylinder_distance,
    ground_distance,
    moving_distance,
    plane_distance,
    sphere_distance,
    tilted_distance,
)
from lio_jax.sim.normals import (
    box_normal,
    cylinder_normal,
    ground_normal,
    moving_normal,
    plane_normal,
    sphere_normal,
    tilted_normal,
)
from lio_jax.sim.worlds import Part


class Hit(eqx.Module):
    """What each ray met first."""

    distance: Float[Array, " n"]
    """m along the unit direction; inf where nothing was met."""
    normal: Float[Array, "n 3"]
    """Unit surface normal that faces the ray's origin; zero where nothing was met."""
    reflectivity: Float[Array, " n"]
    """Of the surface; zero where nothing was met."""


def cast(
    part: Part, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Hit:
    """Return the first hit of each ray.

    Args:
        part: of a world, of the same dtype as the rays.
        origins: in the part's frame, m.
        directions: unit vectors in the part's frame.
        time: when each ray is sent, s since the part's instant.

    Returns:
        Distance, surface normal and reflectivity per ray.
    """
    x, y, z = origins.T
    dx, dy, dz = directions.T
    rays = Rays(x, y, z, dx, dy, dz, time)
    solids = part.solids
    kinds: list[tuple[Any, Callable[..., Array], Callable[..., Array]]] = [
        (solids.planes, plane_distance, plane_normal),
        (solids.grounds, ground_distance, ground_normal),
        (solids.boxes, box_distance, box_normal),
        (solids.tilted, tilted_distance, tilted_normal),
        (solids.cylinders, cylinder_distance, cylinder_normal),
        (solids.spheres, sphere_distance, sphere_normal),
        (part.moving, moving_distance, moving_normal),
    ]
    best = jnp.full(rays.x.shape, jnp.inf, rays.x.dtype)
    normal = jnp.zeros_like(directions)
    reflectivity = jnp.zeros_like(best)
    for primitives, distance_to, normal_at in kinds:
        if primitives.reflectivity.shape[0] == 0:
            continue
        distance, index = _nearest(primitives, rays, distance_to)
        closer = distance < best
        best = jnp.minimum(distance, best)

        def seen(
            normal: Array,
            reflectivity: Array,
            primitives: Any = primitives,
            normal_at: Callable[..., Array] = normal_at,
            closer: Array = closer,
            index: Array = index,
            best: Array = best,
        ) -> tuple[Array, Array]:
            met = jax.tree.map(lambda leaf: leaf[index], primitives)
            point = origins + jnp.where(closer, best, 0)[:, None] * directions
            own = normal_at(met, point, time)
            return jnp.where(closer[:, None], own, normal), jnp.where(closer, met.reflectivity, reflectivity)

        # the branch also keeps XLA from fusing all kinds into one pass, which computes each many times over
        normal, reflectivity = jax.lax.cond(
            jnp.any(closer), seen, lambda *unchanged: unchanged, normal, reflectivity
        )
    away = jnp.sum(normal * directions, axis=1) > 0
    return Hit(best, jnp.where(away[:, None], -normal, normal), reflectivity)


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
    return jax.lax.scan(closer_of, start, items, unroll=min(2, count))[0]
