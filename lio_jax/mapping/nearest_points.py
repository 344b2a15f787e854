"""The nearest points of a :class:`PointMap` to each query, in a form for which XLA makes fast loops on a CPU.

The candidates of a query are all points of some blocks. Each candidate is one integer: its squared distance,
with the lowest bits replaced by the candidate's number. A network of minima and maxima keeps the smallest of
these integers, without a sort.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.prefix_sum import running_count
from lio_jax.core.xla import computed_once
from lio_jax.mapping.hash_slots import find_slots
from lio_jax.mapping.point_map import EDGE, VOXELS, PointMap

_NEAR = tuple(itertools.product((0, 1), repeat=3))
_AROUND = tuple(itertools.product((-1, 0, 1), repeat=3))
_CHUNK = 512
"""Number of queries of eight blocks at a time: their candidates fit a core's cache, and padding is cheap."""
_WIDE_CHUNK = 128
"""Number of queries of 27 blocks at a time."""


class Neighbours(eqx.Module):
    """The n map points nearest to each of k queries, in ascending distance; infinite if there are too few."""

    x: Float[Array, "n k"]
    """Coordinate x of each point, m, in the anchored frame."""
    y: Float[Array, "n k"]
    """Coordinate y of each point, m, in the anchored frame."""
    z: Float[Array, "n k"]
    """Coordinate z of each point, m, in the anchored frame."""
    squared_distance: Float[Array, "n k"]
    """Squared distance of each point from the query, m^2."""
    entry: Int32[Array, "n k"]
    """Where the map holds each point: its slot times 27, plus its voxel; 0 where there is none."""

    @staticmethod
    def none(neighbours: int, count: int, dtype: DTypeLike) -> "Neighbours":
        """Return the neighbours of queries that were not searched."""
        far = jnp.full((neighbours, count), jnp.inf, dtype)
        return Neighbours(far, far, far, far, jnp.zeros((neighbours, count), jnp.int32))


def nearest_points(
    pmap: PointMap,
    points: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
    neighbours: int,
    radius: Float[Array, ""] | float = jnp.inf,
) -> Neighbours:
    """Return the map points nearest to each query.

    First the eight blocks nearest to a query are searched. If a point outside of them could be nearer than
    the last one found and nearer than the radius, all 27 blocks around the query are searched. So neighbours
    within a block's edge are always exact; farther ones are the nearest points of these blocks. Distances
    that agree to a thousandth count as equal.

    Args:
        pmap: the map.
        points: the queries, m, in the frame anchored at ``anchor``.
        mask: which rows are real; rows after the last real one cost nothing.
        anchor: block whose lower corner is the origin of ``points``.
        voxel_size: edge length of a voxel, m.
        neighbours: number of map points for each query.
        radius: distance beyond which a neighbour need not be the nearest one, m.
    """
    count = points.shape[0]
    edge = EDGE * voxel_size
    points = jnp.where(mask[:, None], points.astype(pmap.point.dtype), 0.0)
    search = _Search(pmap, points, anchor, edge, neighbours)
    order = jnp.arange(count, dtype=jnp.int32)
    found = Neighbours.none(neighbours, count, points.dtype)
    rows = jnp.max(jnp.where(mask, order + 1, 0))
    found = search.over(found, order, rows, jnp.array(_NEAR, jnp.int32), _CHUNK)

    scaled = points / edge
    fraction = scaled - jnp.floor(scaled)
    # along each axis the eight blocks cover the query's own block and its neighbour on the nearer side
    covered = jnp.maximum(fraction, 1 - fraction)
    sure = edge * jnp.minimum(jnp.minimum(covered[:, 0], covered[:, 1]), covered[:, 2])
    unsure = mask & (jnp.minimum(found.squared_distance[-1], radius**2) > sure**2)
    rank = running_count(unsure) - 1
    waiting = jnp.full(count, count, jnp.int32).at[jnp.where(unsure, rank, count)].set(order, mode="drop")
    return search.over(found, waiting, rank[-1] + 1, jnp.array(_AROUND, jnp.int32), _WIDE_CHUNK)


