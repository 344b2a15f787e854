"""The points of one scan nearest another's, ring by ring, quick because rings are sorted.

Points are sorted by ring and by sector of azimuth within each ring. A query looks at a window of each ring
near its own elevation; where what lies outside might be nearer, at longer windows of more rings; and where
even that is not sure, at all points. What is sure takes a ring to be level, at its mean elevation. Several
clouds share an index, each with rings of its own.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.prefix_sum import running_count
from lio_jax.core.xla import computed_once
from lio_jax.lidar.range_image import azimuth

_SIDE, _NARROW = 8, 24
"""Number of rings above and below a query's own, and of points in each, that are searched first."""
_PARTNER_RINGS, _WIDE = 2, 32
"""Number of rings around the nearest point's own, and of points in each, that are searched for the others."""
_CHUNK, _FARTHER_NARROW, _FARTHER_WIDE = 32, 32, 256
"""Number of queries of a farther search at a time, and of points that it searches in each ring."""
_LAST_CHUNK = 8
"""Number of queries of a search of all points at a time."""
_SECTORS = 512
"""Parts of a ring that it is sorted into: few, so that a number of 32 bits holds ring, sector and row."""
_QUARTER = np.float32(np.pi / 2)
_ROUNDING = np.float32(1e-5)
"""Largest rounding error of an azimuth, rad."""
_TURN = np.float32(2 * np.pi)

_Points = tuple[Float[Array, " k"], Float[Array, " k"], Float[Array, " k"]]


class RingIndex(eqx.Module):
    """Clouds sorted for the search; masked points come last."""

    x: Float[Array, " m"]
    """Coordinate x of each point, m."""
    y: Float[Array, " m"]
    """Coordinate y of each point, m."""
    z: Float[Array, " m"]
    """Coordinate z of each point, m."""
    ring: Int32[Array, " m"]
    """Ring of each point; -1 where there is no point."""
    azimuth: Float[Array, " m"]
    """Azimuth of each point, rad."""
    first: Int32[Array, " cells"]
    """Place of the first point in or after each sector of each ring, ring after ring, and the end."""
    elevation: Float[Array, " rings"]
    """Mean over each ring's points, rad; infinite for a ring without any."""

    @property
    def sectors(self) -> int:
        """Sectors per ring that ``first`` distinguishes."""
        return (self.first.shape[0] - 1) // self.elevation.shape[0]

    def at(self, place: Int32[Array, "*b"]) -> tuple[Array, Array, Array]:
        """Return x, y and z of points."""
        return _take(self.x, place), _take(self.y, place), _take(self.z, place)


class Queries(eqx.Module):
    """Points whose neighbours are sought."""

    x: Float[Array, " k"]
    """Coordinate x of each query, m, in the index's frame."""
    y: Float[Array, " k"]
    """Coordinate y of each query, m, in the index's frame."""
    z: Float[Array, " k"]
    """Coordinate z of each query, m, in the index's frame."""
    lowest: Int32[Array, " k"]
    """First ring of the cloud to search."""

    def away_from(self, points: tuple[Array, Array, Array]) -> Array:
        """Return squared distances, m^2."""
        x, y, z = points
        return (x - self.x) ** 2 + (y - self.y) ** 2 + (z - self.z) ** 2


class Nearest(eqx.Module):
    """Places of points in an index, -1 where there is none within the radius."""

    nearest: Int32[Array, " k"]
    """Place of the nearest point."""
    same_ring: Int32[Array, " k"]
    """Place of the next nearest point in the ring of the nearest one."""
    other_ring: Int32[Array, " k"]
    """Place of the nearest point in the neighbouring rings."""


