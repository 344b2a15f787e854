"""The points of one scan nearest another's, ring by ring: exact, and quick because rings are sorted.

Points are sorted by ring and by azimuth within each ring. A query looks at a window of each ring near its own
elevation; where what lies outside might be nearer, at a longer window of every ring; and where even that is
not sure, at all points.
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, Int32

from lio_jax.core.materialise import materialised
from lio_jax.core.prefix_sum import running_count
from lio_jax.lidar.range_image import azimuth

_SIDE, _NARROW = 8, 16
"""Rings above and below a query's own, and points of each, that are looked at for the nearest point."""
_BESIDE, _WIDE = 2, 64
"""Likewise for the others: at LOAM's spacing of 0.2 m they reach beyond its search radius of 5 m."""
_CHUNK = 32
"""Queries that look farther at a time."""
_SECTORS = 512
"""Parts of a ring that it is sorted into: few, so that a number of 32 bits holds ring, sector and row."""
_QUARTER = np.float32(np.pi / 2)
_TURN = np.float32(2 * np.pi)

_Points = tuple[Float32[Array, " k"], Float32[Array, " k"], Float32[Array, " k"]]


class RingIndex(eqx.Module):
    """A cloud sorted for the search; masked points come last."""

    x: Float32[Array, " m"]
    """m."""
    y: Float32[Array, " m"]
    z: Float32[Array, " m"]
    ring: Int32[Array, " m"]
    """-1 where there is no point."""
    azimuth: Float32[Array, " m"]
    """rad."""
    first: Int32[Array, " cells"]
    """Place of the first point in or after each sector of each ring, ring after ring, and the end."""
    elevation: Float32[Array, " rings"]
    """Mean over each ring's points, rad; infinite for a ring without any."""

    @property
    def sectors(self) -> int:
        """Sectors per ring that ``first`` distinguishes."""
        return (self.first.shape[0] - 1) // self.elevation.shape[0]

    def at(self, place: Int32[Array, "*b"]) -> tuple[Array, Array, Array]:
        """Return x, y and z of points."""
        return _take(self.x, place), _take(self.y, place), _take(self.z, place)


class Nearest(eqx.Module):
    """Places of points in an index, -1 where there is none within the radius."""

    nearest: Int32[Array, " k"]
    same_ring: Int32[Array, " k"]
    """The next one of the nearest one's ring."""
    other_ring: Int32[Array, " k"]
    """The nearest one of the rings beside it."""


