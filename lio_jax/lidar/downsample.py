"""Thin a scan to about one point per voxel, without sorting."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.hashing import voxel_hash
from lio_jax.core.prefix_sum import running_count


class Selection(eqx.Module):
    """Indices into a scan, padded to a capacity."""

    index: Int32[Array, " k"]
    mask: Bool[Array, " k"]
    dropped: Int32[Array, ""]
    """Occupied cells that found no room in the capacity."""


def select_per_voxel(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], voxel_size: Float[Array, ""], capacity: int
) -> Selection:
    """Select at most one point of each cubic voxel, at most ``capacity`` in all.

    Every point writes a scrambled copy of its index into the slot its voxel hashes to and the largest one
    stays, so which point represents a voxel is a fixed pseudo-random choice. Two voxels that share a slot
    lose one of them, and slots beyond the capacity are cut off; both thin the scan evenly over space, because
    slots are hashes. Indices carry no gradient.

    Args:
        points: m, any frame.
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
    """Permute 0 .. 2^24 - 1 (odd multiplier modulo a power of two)."""
    return (index * jnp.uint32(_FACTOR)) & jnp.uint32(_MASK)


def _unscramble(ticket: Array) -> Array:
    return (ticket * jnp.uint32(_INVERSE)) & jnp.uint32(_MASK)