def ring_index(
    points: Float[Array, "m 3"], ring: Int32[Array, " m"], mask: Bool[Array, " m"], rings: int
) -> RingIndex:
    """Sort clouds. Their coordinates keep their derivative; the order is a choice, which has none.

    Args:
        points: m.
        ring: of each point.
        mask: which points are real.
        rings: number of rings, of all clouds together.
    """
    count = len(points)
    row_bits = (count - 1).bit_length()
    sectors = min(_SECTORS, 1 << (((1 << (32 - row_bits)) - 1) // rings).bit_length() - 1)
    x, y, z = computed_once(tuple(jax.lax.stop_gradient(points).astype(jnp.float32).T))
    angle = azimuth(x, y)
    cell = jnp.where(mask, ring * sectors + _sector(angle, sectors), rings * sectors)
    row = jnp.arange(count, dtype=jnp.uint32)
    # numbers without a payload are sorted four times as fast as an argsort
    key = jnp.sort(cell.astype(jnp.uint32) << row_bits | row)
    order = (key & jnp.uint32((1 << row_bits) - 1)).astype(jnp.int32)
    occupied = jnp.zeros(rings * sectors + 1, jnp.int32).at[cell].add(1)
    first = jnp.cumsum(occupied, dtype=jnp.int32) - occupied

    elevation = azimuth(jnp.sqrt(x**2 + y**2), z)
    terms = jnp.stack([elevation, jnp.ones_like(elevation)], -1)
    total = jnp.zeros((rings, 2), terms.dtype).at[jnp.where(mask, ring, rings)].add(terms, mode="drop")
    mean = jnp.where(total[:, 1] > 0, total[:, 0] / jnp.maximum(total[:, 1], 1.0), jnp.inf)
    columns = (*points.T, angle, ring, mask)
    x, y, z, angle, ring, mask = (_take(column, order) for column in columns)
    return RingIndex(x, y, z, jnp.where(mask, ring, -1), angle, first, mean)


def nearest_by_ring(
    index: RingIndex,
    queries: Queries,
    mask: Bool[Array, " k"],
    cloud_rings: int,
    radius: Float[Array, ""],
    rings_apart: Float[Array, ""],
) -> Nearest:
    """Return, for each query, the nearest point, the next one of its ring and the nearest of another ring.

    Args:
        index: of the clouds to search.
        queries: finite, also where masked.
        mask: which queries are real.
        cloud_rings: number of rings of each cloud.
        radius: farther points do not count, m.
        rings_apart: the other ring is fewer rings than this away from the nearest point's; 3 at most.
    """
    search = _Search(index, radius, rings_apart, cloud_rings)
    nearest, sure = search.nearest(queries, _SIDE, _NARROW)
    nearest, sure = _again(
        mask & ~sure,
        queries,
        nearest,
        lambda some: search.nearest(some, cloud_rings, _FARTHER_NARROW),
    )
    nearest, _ = _again(mask & ~sure, queries, nearest, search.nearest_of_all, _LAST_CHUNK)
    others, sure = search.partners((queries, nearest), _WIDE)
    given = queries, nearest
    others, sure = _again(mask & ~sure, given, others, lambda some: search.partners(some, _FARTHER_WIDE))
    others, _ = _again(mask & ~sure, given, others, search.partners_of_all, _LAST_CHUNK)
    return Nearest(*(jnp.where(mask, place, -1) for place in (nearest, *others)))


_Given = TypeVar("_Given")
_Found = TypeVar("_Found")


def _again(
    unsure: Bool[Array, " k"],
    given: _Given,
    found: _Found,
    search: Callable[[_Given], tuple[_Found, Bool[Array, " c"]]],
    chunk: int = _CHUNK,
) -> tuple[_Found, Bool[Array, " k"]]:
    """Search again for some of the queries, chunk by chunk; return for which ones the result is exact."""
    count = len(unsure)
    rank = running_count(unsure) - 1
    order = jnp.arange(count, dtype=jnp.int32)
    waiting = jnp.full(count, count, jnp.int32).at[jnp.where(unsure, rank, count)].set(order, mode="drop")

    def one_chunk(number: Array, carry: tuple[_Found, Array]) -> tuple[_Found, Array]:
        place = number * chunk + jnp.arange(chunk, dtype=jnp.int32)
        row = waiting.at[place].get(mode="fill", fill_value=count)
        new = search(jax.tree.map(lambda column: column.at[row].get(mode="clip"), given))
        merged: tuple[_Found, Array] = jax.tree.map(
            lambda old, some: old.at[row].set(some, mode="drop"), carry, new
        )
        return merged

    return jax.lax.fori_loop(0, (rank[-1] + chunk) // chunk, one_chunk, (found, ~unsure))


class _Search(eqx.Module):
    """What all queries share."""

    index: RingIndex
    radius: Float[Array, ""]
    rings_apart: Float[Array, ""]
    cloud_rings: int = eqx.field(static=True)

    def nearest(self, queries: Queries, side: int, window: int) -> tuple[Array, Bool[Array, " k"]]:
        """Return each query's nearest point in windows; tell for which ones none outside can be nearer.

        Args:
            queries: points.
            side: rings above and below a query's own.
            window: points of each ring.
        """
        level = jnp.sqrt(queries.x**2 + queries.y**2)
        number = jnp.arange(self.cloud_rings, dtype=jnp.int32)[:, None]
        elevation = _take(self.index.elevation, queries.lowest + number)
        away = computed_once(jnp.abs(elevation - azimuth(level, queries.z)))
        own = jnp.min(jnp.where(away == jnp.min(away, 0), number, self.cloud_rings - 1), 0)
        windows = _Windows.of(self, queries, queries.lowest + own, min(side, self.cloud_rings - 1), window)
        place, squared = windows.smallest(windows.keys(), jnp.bool_(True))
        distance = jnp.sqrt(jnp.minimum(squared, self.radius**2))
        angle = jnp.min(jnp.where(jnp.abs(number - own) > side, away, jnp.inf), 0)
        beyond = jnp.sqrt(level**2 + queries.z**2) * jnp.sin(jnp.minimum(angle, _QUARTER))
        return place, (distance <= windows.reach()) & ((distance <= beyond) | jnp.isinf(angle))

    def partners(
        self, given: tuple[Queries, Int32[Array, " k"]], window: int
    ) -> tuple[tuple[Array, Array], Bool[Array, " k"]]:
        """Return the next point of the nearest one's ring and the nearest one of another, as ``nearest``."""
        queries, nearest = given
        ring = _take(self.index.ring, jnp.maximum(nearest, 0))
        windows = _Windows.of(self, queries, jnp.maximum(ring, 0), _PARTNER_RINGS, window)
        keys, step = computed_once(windows.keys()), jnp.abs(windows.ring_step())
        same, same_squared = windows.smallest(keys, (step == 0) & ~windows.is_at(nearest))
        other, other_squared = windows.smallest(keys, (step > 0) & (step < self.rings_apart))
        farthest = jnp.sqrt(jnp.minimum(jnp.maximum(same_squared, other_squared), self.radius**2))
        found = nearest >= 0
        same, other = (jnp.where(found, place, -1) for place in (same, other))
        return (same, other), (farthest <= windows.reach()) | ~found

    def nearest_of_all(self, queries: Queries) -> tuple[Array, Bool[Array, " k"]]:
        """Return each query's nearest point."""
        ring = self.index.ring[:, None]
        squared = self._squared(queries)
        within = (ring >= queries.lowest) & (ring < queries.lowest + self.cloud_rings)
        return _least(squared, within), jnp.ones_like(queries.lowest, bool)

    def partners_of_all(
        self, given: tuple[Queries, Int32[Array, " k"]]
    ) -> tuple[tuple[Array, Array], Bool[Array, " k"]]:
        """Return the result of ``partners``, from a search of all points."""
        queries, nearest = given
        ring = self.index.ring[:, None]
        squared = self._squared(queries)
        within = (ring >= queries.lowest) & (ring < queries.lowest + self.cloud_rings) & (nearest >= 0)
        step = jnp.abs(ring - _take(self.index.ring, jnp.maximum(nearest, 0)))
        another = jnp.arange(len(ring), dtype=jnp.int32)[:, None] != nearest
        same = _least(squared, within & (step == 0) & another)
        other = _least(squared, within & (step > 0) & (step < self.rings_apart))
        return (same, other), jnp.ones_like(nearest, bool)

    def _squared(self, queries: Queries) -> Float[Array, "m k"]:
        index = self.index
        squared = queries.away_from((index.x[:, None], index.y[:, None], index.z[:, None]))
        return computed_once(jnp.where(squared < self.radius**2, squared, jnp.inf))


def _least(squared: Float[Array, "m k"], allowed: Bool[Array, "m k"]) -> Int32[Array, " k"]:
    """Return the row of each column's smallest allowed value, -1 where there is no finite one."""
    least = jnp.min(jnp.where(allowed, squared, jnp.inf), 0)
    here = allowed & (squared == least) & jnp.isfinite(least)
    return jnp.max(jnp.where(here, jnp.arange(len(squared), dtype=jnp.int32)[:, None], -1), 0)


class _Windows(eqx.Module):
    """A window of each of a few rings for each query, around its own azimuth."""

    search: _Search
    queries: Queries
    start: Int32[Array, "b k"]
    """Place of the ring's first point."""
    size: Int32[Array, "b k"]
    """The ring's points; 0 beyond the cloud's rings."""
    elevation: Float[Array, "b k"]
    """Elevation of the ring, rad."""
    begin: Int32[Array, "b k"]
    """From ``start`` to the window's first point; negative where the window begins at the ring's end."""
    length: int = eqx.field(static=True)

    @staticmethod
    def of(search: _Search, queries: Queries, ring: Int32[Array, " k"], side: int, length: int) -> "_Windows":
        """Return windows in the rings from ``side`` below a given one to ``side`` above it."""
        index = search.index
        sectors = index.sectors
        band = ring + jnp.arange(-side, side + 1, dtype=jnp.int32)[:, None]
        within = (band >= queries.lowest) & (band < queries.lowest + search.cloud_rings)
        band = jnp.clip(band, 0, len(index.elevation) - 1)
        cell = band * sectors
        start, end = _take(index.first, cell), _take(index.first, cell + sectors)
        size = jnp.where(within, end - start, 0)
        middle = _take(index.first, cell + _sector(azimuth(queries.x, queries.y), sectors)) - start
        begin = middle - jnp.minimum(length, size) // 2
        elevation = _take(index.elevation, band)
        return _Windows(search, queries, *computed_once((start, size, elevation, begin)), length)

    def keys(self) -> Int32[Array, "n k"]:
        """Return the squared distance of each point, the lowest bits replaced by its number.

        The number counts the rings and then the points. As integers, keys are ordered as the distances.
        """
        step = jnp.arange(self.length, dtype=jnp.int32)[:, None, None]
        squared = self.queries.away_from(self.search.index.at(self._place(step, slice(None))))
        # a ring shorter than the window would show its points twice
        squared = jnp.where((step < self.size) & (squared < self.search.radius**2), squared, jnp.inf)
        band = jnp.arange(len(self.size), dtype=jnp.int32)[:, None]
        bits = jax.lax.bitcast_convert_type(squared.astype(jnp.float32), jnp.int32)
        keys = bits & ~self._mask | step * len(self.size) + band
        return keys.reshape(-1, keys.shape[-1])

    def smallest(self, keys: Int32[Array, "n k"], allowed: Bool[Array, "..."]) -> tuple[Array, Array]:
        """Return place and squared distance of each query's nearest point, -1 and infinite without one."""
        key = jnp.min(jnp.where(allowed, keys, jnp.iinfo(jnp.int32).max), 0)
        squared = jax.lax.bitcast_convert_type(key & ~self._mask, jnp.float32)
        number = jnp.minimum(key & self._mask, len(keys) - 1)
        column = jnp.arange(len(key))
        place = self._place(number // len(self.size), (number % len(self.size), column))
        # a key that was not allowed comes out as NaN
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

    def reach(self) -> Float[Array, " k"]:
        """Return a distance within which no point of the rings lies outside of the windows, m."""
        x, y, z = self.queries.x, self.queries.y, self.queries.z
        angle, level = azimuth(x, y), jnp.sqrt(x**2 + y**2)
        sectors = self.search.index.sectors
        own = _sector(angle, sectors)
        ends = (self._place(jnp.int32(step), slice(None)) for step in (0, self.length - 1))
        # within a sector points are in any order, so the first and the last one may not be whole
        first, last = (_sector(_take(self.search.index.azimuth, end), sectors) for end in ends)
        before = jnp.where(first == own, 0.0, _turned(angle - _edge(first + 1, sectors)))
        after = jnp.where(last == own, 0.0, _turned(_edge(last, sectors) - angle))
        gap = jnp.minimum(before, after)
        aside = level * jnp.sin(jnp.minimum(gap, _QUARTER))
        lift = jnp.minimum(jnp.abs(self.elevation - azimuth(level, z)), _QUARTER)
        above = jnp.sqrt(level**2 + z**2) * jnp.sin(lift)
        return jnp.min(jnp.where(self.size > self.length, jnp.maximum(aside, above), jnp.inf), 0)

    @property
    def _mask(self) -> int:
        return (1 << (self.length * len(self.size) - 1).bit_length()) - 1

    def _place(self, step: Array, which: Any) -> Array:
        """Return the place that a step along a ring's window leads to."""
        along, size = self.begin[which] + step, self.size[which]
        along += jnp.where(along < 0, size, jnp.where(along >= size, -size, 0))
        return self.start[which] + jnp.clip(along, 0, jnp.maximum(size - 1, 0))


def _sector(angle: Array, sectors: int) -> Array:
    return jnp.clip(jnp.floor((angle / _TURN + 0.5) * sectors).astype(jnp.int32), 0, sectors - 1)


def _edge(sector: Array, sectors: int) -> Array:
    """Return the azimuth at which a sector begins, rad."""
    return _TURN * (sector.astype(jnp.float32) / sectors - 0.5)


def _turned(angle: Array) -> Array:
    """Return an angle within 0 and one turn; one that rounding has made negative is 0."""
    return jnp.maximum(angle - _TURN * jnp.floor((angle + _ROUNDING) / _TURN), 0.0)


def _take(table: Array, index: Array) -> Array:
    return table.at[index].get(mode="promise_in_bounds")
