"""Thin a scan: one point a voxel, the mean of the points in it, or the mean per ring and voxel."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.geometry import dot3
from lio_jax.core.hashing import voxel_hash
from lio_jax.core.prefix_sum import counts_before, running_count
from lio_jax.core.types import Scan
from lio_jax.core.xla import computed_once
from lio_jax.lidar.params import LidarParams


class Selection(eqx.Module):
    """Indices into a scan, padded to a capacity k."""

    index: Int32[Array, " k"]
    """Row of each selected point; 0 on padding."""
    mask: Bool[Array, " k"]
    """True where an index is real, False on padding."""
    dropped: Int32[Array, ""]
    """Number of occupied slots beyond the capacity."""


def select_per_voxel(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], voxel_size: Float[Array, ""], capacity: int
) -> Selection:
    """Select at most one point of each cubic voxel, and at most ``capacity`` points.

    Every point writes a permuted copy of its index into the slot of its voxel's hash, and the largest one
    stays. So the choice of a voxel's point is pseudo-random and repeatable. Of two voxels that share a slot
    only one is represented, and slots beyond the capacity are dropped. Both thin the scan evenly over space,
    because slots are hashes. The indices have no derivative.

    Args:
        points: m, any frame; at most 2^24 rows.
        mask: which rows are real.
        voxel_size: edge length, m.
        capacity: number of returned indices.
    """
    table_size = 1 << (4 * capacity - 1).bit_length()
    voxel = jnp.floor(points / voxel_size.astype(points.dtype)).astype(jnp.int32)
    slot = jnp.where(mask, voxel_hash(voxel) & jnp.uint32(table_size - 1), table_size).astype(jnp.int32)
    ticket = _scramble(jnp.arange(points.shape[0], dtype=jnp.uint32)).astype(jnp.int32)
    winner = jnp.full(table_size, -1, jnp.int32).at[slot].max(ticket, mode="drop")
    occupied = winner >= 0
    rank = running_count(occupied) - 1
    target = jnp.where(occupied, rank, capacity)
    chosen = jnp.full(capacity, -1, jnp.int32).at[target].set(winner, mode="drop")
    found = rank[-1] + 1
    return Selection(
        index=jnp.where(chosen >= 0, _unscramble(chosen.astype(jnp.uint32)), 0).astype(jnp.int32),
        mask=chosen >= 0,
        dropped=jnp.maximum(found - capacity, 0),
    )


_BITS = 24
_MASK = (1 << _BITS) - 1
_FACTOR = 0x9E3779 | 1
_INVERSE = pow(_FACTOR, -1, 1 << _BITS)


def _scramble(index: Array) -> Array:
    """Return a permutation of 0 .. 2^24 - 1: the product with an odd number modulo a power of two."""
    return (index * jnp.uint32(_FACTOR)) & jnp.uint32(_MASK)


def _unscramble(ticket: Array) -> Array:
    return (ticket * jnp.uint32(_INVERSE)) & jnp.uint32(_MASK)


class ThinnedScan(eqx.Module):
    """A scan's points for the map, and which of them are matched against it."""

    points: Float[Array, "m 3"]
    """Corrected coordinates in the lidar frame at the firing time of each point, m."""
    time: Float[Array, " m"]
    """Firing time from the scan's start, s."""
    mask: Bool[Array, " m"]
    """True where a point is real, False on padding."""
    matched: Selection
    """Rows of ``points`` that are matched against the map."""
    dropped: Int32[Array, ""]
    """Number of occupied slots beyond the two capacities."""