def ring_index(
    points: Float32[Array, "m 3"], ring: Int32[Array, " m"], mask: Bool[Array, " m"], rings: int
) -> RingIndex:
    """Sort a cloud.

    Args:
        points: m.
        ring: of each point.
        mask: which points are real.
        rings: number of rings.
    """
    count = len(points)
    row_bits = (count - 1).bit_length()
    sectors = min(_SECTORS, 1 << (((1 << (32 - row_bits)) - 1) // rings).bit_length() - 1)
    x, y, z = materialised(tuple(points.T))
    angle = azimuth(x, y)
    sector = jnp.clip(_sector(angle, sectors), 0, sectors - 1)
    cell = jnp.where(mask, ring * sectors + sector, rings * sectors)
    row = jnp.arange(count, dtype=jnp.uint32)
    # numbers without a payload are sorted four times as fast as an argsort
    key = jnp.sort(cell.astype(jnp.uint32) << row_bits | row)
    order = (key & jnp.uint32((1 << row_bits) - 1)).astype(jnp.int32)
    occupied = jnp.zeros(rings * sectors + 1, jnp.int32).at[cell].add(1)
    first = jnp.cumsum(occupied, dtype=jnp.int32) - occupied

    elevation = azimuth(jnp.sqrt(x**2 + y**2), z)
    total = jnp.zeros((rings, 2), jnp.float32)
    total = total.at[jnp.where(mask, ring, rings)].add(
        jnp.stack([elevation, jnp.ones_like(elevation)], -1), mode="drop"
    )
    mean = jnp.where(total[:, 1] > 0, total[:, 0] / jnp.maximum(total[:, 1], 1.0), jnp.inf)
    x, y, z, angle, ring, mask = (_take(column, order) for column in (x, y, z, angle, ring, mask))
    return RingIndex(x, y, z, jnp.where(mask, ring, -1), angle, first, mean)


def nearest_by_ring(
    index: RingIndex,
    points: Float32[Array, "k 3"],
    mask: Bool[Array, " k"],
    radius: Float32[Array, ""],
    rings_apart: Float32[Array, ""],
) -> Nearest:
    """Return, for each query, the nearest point, the next one of its ring and the nearest of another ring.

    Args:
        index: of the cloud to search.
        points: queries, in the cloud's frame, m.
        mask: which queries are real.
        radius: farther points do not count, m.
        rings_apart: the other ring is fewer rings than this away from the nearest point's.
    """
    rings = len(index.elevation)
    queries: _Points = materialised(tuple(jnp.where(mask[:, None], points, 0.0).T))
    search = _Search(index, radius, rings_apart)
    found, sure = search.in_windows(queries, _SIDE, _NARROW)

    def among_all(queries: _Points) -> tuple[Nearest, Array]:
        return search.among_all(queries), jnp.ones_like(queries[0], bool)

    found, sure = _again(mask & ~sure, queries, found, lambda some: search.in_windows(some, rings, _WIDE))
    found, _ = _again(mask & ~sure, queries, found, among_all)
    return jax.tree.map(lambda place: jnp.where(mask, place, -1), found)


def _again(
    unsure: Bool[Array, " k"],
    queries: _Points,
    found: Nearest,
    search: Callable[[_Points], tuple[Nearest, Bool[Array, " c"]]],
) -> tuple[Nearest, Bool[Array, " k"]]:
    """Search anew for some of the queries, chunk by chunk; tell for which one is sure then."""
    count = len(unsure)
    rank = running_count(unsure) - 1
    order = jnp.arange(count, dtype=jnp.int32)
    waiting = jnp.full(count, count, jnp.int32).at[jnp.where(unsure, rank, count)].set(order, mode="drop")

    def one_chunk(number: Array, carry: tuple[Nearest, Array]) -> tuple[Nearest, Array]:
        place = number * _CHUNK + jnp.arange(_CHUNK, dtype=jnp.int32)
        row = waiting.at[place].get(mode="fill", fill_value=count)
        x, y, z = (axis.at[row].get(mode="clip") for axis in queries)
        new = search((x, y, z))
        return jax.tree.map(lambda old, some: old.at[row].set(some, mode="drop"), carry, new)

    return jax.lax.fori_loop(0, (rank[-1] + _CHUNK) // _CHUNK, one_chunk, (found, ~unsure))


class _Search(eqx.Module):
    """What all queries share."""

    index: RingIndex
    radius: Float32[Array, ""]
    rings_apart: Float32[Array, ""]

    def in_windows(self, queries: _Points, side: int, window: int) -> tuple[Nearest, Bool[Array, " k"]]:
        """Search windows of near rings; tell for which queries nothing outside of them can be nearer.

        Args:
            queries: m.
            side: rings above and below that the nearest point may lie in.
            window: points of each of them.
        """
        x, y, z = queries
        level = jnp.sqrt(x**2 + y**2)
        away = jnp.abs(self.index.elevation[:, None] - azimuth(level, z))
        own = jnp.argmin(away, 0).astype(jnp.int32)
        windows = _Windows.of(self.index, queries, own, side, window)
        keys = windows.keys(self.radius)
        nearest, squared = windows.smallest(keys, jnp.full(len(x), True))
        distance = jnp.sqrt(jnp.minimum(squared, self.radius**2))
        outside = jnp.abs(jnp.arange(len(away), dtype=jnp.int32)[:, None] - own) > side
        angle = jnp.min(jnp.where(outside, away, jnp.inf), 0)
        beyond = jnp.sqrt(level**2 + z**2) * jnp.sin(jnp.minimum(angle, _QUARTER))
        sure = (distance <= windows.reach()) & ((distance <= beyond) | jnp.isinf(angle))

        ring = jnp.where(nearest >= 0, _take(self.index.ring, jnp.maximum(nearest, 0)), own)
        windows = _Windows.of(self.index, queries, ring, _BESIDE, _WIDE)
        keys = windows.keys(self.radius)
        step = jnp.abs(windows.ring_step())
        same, same_squared = windows.smallest(keys, (step == 0) & ~windows.is_at(nearest))
        other, other_squared = windows.smallest(keys, (step > 0) & (step < self.rings_apart))
        farthest = jnp.sqrt(jnp.minimum(jnp.maximum(same_squared, other_squared), self.radius**2))
        return Nearest(nearest, same, other), sure & (farthest <= windows.reach())

    def among_all(self, queries: _Points) -> Nearest:
        """Search all points."""
        index = self.index
        ring = index.ring[:, None]
        place = jnp.arange(len(ring), dtype=jnp.int32)[:, None]
        points = index.x, index.y, index.z
        squared = sum((axis[:, None] - query) ** 2 for axis, query in zip(points, queries, strict=True))
        squared = materialised(jnp.where((ring >= 0) & (squared < self.radius**2), squared, jnp.inf))

        def smallest(allowed: Array) -> Array:
            least = jnp.min(jnp.where(allowed, squared, jnp.inf), 0)
            here = allowed & (squared == least) & jnp.isfinite(least)
            return jnp.max(jnp.where(here, place, -1), 0)

        nearest = smallest(ring >= 0)
        step = jnp.abs(ring - _take(index.ring, jnp.maximum(nearest, 0)))
        same = smallest((step == 0) & (place != nearest))
        return Nearest(nearest, same, smallest((step > 0) & (step < self.rings_apart)))


class _Windows(eqx.Module):
    """A window of each of a few rings for each query, around its own azimuth."""

    index: RingIndex
    queries: _Points
    start: Int32[Array, "b k"]
    """Place of the ring's first point."""
    size: Int32[Array, "b k"]
    """The ring's points; 0 beyond the sensor's rings."""
    begin: Int32[Array, "b k"]
    """From ``start`` to the window's first point; negative where the window begins at the ring's end."""
    length: int = eqx.field(static=True)

    @staticmethod
    def of(
        index: RingIndex, queries: _Points, ring: Int32[Array, " k"], side: int, length: int
    ) -> "_Windows":
        """Return windows in the rings from ``side`` below a given one to ``side`` above it."""
        rings, sectors = len(index.elevation), index.sectors
        sector = jnp.clip(_sector(azimuth(queries[0], queries[1]), sectors), 0, sectors - 1)
        band = ring + jnp.arange(-side, side + 1, dtype=jnp.int32)[:, None]
        cell = jnp.clip(band, 0, rings - 1) * sectors
        start, end = _take(index.first, cell), _take(index.first, cell + sectors)
        size = jnp.where((band >= 0) & (band < rings), end - start, 0)
        begin = _take(index.first, cell + sector) - start - jnp.minimum(length, size) // 2
        return _Windows(index, queries, *materialised((start, size, begin)), length)

    def keys(self, radius: Array) -> Int32[Array, "n k"]:
        """Return the squared distance of each point, the lowest bits replaced by its number.

        The number counts the rings and then the points. As integers, keys are ordered as the distances.
        """
        step = jnp.arange(self.length, dtype=jnp.int32)[:, None, None]
        points = self.index.at(self._place(step, slice(None)))
        squared = sum((axis - query) ** 2 for axis, query in zip(points, self.queries, strict=True))
        # a ring shorter than the window would show its points twice
        squared = jnp.where((step < self.size) & (squared < radius**2), squared, jnp.inf)
        band = jnp.arange(len(self.size), dtype=jnp.int32)[:, None]
        keys = jax.lax.bitcast_convert_type(squared, jnp.int32) & ~self._mask | step * len(self.size) + band
        return materialised(keys.reshape(-1, keys.shape[-1]))

    def smallest(self, keys: Array, allowed: Bool[Array, "*n k"]) -> tuple[Array, Array]:
        """Return place and squared distance of each query's nearest point, -1 and infinite without one."""
        key = jnp.min(jnp.where(allowed, keys, jnp.iinfo(jnp.int32).max), 0)
        squared = jax.lax.bitcast_convert_type(key & ~self._mask, jnp.float32)
        number = jnp.minimum(key & self._mask, len(keys) - 1)
        column = jnp.arange(len(key))
        place = self._place(number // len(self.size), (number % len(self.size), column))
        # keys that were not allowed come out as NaN
        real = squared < jnp.inf
        return jnp.where(real, place, -1), jnp.where(real, squared, jnp.inf)

    def ring_step(self) -> Int32[Array, "n 1"]:
        """Return how many rings each number lies above the middle one."""
        number = jnp.arange(self.length * len(self.size), dtype=jnp.int32)[:, None]
        return number % len(self.size) - len(self.size) // 2

    def is_at(self, place: Int32[Array, " k"]) -> Bool[Array, "n k"]:
        """Return which numbers stand for a place in the middle ring."""
        band = len(self.size) // 2
        number = jnp.arange(self.length * len(self.size), dtype=jnp.int32)[:, None]
        step, size = place - self.start[band] - self.begin[band], self.size[band]
        step += jnp.where(step < 0, size, jnp.where(step >= size, -size, 0))
        return number == step * len(self.size) + band

    def reach(self) -> Float32[Array, " k"]:
        """Return a distance within which no point of the rings lies outside of the windows, m."""
        x, y, _ = self.queries
        angle = azimuth(x, y)
        before, after = (
            _take(self.index.azimuth, self._place(jnp.int32(step), slice(None)))
            for step in (0, self.length - 1)
        )
        gap = jnp.minimum(_turned(angle - before), _turned(after - angle))
        aside = jnp.sqrt(x**2 + y**2) * jnp.sin(jnp.minimum(gap, _QUARTER))
        return jnp.min(jnp.where(self.size > self.length, aside, jnp.inf), 0)

    @property
    def _mask(self) -> int:
        return (1 << (self.length * len(self.size) - 1).bit_length()) - 1

    def _place(self, step: Array, which: Any) -> Array:
        """Return the place that a step along a ring's window leads to."""
        along, size = self.begin[which] + step, self.size[which]
        along += jnp.where(along < 0, size, jnp.where(along >= size, -size, 0))
        return self.start[which] + jnp.clip(along, 0, jnp.maximum(size - 1, 0))


def _sector(angle: Array, sectors: int) -> Array:
    return jnp.floor((angle / _TURN + 0.5) * sectors).astype(jnp.int32)


def _turned(angle: Array) -> Array:
    """Return an angle within 0 and one turn."""
    return angle - _TURN * jnp.floor(angle / _TURN)


def _take(table: Array, index: Array) -> Array:
    return table.at[index].get(mode="promise_in_bounds")
