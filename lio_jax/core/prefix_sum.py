"""Prefix sums and running counts without a serial loop."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int32

_BLOCK = 32
_ONE_PRODUCT = 64
"""Up to this many rows are summed by a single product."""


def prefix_sum(values: Float[Array, "n *s"]) -> Float[Array, "n *s"]:
    """Return the sum of the rows up to each row, that row included.

    Blocks of rows are summed by a product with a triangular matrix, and the sums of the blocks recursively.

    Args:
        values: n rows, at least one.
    """
    count, *shape = values.shape
    block = count if count <= _ONE_PRODUCT else _BLOCK
    padding = ((0, -count % block), *((0, 0) for _ in shape))
    rows = jnp.pad(values, padding).reshape(-1, block, *shape)
    lower = np.tri(block, dtype=values.dtype)
    sums = jnp.einsum("ij,bj...->bi...", lower, rows, precision=jax.lax.Precision.HIGHEST)
    if len(rows) > 1:
        total = sums[:, -1]
        sums = sums + (prefix_sum(total) - total)[:, None]
    return sums.reshape(-1, *shape)[:count]


def running_count(mask: Bool[Array, " n"]) -> Int32[Array, " n"]:
    """Return how many rows are true up to each row, that row included; exact below 2^24 rows."""
    return prefix_sum(mask.astype(jnp.float32)).astype(jnp.int32)


def counts_before(
    counts: Int32[Array, "rows columns"],
) -> tuple[Int32[Array, "rows columns"], Int32[Array, " columns"]]:
    """Return the sum of the rows before each row, and the sum of all rows.

    This is a loop over the rows. On a CPU it is faster than the logarithmic sweeps of ``jnp.cumsum``.
    """

    def add(before: Array, row: Array) -> tuple[Array, Array]:
        return before + row, before

    total, before = jax.lax.scan(add, jnp.zeros(counts.shape[1], jnp.int32), counts)
    return before, total
