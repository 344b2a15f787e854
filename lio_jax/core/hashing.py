"""Hashes of voxel coordinates."""

import jax.numpy as jnp
from jaxtyping import Array, Int32, UInt32


def voxel_hash(voxel: Int32[Array, "*b 3"]) -> UInt32[Array, "*b"]:
    """Mix integer voxel coordinates into 32 bits.

    Products with large primes (Teschner et al., "Optimized spatial hashing", VMV 2003), then two xor-shift
    rounds so that the low bits, which pick the slot, depend on all bits of the coordinates.
    """
    x, y, z = (voxel[..., axis].astype(jnp.uint32) for axis in range(3))
    h = (x * jnp.uint32(73856093)) ^ (y * jnp.uint32(19349669)) ^ (z * jnp.uint32(83492791))
    h = (h ^ (h >> 15)) * jnp.uint32(0x2C1B3C6D)
    return h ^ (h >> 13)
