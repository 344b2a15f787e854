"""Matrices from blocks, each at its place."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def from_blocks(
    shape: tuple[int, int], *blocks: tuple[slice, slice, Float[Array, "r c"]]
) -> Float[Array, "n m"]:
    """Return the matrix that is zero but for the given blocks; those that overlap add up.

    All of it is one kernel, where setting block after block compiles a kernel for each.

    Args:
        shape: of the matrix.
        blocks: rows, columns and what stands there; all of one dtype.
    """
    padded = []
    for rows, columns, block in blocks:
        places = [place.indices(size)[:2] for place, size in zip((rows, columns), shape, strict=True)]
        margins = [(start, size - stop, 0) for (start, stop), size in zip(places, shape, strict=True)]
        padded.append(jax.lax.pad(block, jnp.zeros((), block.dtype), margins))
    return sum(padded[1:], padded[0])
