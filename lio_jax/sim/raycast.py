"""Cast rays into a world: search in float32 among slightly grown solids, then measure in full precision."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lio_jax.sim.intersect import (
    Rays,
    box_distance,
    box_normal,
    cylinder_distance,
    cylinder_normal,
    ground_distance,
    ground_normal,
    moving_distance,
    moving_normal,
    plane_distance,
    plane_normal,
    sphere_distance,
    sphere_normal,
    tilted_distance,
    tilted_normal,
)
from lio_jax.sim.primitives import Boxes, Cylinders, Grounds, Planes, Spheres, TiltedBoxes
from lio_jax.sim.worlds import MovingBoxes, Part


class Hit(eqx.Module):
    """What each ray meets first."""

    distance: Float[Array, " n"]
    """Distance along the unit direction, m; inf where the ray meets nothing."""
    normal: Float[Array, "n 3"]
    """Unit normal of the surface, on the side of the ray's origin; zero where the ray meets nothing."""
    reflectivity: Float[Array, " n"]
    """Reflectivity of the surface, 0 to 1; zero where the ray meets nothing."""


def cast(
    part: Part, origins: Float[Array, "n 3"], directions: Float[Array, "n 3"], time: Float[Array, " n"]
) -> Hit:
    """Return the first hit of each ray.

    Distances are as exact as the rays' precision allows, even where a ray grazes or barely misses a surface.

    Args:
        part: part of a world, of the same dtype as the rays.
        origins: (n, 3) m, in the part's frame.
        directions: (n, 3) unit vectors in the part's frame.
        time: (n,) s, when each ray is sent, counted from the part's instant.

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

        # the branch also keeps XLA from fusing all kinds into one pass, which computes each kind many times
        normal, reflectivity = jax.lax.cond(
            jnp.any(seen), surface, lambda *unchanged: unchanged, normal, reflectivity
        )
    away = jnp.sum(normal * directions, axis=1) > 0
    return Hit(best, jnp.where(away[:, None], -normal, normal), reflectivity)


_SHARE = 2.0**-19
"""Margin as a share of a coordinate's size: 16 float32 rounding errors, enough for a few operations."""

_Box = TypeVar("_Box", Boxes, TiltedBoxes)
_Endless = TypeVar("_Endless", Planes, Grounds)


def endless_grown(surfaces: _Endless, reach: Float[Array, ""]) -> _Endless:
    """Return planes and grounds as they are: they have no edge that a rounded ray could miss."""
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


_TOGETHER = 8
"""Number of solids whose distances are held in memory at once."""
_SMALL = 2**16
"""Up to this number of pairs of a solid and a ray, all distances are computed in full precision."""
_AGAIN = 256
"""Number of rays in one round of the second search."""

_Tree = TypeVar("_Tree")


class Kind(NamedTuple):
    """All solids of one kind, and the functions that work on them."""

    rows: Any
    """The solids, one in each row of a pytree of arrays."""
    distance: Callable[..., Array]
    """Function of one solid and rays that returns distances, for example ``intersect.box_distance``."""
    normal: Callable[..., Array]
    """Function of solids, points and times that returns normals, for example ``intersect.box_normal``."""
    grown: Callable[..., Any]
    """Function of all solids and the rays' largest distance from the origin, for example ``box_grown``."""

    @property
    def size(self) -> int:
        """Number of solids."""
        return int(self.rows.reflectivity.shape[0])


class _Nearest(NamedTuple):
    distance: Float[Array, " n"]
    """Distance to the solid that the ray meets first, m; inf where it meets none."""
    number: Int[Array, " n"]
    """Row of the solid that the ray meets first."""
    following: Float[Array, " n"]
    """Distance at which the ray may meet another solid, m; float32."""


