"""Counts before each row, down the columns of a table."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int32


def counts_before(
    counts: Int32[Array, "rows columns"],
) -> tuple[Int32[Array, "rows columns"], Int32[Array, " columns"]]:
    """Return the sum of the rows before each row, and the sum of all rows.

    A loop over the rows: on a CPU faster than the logarithmic sweeps ``jnp.cumsum`` compiles to.
    """

    def add(before: Array, row: Array) -> tuple[Array, Array]:
        return before + row, before

    total, before = jax.lax.scan(add, jnp.zeros(counts.shape[1], jnp.int32), counts)
    return before, total
