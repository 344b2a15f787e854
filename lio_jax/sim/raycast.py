"""Analytic ray casting: the first surface that each ray meets.

Surfaces are seen from both sides, so a ray may start inside a solid. Memory grows with the rays alone.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.sim.first_met import Kind, first_met
from lio_jax.sim.growth import box_grown, cylinder_grown, endless_grown, moving_grown, sphere_grown
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

    Distances are as exact as the rays' precision allows, however flat a surface is met or closely missed.

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
    kinds = _kinds(part)
    if not kinds:
        nothing = jnp.zeros_like(rays.x)
        return Hit(nothing + jnp.inf, jnp.zeros_like(directions), nothing)
    distance, number = first_met(kinds, rays)
    first, best = jnp.argmin(distance, axis=0), jnp.min(distance, axis=0)
    normal, reflectivity = jnp.zeros_like(directions), jnp.zeros_like(best)
    for place, kind in enumerate(kinds):
        seen = (first == place) & jnp.isfinite(best)

        def surface(
            normal: Array,
            reflectivity: Array,
            kind: Kind = kind,
            which: Array = number[place],
            seen: Array = seen,
        ) -> tuple[Array, Array]:
            met = jax.tree.map(lambda leaf: leaf[which], kind.rows)
            point = origins + jnp.where(seen, best, 0)[:, None] * directions
            own = kind.normal(met, point, time)
            return jnp.where(seen[:, None], own, normal), jnp.where(seen, met.reflectivity, reflectivity)

        # the branch also keeps XLA from fusing all kinds into one pass, which computes each many times over
        normal, reflectivity = jax.lax.cond(
            jnp.any(seen), surface, lambda *unchanged: unchanged, normal, reflectivity
        )
    away = jnp.sum(normal * directions, axis=1) > 0
    return Hit(best, jnp.where(away[:, None], -normal, normal), reflectivity)


def _kinds(part: Part) -> list[Kind]:
    solids = part.solids
    kinds = [
        Kind(solids.planes, plane_distance, plane_normal, endless_grown),
        Kind(solids.grounds, ground_distance, ground_normal, endless_grown),
        Kind(solids.boxes, box_distance, box_normal, box_grown),
        Kind(solids.tilted, tilted_distance, tilted_normal, box_grown),
        Kind(solids.cylinders, cylinder_distance, cylinder_normal, cylinder_grown),
        Kind(solids.spheres, sphere_distance, sphere_normal, sphere_grown),
        Kind(part.moving, moving_distance, moving_normal, moving_grown),
    ]
    return [kind for kind in kinds if kind.size]
