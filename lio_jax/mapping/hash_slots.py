"""Look-up and claim of slots in a hashed table of fixed capacity whose keys are integer coordinates."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int32

from lio_jax.core.hashing import voxel_hash

WAYS = 2
"""Number of slots that a key may lie in. They are neighbours in memory, so that both are read together."""
FREE = -(2**31)
"""Coordinate of a free slot, which no key has."""


def free_keys(capacity: int) -> Int32[Array, "c 3"]:
    """Return the keys of a table of free slots.

    Args:
        capacity: number of slots, a power of two.
    """
    return jnp.full((capacity, 3), FREE, jnp.int32)


def find_slots(keys: Int32[Array, "c 3"], wanted: Int32[Array, "*b 3"]) -> Int32[Array, "*b"]:
    """Return the slot that holds each wanted key; -1 where no slot does.

    Args:
        keys: the keys in the table's c slots.
        wanted: keys to look up.
    """
    first = _first_slot(keys, wanted)
    slot = jnp.full(wanted.shape[:-1], -1, jnp.int32)
    for way in range(WAYS):
        candidate = first + way
        x, y, z = (_take(keys, (candidate, axis)) == wanted[..., axis] for axis in range(3))
        slot = jnp.where(x & y & z, candidate, slot)
    return slot


def claim_slots(
    keys: Int32[Array, "c 3"], wanted: Int32[Array, "m 3"], mask: Bool[Array, " m"]
) -> tuple[Int32[Array, "c 3"], Int32[Array, " m"]]:
    """Find the slot of each wanted key, and claim a free slot for a key that the table does not hold yet.

    Args:
        keys: the keys in the table's c slots.
        wanted: keys to find or to add; equal keys get the same slot.
        mask: which rows of ``wanted`` are real.

    Returns:
        The table's keys afterwards, and the slot of each wanted key. The slot is -1 for masked rows, and
        where both slots of a key belong to others.
    """
    capacity = keys.shape[0]
    order = jnp.arange(wanted.shape[0], dtype=jnp.int32)
    first = _first_slot(keys, wanted)
    slot = jnp.where(mask, find_slots(keys, wanted), -1)
    for way in range(WAYS):
        candidate = first + way
        asks = mask & (slot < 0) & (_take(keys, (candidate, 0)) == FREE)
        # if several keys ask for one slot, the key in the last row gets it
        claims = jnp.full(capacity, -1, jnp.int32)
        claims = claims.at[jnp.where(asks, candidate, capacity)].max(order, mode="drop")
        winner = _take(claims, candidate)
        same = jnp.all(_take(wanted, jnp.maximum(winner, 0)) == wanted, -1)
        housed = asks & (winner >= 0) & same
        keys = keys.at[jnp.where(housed, candidate, capacity)].set(wanted, mode="drop")
        slot = jnp.where(housed, candidate, slot)
    return keys, slot


def _first_slot(keys: Int32[Array, "c 3"], wanted: Int32[Array, "*b 3"]) -> Int32[Array, "*b"]:
    buckets = keys.shape[0] // WAYS
    return ((voxel_hash(wanted) & jnp.uint32(buckets - 1)) * WAYS).astype(jnp.int32)


def _take(table: Array, index: Array | tuple[Array | int, ...]) -> Array:
    return table.at[index].get(mode="promise_in_bounds")
