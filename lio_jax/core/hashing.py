"""Hashes of voxel coordinates."""

import jax.numpy as jnp
from jaxtyping import Array, Int32, UInt32


def voxel_hash(voxel: Int32[Array, "*b 3"]) -> UInt32[Array, "*b"]:
    """Return a 32-bit hash of integer voxel coordinates.

    The hash is a sum of products with large odd numbers, followed by the finaliser of MurmurHash3. So its low
    bits, which choose the slot, depend on all bits of the coordinates.
    """
    x, y, z = (voxel[..., axis].astype(jnp.uint32) for axis in range(3))
    h = x * jnp.uint32(0x8DA6B343) + y * jnp.uint32(0xD8163841) + z * jnp.uint32(0xCB1AB31F)
    h = (h ^ (h >> 16)) * jnp.uint32(0x85EBCA6B)
    h = (h ^ (h >> 13)) * jnp.uint32(0xC2B2AE35)
    return h ^ (h >> 16)
