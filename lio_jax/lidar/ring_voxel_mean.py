"""Average the points of each ring in each voxel, exactly, without sorting."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32, Int32

from lio_jax.core.hashing import voxel_hash
from lio_jax.core.prefix_sum import counts_before
from lio_jax.core.xla import computed_once


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
