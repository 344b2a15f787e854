"""Smoothness of points along a ring, and the corners and flat points that are picked by it."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32, Int32, Shaped

from lio_jax.core.xla import computed_once


def point_smoothness(
    points: tuple[Float32[Array, "k rings"], ...], neighbours: int
) -> Float32[Array, "k rings"]:
    """Return the squared length of the sum of differences to the neighbours along the ring, m^2.

    The value is |sum over j of (p_j - p_i)|^2, over ``neighbours`` points before and as many after. It is the
    curvature of A-LOAM, and that of Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014,
    eq. (1), without the normalisation.

    Args:
        points: coordinates x, y and z, m.
        neighbours: number of neighbours on either side.
    """
    total = jnp.zeros_like(points[0])
    for axis in points:
        total += _bend(axis, neighbours) ** 2
    return total


def range_smoothness(ranges: Float32[Array, "k rings"], neighbours: int) -> Float32[Array, "k rings"]:
    """Return the squared sum of range differences to the neighbours along the ring, m^2 (LIO-SAM).

    Args:
        ranges: m.
        neighbours: number of neighbours on either side.
    """
    return _bend(ranges, neighbours) ** 2


def occluded(
    ranges: Float32[Array, "k rings"],
    column: Int32[Array, "k rings"],
    mask: Bool[Array, "k rings"],
    *,
    step: Float32[Array, ""],
    columns_apart: Float32[Array, ""],
    neighbours: int,
) -> Bool[Array, "k rings"]:
    """Return which points are behind an edge that hides the rest of their surface from the sensor (LIO-SAM).

    If two consecutive points are fewer than ``columns_apart`` columns apart and their ranges differ by more
    than ``step``, the farther one and ``neighbours`` more points on its side are occluded.

    Args:
        ranges: m.
        column: column of the sweep that each point lies in.
        mask: which rows are points.
        step: least difference of the ranges at an edge, m.
        columns_apart: distance of the two points, columns.
        neighbours: number of further points on the side of the farther one.
    """
    close = mask & after_each(mask)
    close &= jnp.abs(after_each(column) - column).astype(jnp.float32) < columns_apart
    further = after_each(ranges) - ranges
    hides_before, hides_after = close & (-further > step), close & (further > step)
    edges = hides_before.astype(jnp.int8) + 2 * hides_after.astype(jnp.int8)
    framed = computed_once(_framed(edges, neighbours + 1))
    hidden = jnp.zeros_like(mask)
    for by in range(neighbours + 1):
        hidden |= _window(framed, by, neighbours + 1) == 1
        hidden |= _window(framed, -by - 1, neighbours + 1) == 2
    return hidden


def parallel_to_beam(ranges: Float32[Array, "k rings"], ratio: Float32[Array, ""]) -> Bool[Array, "k rings"]:
    """Return which points differ in range from both neighbours by more than a share of their range (LIO-SAM).

    Args:
        ranges: m.
        ratio: the share, no unit.
    """
    framed = _framed(ranges, 1)
    limit = ratio * ranges
    before, after = (jnp.abs(_window(framed, by, 1) - ranges) > limit for by in (-1, 1))
    return before & after


def reach(
    connected: Bool[Array, "k rings"], neighbours: int
) -> tuple[Int32[Array, "k rings"], Int32[Array, "k rings"]]:
    """Return the numbers of points before and after a pick that it suppresses, for a pick at each place.

    Args:
        connected: whether suppression passes from a point to the next one.
        neighbours: largest number on either side.
    """
    passes = computed_once(_framed(connected, neighbours))
    before, after = jnp.zeros(connected.shape, jnp.int32), jnp.zeros(connected.shape, jnp.int32)
    for step in reversed(range(neighbours)):
        after = jnp.where(_window(passes, step, neighbours), after + 1, 0)
        before = jnp.where(_window(passes, -step - 1, neighbours), before + 1, 0)
    return before, after


def after_each(values: Shaped[Array, "k rings"]) -> Shaped[Array, "k rings"]:
    """Return the value of the next point along the ring; zero for the last row."""
    return jnp.concatenate([values[1:], jnp.zeros_like(values[:1])])


def _bend(values: Float32[Array, "k rings"], neighbours: int) -> Float32[Array, "k rings"]:
    """Return the sum of the differences to the neighbours, which loses fewer digits than sum - 2 n v."""
    inner = values[neighbours:-neighbours]
    total = jnp.zeros_like(inner)
    for step in range(1, neighbours + 1):
        later, earlier = _window(values, step, neighbours), _window(values, -step, neighbours)
        total += (later - inner) + (earlier - inner)
    return _framed(total, neighbours)


def _framed(values: Shaped[Array, "k rings"], margin: int) -> Shaped[Array, "f rings"]:
    """Return the values with ``margin`` rows of zeros before and after: windows then need no bounds test."""
    return jnp.pad(values, ((margin, margin), (0, 0)))


def _window(framed: Shaped[Array, "f rings"], by: int, margin: int) -> Shaped[Array, "k rings"]:
    """Return the values ``by`` places further along each ring."""
    return jax.lax.slice_in_dim(framed, margin + by, framed.shape[0] - margin + by, axis=0)


_CLOSED = -1
"""Key of a point that cannot be picked any more; the keys of open points are not negative."""


class Picks(eqx.Module):
    """Picked places along the rings, in the order of picking; -1 where there is none."""

    corners: Int32[Array, "c sectors rings"]
    """Places of the corners, up to c in each sector."""
    flats: Int32[Array, "f sectors rings"]
    """Places of the flat points, up to f in each sector."""


class Ring(eqx.Module):
    """The input of the selection for the k places along each ring."""

    smoothness: Float32[Array, "k rings"]
    """Smoothness of each point, m^2: large at corners."""
    open: Bool[Array, "k rings"]
    """True where a point may be picked."""
    before: Int32[Array, "k rings"]
    """Number of points before a pick that it suppresses."""
    after: Int32[Array, "k rings"]
    """Number of points after a pick that it suppresses."""
    neighbours: int = eqx.field(static=True)
    """Upper bound of ``before`` and ``after``."""


def sector_bounds(count: Int32[Array, " rings"], sectors: int, unused: int) -> Int32[Array, "bounds rings"]:
    """Return where each sector starts, and where the last one ends.

    Args:
        count: points along each ring.
        sectors: number of sectors of equal length.
        unused: points at either end of a ring that belong to no sector.
    """
    length = jnp.maximum(count - 2 * unused, 0)
    return unused + length * jnp.arange(sectors + 1, dtype=jnp.int32)[:, None] // sectors


def pick(
    ring: Ring,
    bounds: Int32[Array, "bounds rings"],
    *,
    corner_threshold: Float32[Array, ""],
    flat_threshold: Float32[Array, ""],
    corners: int,
    flats: int | None,
) -> Picks:
    """Pick corners and flat points sector by sector.

    Args:
        ring: smoothness and suppression of the points along each ring.
        bounds: starts of the sectors, see :func:`sector_bounds`.
        corner_threshold: smoothness above which a point may be a corner, m^2.
        flat_threshold: smoothness below which a point may be a flat point, m^2.
        corners: largest number of corners in a sector.
        flats: largest number of flat points in a sector; None: no limit.
    """
    k, rings = ring.smoothness.shape
    width = -(-k // (bounds.shape[0] - 1))
    bits = ring.neighbours.bit_length()
    sharpness = jnp.where(ring.open & (ring.smoothness >= 0), _ordered(ring.smoothness), _CLOSED)
    reach = ring.before << bits | ring.after
    number = jnp.arange(rings, dtype=jnp.int32)
    row = jnp.arange(width, dtype=jnp.int32)[:, None]

    def sector(
        free: Int32[Array, " rings"], ends: tuple[Int32[Array, " rings"], Int32[Array, " rings"]]
    ) -> tuple[Array, tuple[Array, Array]]:
        start, end = ends
        place = start + row
        keys, reached = (
            image.ravel().at[place * rings + number].get(mode="clip") for image in (sharpness, reach)
        )
        keys = jnp.where((place >= free) & (place < end), keys, _CLOSED)
        turns = _Turns(start, row, reached, bits)
        keys, sharp, free = turns.run(keys, free, _ordered(corner_threshold), corners, later_first=True)
        flat = (keys >= 0) & (keys < _ordered(flat_threshold))
        keys = jnp.where(flat, jnp.iinfo(jnp.int32).max - keys, _CLOSED)
        limit = width if flats is None else flats
        _, flattest, free = turns.run(keys, free, jnp.int32(_CLOSED), limit, later_first=False)
        return free, (sharp, flattest)

    _, (sharp, flattest) = jax.lax.scan(sector, jnp.zeros(rings, jnp.int32), (bounds[:-1], bounds[1:]))
    return Picks(jnp.swapaxes(sharp, 0, 1), jnp.swapaxes(flattest, 0, 1))


class _Turns(eqx.Module):
    """One sector of every ring, from which the largest keys are picked in turn."""

    start: Int32[Array, " rings"]
    """Place of the sector's first row along the ring."""
    row: Int32[Array, "w 1"]
    """Number of each row, from 0."""
    reach: Int32[Array, "w rings"]
    """Suppression of a pick at each row, packed as ``before << bits | after``."""
    bits: int = eqx.field(static=True)
    """Number of bits of ``before`` and of ``after``."""

    def run(
        self,
        keys: Int32[Array, "w rings"],
        free: Int32[Array, " rings"],
        above: Int32[Array, ""],
        limit: int,
        later_first: bool,
    ) -> tuple[Int32[Array, "w rings"], Int32[Array, "limit rings"], Int32[Array, " rings"]]:
        """Return the remaining keys, the places of the picks, and the first place that no pick suppresses.

        Args:
            keys: the largest key of a ring is picked if it exceeds ``above``.
            free: first place of each ring that earlier picks do not suppress.
            above: see ``keys``.
            limit: largest number of picks.
            later_first: True: the last of equal keys is picked first. False: the first of them.
        """
        bits, last = self.bits, self.row.shape[0] - 1
        # row, before and after in one number: a single maximum finds them all. A gather by the row would be
        # spread over threads, and waking them takes longer than the work
        ticket = (self.row if later_first else last - self.row) << 2 * bits | self.reach

        def more(turn: tuple[Array, ...]) -> Array:
            return (turn[0] < limit) & turn[-1]

        def one(turn: tuple[Array, ...]) -> tuple[Array, ...]:
            done, keys, picks, free, _ = turn
            # a copy in memory of its own: XLA does not vectorise a loop that reads its own carry
            keys = computed_once(keys)
            best = jnp.max(keys, 0)
            found = best > above
            won = jnp.max(jnp.where(keys == best, ticket, 0), 0)
            row = won >> 2 * bits if later_first else last - (won >> 2 * bits)
            before, after = won >> bits & ((1 << bits) - 1), won & ((1 << bits) - 1)
            near = (self.row >= row - before) & (self.row <= row + after)
            keys = jnp.where(near & found, _CLOSED, keys)
            place = self.start + row
            picks = jax.lax.dynamic_update_index_in_dim(picks, jnp.where(found, place, -1), done, 0)
            free = jnp.where(found, jnp.maximum(free, place + after + 1), free)
            return done + 1, keys, picks, free, jnp.any(found)

        none = jnp.full((limit, keys.shape[1]), -1, jnp.int32)
        begin: tuple[Array, ...] = (jnp.int32(0), keys, none, free, jnp.bool_(True))
        _, keys, picks, free, _ = jax.lax.while_loop(more, one, begin)
        return keys, picks, free


def _ordered(value: Float32[Array, "*s"]) -> Int32[Array, "*s"]:
    """Return the bits of non-negative floats as integers: the order is the same, and a maximum is faster."""
    return jax.lax.bitcast_convert_type(jnp.maximum(value, 0.0), jnp.int32)
