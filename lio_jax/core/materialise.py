"""Keep XLA from computing an intermediate result once per use."""

from typing import TypeVar

import jax
import jax.numpy as jnp

_Tree = TypeVar("_Tree")


def materialised(tree: _Tree) -> _Tree:
    """Return ``tree``, computed once and kept in memory.

    XLA's CPU backend fuses a chain of elementwise operations and gathers into each of its uses and so repeats
    it for every column of a result; it drops optimization barriers, but does not look through a conditional
    whose condition it can't decide.
    """
    first = jax.tree.leaves(tree)[0].ravel()[0].astype(jnp.float32)
    always = (first < 0) | (first >= 0) | (first != first)
    return jax.lax.cond(
        always, lambda leaves: leaves, lambda leaves: jax.tree.map(jnp.zeros_like, leaves), tree
    )