def first_met(kinds: list[Kind], rays: Rays) -> tuple[Float[Array, "kinds n"], Int[Array, "kinds n"]]:
    """Return, for each kind, the distance at which each ray first meets a solid, and that solid's row.

    The distance is in m, and inf where the ray meets none.

    Where rays and solids are many, the search runs in float32 among solids that are grown by its rounding
    error. It yields one candidate of each kind, and the distance at which the ray may meet another solid of
    that kind. The candidate's distance is then computed in full precision. The few rays that may meet another
    solid before any candidate are searched a second time.
    """
    found = [_candidate(kind, rays) for kind in kinds]
    distance, number, following = (jnp.stack(part) for part in zip(*found, strict=True))
    if all(_is_small(kind, rays) for kind in kinds):
        return distance, number
    # the barrier keeps XLA from computing the distance again for each of its uses
    distance = jax.lax.optimization_barrier(distance)
    unsure = jnp.any(following < jnp.min(distance, axis=0), axis=0)

    def search_again(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        unsure, distance, number = state
        # where fewer rays than a round takes are left, the round is filled with the first ray
        rows = jnp.nonzero(unsure, size=_AGAIN, fill_value=0)[0]
        few = jax.tree.map(lambda leaf: leaf[rows], rays)
        found = [
            (distance[place, rows], number[place, rows])
            if _is_small(kind, rays)
            else _nearest_of_all(kind, few)
            for place, kind in enumerate(kinds)
        ]
        surely, which = (jnp.stack(part) for part in zip(*found, strict=True))
        return unsure.at[rows].set(False), distance.at[:, rows].set(surely), number.at[:, rows].set(which)

    start = (unsure, distance, number)
    return jax.lax.while_loop(lambda state: jnp.any(state[0]), search_again, start)[1:]


def _is_small(kind: Kind, rays: Rays) -> bool:
    return kind.size == 1 or kind.size * rays.x.size <= _SMALL


def _candidate(kind: Kind, rays: Rays) -> _Nearest:
    if _is_small(kind, rays):
        return _Nearest(*_nearest_of_all(kind, rays), jnp.full(rays.x.shape, jnp.inf, jnp.float32))
    reach = jnp.max(jnp.abs(jnp.stack([rays.x, rays.y, rays.z])))
    grown = _single(kind.grown(kind.rows, reach))
    _, number, following = _nearest(grown, _single(rays), kind.distance)
    met = jax.tree.map(lambda leaf: leaf[number], kind.rows)
    return _Nearest(jax.vmap(kind.distance)(met, rays), number, following)


def _nearest_of_all(kind: Kind, rays: Rays) -> tuple[Float[Array, " n"], Int[Array, " n"]]:
    """Return distance and row in full precision; needs memory for each pair of a solid and a ray."""
    to_each = jax.lax.map(lambda solid: kind.distance(solid, rays), kind.rows)
    return jnp.min(to_each, axis=0), jnp.argmin(to_each, axis=0).astype(jnp.int32)


def _nearest(solids: Any, rays: Rays, distance_to: Callable[..., Array]) -> _Nearest:
    """Search all solids, a few at a time.

    The inner loop stores their distances in memory: XLA would otherwise fuse the loops and compute each
    distance again for each of the three results.
    """
    count = solids.reflectivity.shape[0]
    # the rows that fill up the last block are left out below
    fill = jnp.minimum(jnp.arange(-(-count // _TOGETHER) * _TOGETHER), count - 1)
    blocks = jax.tree.map(lambda leaf: leaf[fill].reshape(-1, _TOGETHER, *leaf.shape[1:]), solids)

    def closer_of(best: _Nearest, block: tuple[Array, Any]) -> tuple[_Nearest, None]:
        first, members = block
        distances = jax.lax.map(lambda solid: distance_to(solid, rays), members)
        for number, distance in enumerate(distances):
            distance = jnp.where(first + number < count, distance, jnp.inf)
            closer = distance < best.distance
            later = jnp.where(closer, best.distance, distance)
            best = _Nearest(
                jnp.where(closer, distance, best.distance),
                jnp.where(closer, first + number, best.number),
                jnp.where(later < best.following, later, best.following),
            )
        return best, None

    never = jnp.full(rays.x.shape, jnp.inf, rays.x.dtype)
    start = _Nearest(never, jnp.zeros(rays.x.shape, jnp.int32), never)
    firsts = jnp.arange(0, count, _TOGETHER, dtype=jnp.int32)
    return jax.lax.scan(closer_of, start, (firsts, blocks))[0]


def _single(tree: _Tree) -> _Tree:
    return jax.tree.map(lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, tree)


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
