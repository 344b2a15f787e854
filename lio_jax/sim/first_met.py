"""Which of the solids of a kind each ray meets first: searched for in float32, told in full precision."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from lio_jax.sim.intersect import Rays

_TOGETHER = 8
"""Solids whose distances are held in memory at once."""
_SMALL = 2**16
"""Up to so many pairs of a solid and a ray, all of them are looked at in full precision."""
_AGAIN = 256
"""Rays that are searched for again at once."""

_Tree = TypeVar("_Tree")


class Kind(NamedTuple):
    """All solids of a kind and what to do with them."""

    rows: Any
    distance: Callable[..., Array]
    """From one solid and rays, as in ``intersect``."""
    normal: Callable[..., Array]
    """From one solid and one point on it per row, as in ``normals``."""
    grown: Callable[..., Any]
    """From all solids and how far from the origin rays start, as in ``growth``."""

    @property
    def size(self) -> int:
        """How many there are."""
        return int(self.rows.reflectivity.shape[0])


class _Nearest(NamedTuple):
    distance: Float[Array, " n"]
    """To the solid that is met first, m; inf where none is."""
    number: Int[Array, " n"]
    """Which one that is."""
    following: Float[Array, " n"]
    """At what distance another may be met, m; float32."""


def first_met(kinds: list[Kind], rays: Rays) -> tuple[Float[Array, "kinds n"], Int[Array, "kinds n"]]:
    """Return how far each ray goes until it meets one of each kind, and which one.

    The distance is in m, and inf where none is met.

    Many rays are searched for in float32, among solids grown by its rounding. That yields a candidate of each
    kind, whose distance then follows in full precision, and at what distance the ray may meet another of the
    kind. The few rays that may do so before they have met any candidate are searched for once more.
    """
    found = [_candidate(kind, rays) for kind in kinds]
    distance, number, following = (jnp.stack(part) for part in zip(*found, strict=True))
    if all(_is_small(kind, rays) for kind in kinds):
        return distance, number
    # the barrier keeps XLA from computing it anew for each of its uses
    distance = jax.lax.optimization_barrier(distance)
    unsure = jnp.any(following < jnp.min(distance, axis=0), axis=0)

    def search_again(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        unsure, distance, number = state
        # what there are too few of is filled up with the first ray
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
    """Return distance and number in full precision; needs memory for each solid and ray."""
    to_each = jax.lax.map(lambda solid: kind.distance(solid, rays), kind.rows)
    return jnp.min(to_each, axis=0), jnp.argmin(to_each, axis=0).astype(jnp.int32)


def _nearest(solids: Any, rays: Rays, distance_to: Callable[..., Array]) -> _Nearest:
    """Search all solids, a few at once.

    The inner loop puts their distances into memory: fused, XLA computes each anew for each of three results.
    """
    count = solids.reflectivity.shape[0]
    # what fills up the last block is left out below
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