def thinned(
    lidar: LidarParams,
    scan: Scan,
    map_spacing: Float[Array, ""],
    registration_spacing: Float[Array, ""],
    insertion_points: int,
    registration_points: int,
) -> ThinnedScan:
    """Return the scan within its range limits, thinned to the spacings of map and registration.

    The points are chosen as they were measured, and then corrected.

    Args:
        lidar: ``min_range`` and ``max_range``, and the corrections of the points.
        scan: padded sweep.
        map_spacing: edge of the voxels from which one point enters the map, m.
        registration_spacing: edge of the voxels from which one point is matched, m.
        insertion_points: capacity for the points of the map.
        registration_points: capacity for the points to match.
    """
    squared_range = dot3(scan.points, scan.points)
    near, far = lidar.min_range.astype(jnp.float32), lidar.max_range.astype(jnp.float32)
    mask = scan.mask & (squared_range > near**2) & (squared_range < far**2)
    chosen = select_per_voxel(scan.points, mask, map_spacing, insertion_points)
    # a value that is not finite in an empty row would make the derivatives of masked sums NaN
    points = jnp.where(chosen.mask[:, None], scan.points[chosen.index], 0.0)
    matched = select_per_voxel(points, chosen.mask, registration_spacing, registration_points)
    return ThinnedScan(
        points=lidar.corrected(points, scan.ring[chosen.index]),
        time=scan.time[chosen.index],
        mask=chosen.mask,
        matched=matched,
        dropped=chosen.dropped + matched.dropped,
    )


def rows_of(thin: ThinnedScan, marks: Bool[Array, " k"]) -> Bool[Array, " m"]:
    """Return the marks of the k points to match as marks of all points of the thinned scan."""
    chosen = thin.matched
    rows = jnp.where(chosen.mask & marks, chosen.index, len(thin.mask))
    return jnp.zeros_like(thin.mask).at[rows].set(True, mode="drop")


class MeanPoints(eqx.Module):
    """One mean point per occupied voxel, padded to k, the real ones first."""

    points: Float[Array, "k 3"]
    """Mean point, m, in the frame of the input."""
    time: Float[Array, " k"] | None
    """Mean time, s; None where the points have no time."""
    mask: Bool[Array, " k"]
    """True where a row is real, False on padding."""
    dropped: Int32[Array, ""]
    """Number of occupied slots beyond the capacity."""


def mean_per_voxel(
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    voxel_size: Float32[Array, ""],
    capacity: int,
    time: Float[Array, " n"] | None = None,
) -> MeanPoints:
    """Return the mean of each cubic voxel's points, for at most ``capacity`` voxels.

    Voxels are hashed into slots. Of two voxels that share a slot one is left out, and slots beyond the
    capacity are dropped. Both thin the scan evenly over space, because slots are hashes.

    Args:
        points: m, any frame.
        mask: which rows are real.
        voxel_size: edge length, m.
        capacity: number of returned rows.
        time: time of each point, s, to be averaged as well; None: the points have no time.
    """
    table_size = 1 << (4 * capacity - 1).bit_length()
    voxel = jnp.floor(jnp.where(mask[:, None], points, 0.0) / voxel_size).astype(jnp.int32)
    slot = jnp.where(mask, voxel_hash(voxel) & jnp.uint32(table_size - 1), table_size).astype(jnp.int32)
    order = jnp.arange(points.shape[0], dtype=jnp.int32)
    last = jnp.full(table_size, -1, jnp.int32).at[slot].max(order, mode="drop")
    rank = running_count(last >= 0) - 1
    row, winner = (table.at[slot].get(mode="clip") for table in (rank, last))
    x, y, z = (voxel[:, axis] == voxel[jnp.maximum(winner, 0), axis] for axis in range(3))
    row = computed_once(jnp.where(mask & x & y & z & (row < capacity), row, capacity))
    count = jnp.zeros(capacity, points.dtype).at[row].add(1.0, mode="drop")

    def mean(values: Array) -> Array:
        return jnp.zeros(capacity, values.dtype).at[row].add(values, mode="drop") / jnp.maximum(count, 1.0)

    means = jnp.zeros((capacity, 3), points.dtype)
    for axis in range(3):
        means = means.at[:, axis].set(mean(points[:, axis]))
    times = None if time is None else mean(time)
    return MeanPoints(means, times, count > 0, jnp.maximum(rank[-1] + 1 - capacity, 0))


class RingMeans(eqx.Module):
    """One row per ring and occupied voxel, padded to m."""

    points: Float32[Array, "m 3"]
    """Mean point, m, in the frame of the input."""
    time: Float32[Array, " m"]
    """Mean time, s."""
    ring: Int32[Array, " m"]
    """Number of the ring."""
    mask: Bool[Array, " m"]
    """True where a row is real, False on padding."""
    dropped: Int32[Array, ""]
    """Number of rows beyond the capacity."""


