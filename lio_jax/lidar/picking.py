"""Pick the sharpest and the flattest points of each sector of each ring, by the sequential rule.

The rule is that of Zhang & Singh, RSS 2014, sections V.A and V.B, in the form of A-LOAM and LIO-SAM. A ring
is cut into sectors, which are visited one after another. In each sector, points are visited by descending
smoothness for corners, and then by ascending smoothness for flat points. A pick suppresses its neighbours on
both sides, also across the sector's end. Equal values are ordered by their place along the ring (a stable
ascending sort, read from its end for corners).

Rings are independent, so the rule runs on all rings at once: each turn picks the maximum of every ring's
sector. Sectors are not independent, so they follow one another. On a CPU a turn over 64 rings takes 10 us. An
argmax, or rings as rows of the array, takes twice as long. To pick all local extremes at once, until none is
left, is not faster in total.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32, Int32

from lio_jax.core.xla import computed_once

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
