"""Control over what XLA computes once and what it computes again."""

from typing import TypeVar

import jax

T = TypeVar("T")


def materialised(values: T) -> T:
    """Return ``values`` written to memory before anything uses them.

    XLA's CPU backend fuses a cheap-looking chain (a hash, a 3x3 inverse) into every element that reads it and
    so computes it once per reader.
    """
    return jax.lax.optimization_barrier(values)