def mean_per_ring_and_voxel(
    xyz: tuple[Float32[Array, "k rings"], Float32[Array, "k rings"], Float32[Array, "k rings"]],
    time: Float32[Array, "k rings"],
    mask: Bool[Array, "k rings"],
    voxel_size: Float32[Array, ""],
    capacity: int,
) -> RingMeans:
    """Return the mean point and time of each ring in each cubic voxel, ring after ring.

    If there are more rows than ``capacity``, they are thinned evenly.

    Args:
        xyz: coordinates x, y and z in any frame, m; finite where the mask is true.
        time: time of each point, s.
        mask: which points are real.
        voxel_size: edge length, m.
        capacity: number of returned rows.
    """
    k, rings = mask.shape
    x, y, z = (jnp.floor(axis / voxel_size).astype(jnp.int32) for axis in xyz)
    first = _first_of_voxel((x, y, z), mask)
    leads = (first == jnp.arange(k * rings, dtype=jnp.int32)).reshape(k, rings)
    before, count = counts_before(leads.astype(jnp.int32))
    rank = (before + jnp.cumsum(count, dtype=jnp.int32) - count).astype(jnp.float32)
    share = jnp.minimum(capacity / jnp.sum(count, dtype=jnp.int32).astype(jnp.float32), 1.0)
    row = jnp.floor(rank * share)
    kept = leads & (jnp.floor((rank - 1) * share) < row)
    row = computed_once(jnp.where(kept, row.astype(jnp.int32), capacity).ravel())
    target = row.at[first].get(mode="fill", fill_value=capacity)
    ring = jnp.broadcast_to(jnp.arange(rings, dtype=jnp.float32), mask.shape)
    terms = jnp.stack([*xyz, time, ring, jnp.ones_like(time)], -1).reshape(k * rings, 6)
    total = jnp.zeros((capacity, 6), jnp.float32).at[target].add(terms, mode="drop")
    number = total[:, 5]
    mean = total[:, :5] / jnp.maximum(number, 1.0)[:, None]
    return RingMeans(
        points=mean[:, :3],
        time=mean[:, 3],
        ring=jnp.round(mean[:, 4]).astype(jnp.int32),
        mask=number > 0,
        dropped=jnp.sum(leads & ~kept, dtype=jnp.int32),
    )


def _first_of_voxel(
    voxel: tuple[Int32[Array, "k rings"], Int32[Array, "k rings"], Int32[Array, "k rings"]],
    mask: Bool[Array, "k rings"],
) -> Int32[Array, " c"]:
    """Return for each point the first point of its ring in its voxel; k * rings where there is no point.

    Each ring has its own hash table. Points whose slot belongs to another voxel try again with another hash,
    until all have a slot: about three rounds. Two voxels in one slot are distinguished by 32 bits of their
    coordinates, which repeat every 2048 voxels in x and y and every 1024 in z.
    """
    k, rings = mask.shape
    cells, slots = k * rings, 1 << k.bit_length()
    cell = jnp.arange(cells, dtype=jnp.int32)
    x, y, z = (axis.astype(jnp.uint32) for axis in voxel)
    name = (x % 2048 << 21) | (y % 2048 << 10) | z % 1024
    name, mixed = name.ravel(), voxel_hash(jnp.stack(voxel, -1)).ravel()

    def one(turn: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        first, unsettled, salt = turn
        slot = (((mixed * salt) >> 8) % slots).astype(jnp.int32) * rings + cell % rings
        slot = jnp.where(unsettled, slot, slots * rings)
        winner = jnp.full(slots * rings, cells, jnp.int32).at[slot].min(cell, mode="drop")
        winner = winner.at[slot].get(mode="clip")
        settled = unsettled & (name.at[winner].get(mode="clip") == name)
        return jnp.where(settled, winner, first), unsettled & ~settled, salt * jnp.uint32(0x9E3779B1)

    none = jnp.full(cells, cells, jnp.int32)
    start = (none, mask.ravel(), jnp.uint32(0x9E3779B1))
    return jax.lax.while_loop(lambda turn: jnp.any(turn[1]), one, start)[0]