class _Search(eqx.Module):
    """The map and the queries of a search."""

    pmap: PointMap
    points: Float[Array, "k 3"]
    anchor: Int32[Array, "3"]
    edge: Float[Array, ""]
    neighbours: int = eqx.field(static=True)

    def over(
        self,
        found: Neighbours,
        order: Int32[Array, " k"],
        rows: Int32[Array, ""],
        blocks: Int32[Array, "b 3"],
        chunk: int,
    ) -> Neighbours:
        """Search some blocks for the first ``rows`` queries in ``order``; replace their earlier results."""
        count = len(order)

        def one_chunk(number: Array, found: Neighbours) -> Neighbours:
            place = number * chunk + jnp.arange(chunk, dtype=jnp.int32)
            row = jnp.where(place < rows, order[jnp.minimum(place, count - 1)], count)
            new = self._among(self.points[jnp.minimum(row, count - 1)], blocks)
            return jax.tree.map(lambda old, some: old.at[:, row].set(some, mode="drop"), found, new)

        return jax.lax.fori_loop(0, (rows + chunk - 1) // chunk, one_chunk, found)

    def _among(self, points: Float[Array, "c 3"], blocks: Int32[Array, "b 3"]) -> Neighbours:
        """Return the nearest points in some blocks; 1 in ``blocks`` is a step to the query's nearer side."""
        scaled = points / self.edge
        own = jnp.floor(scaled)
        side = jnp.where(scaled - own > 0.5, 1, -1).astype(jnp.int32)
        local = own.astype(jnp.int32) + blocks[:, None] * side
        slot = computed_once(find_slots(self.pmap.block, local + self.anchor))
        bits = (len(blocks) * VOXELS - 1).bit_length()
        distance_bits = jnp.int32(-1 << bits)

        def with_block(number: Array, nearest: tuple[Array, ...]) -> tuple[Array, ...]:
            held = slot[number]
            away = points - self._centre(local[number])
            rows = _take(self.pmap.point, jnp.maximum(held, 0))
            squared = sum(
                (rows[:, axis * VOXELS : (axis + 1) * VOXELS] - away[:, axis : axis + 1]) ** 2
                for axis in range(3)
            )
            squared = jnp.where(held[:, None] >= 0, squared, jnp.inf)
            key = jax.lax.bitcast_convert_type(squared.astype(jnp.float32), jnp.int32) & distance_bits
            # queries are contiguous in memory: the network's loops run over them
            keys = computed_once((key | (number * VOXELS + jnp.arange(VOXELS, dtype=jnp.int32))).T)
            # a copy in memory of its own: XLA does not vectorise a loop that reads its own carry
            nearest = computed_once(nearest)
            for candidate in range(VOXELS):
                nearest = _with_candidate(nearest, keys[candidate])
            return nearest

        none = jnp.full(len(points), jnp.iinfo(jnp.int32).max)
        keys = jax.lax.fori_loop(0, len(blocks), with_block, (none,) * self.neighbours)
        # with fewer candidates than neighbours the network's initial value is left: no candidate's number
        number = jnp.minimum(jnp.stack(keys) & ~distance_bits, len(blocks) * VOXELS - 1)
        which, voxel = number // VOXELS, number % VOXELS
        column = jnp.arange(len(points))
        chosen = _take(slot, (which, column))
        centre = self._centre(_take(local, (which, column)))
        coordinates = [
            jnp.where(
                chosen >= 0,
                _take(self.pmap.point, (jnp.maximum(chosen, 0), axis * VOXELS + voxel)) + centre[..., axis],
                jnp.inf,
            )
            for axis in range(3)
        ]
        x, y, z = coordinates
        squared = (x - points[:, 0]) ** 2 + (y - points[:, 1]) ** 2 + (z - points[:, 2]) ** 2
        return Neighbours(x, y, z, squared, jnp.maximum(chosen, 0) * VOXELS + voxel)

    def _centre(self, local: Int32[Array, "*b 3"]) -> Float[Array, "*b 3"]:
        return (local.astype(self.points.dtype) + 0.5) * self.edge


def coordinates_at(
    pmap: PointMap, entry: Int32[Array, "n k"], anchor: Int32[Array, "3"], voxel_size: Float[Array, ""]
) -> Float[Array, "3 n k"]:
    """Return the coordinates of points that the map holds, m, in the anchored frame.

    Args:
        pmap: the map; its points may have a derivative.
        entry: see :class:`Neighbours`.
        anchor: block whose lower corner is the origin.
        voxel_size: edge length of a voxel, m.
    """
    slot, voxel = entry // VOXELS, entry % VOXELS
    axis = jnp.arange(3)[:, None, None]
    local = jnp.moveaxis(_take(pmap.block, slot) - anchor, -1, 0)
    centre = (local.astype(pmap.point.dtype) + 0.5) * (EDGE * voxel_size)
    return _take(pmap.point, (slot[None], axis * VOXELS + voxel)) + centre


def _with_candidate(nearest: tuple[Array, ...], key: Array) -> tuple[Array, ...]:
    """Return the smallest keys in ascending order, after one more candidate."""
    kept = []
    for smallest in nearest:
        kept.append(jnp.minimum(smallest, key))
        key = jnp.maximum(smallest, key)
    return tuple(kept)


def _take(table: Array, index: Array | tuple[Array, ...]) -> Array:
    return table.at[index].get(mode="promise_in_bounds")
