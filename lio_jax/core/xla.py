"""How programs are compiled by XLA, and how an intermediate result is kept from being computed twice."""

import gc
import time
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

_Tree = TypeVar("_Tree")


def computed_once(tree: _Tree) -> _Tree:
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


_CPU_OPTIONS: dict[str, bool | str] = {"xla_cpu_use_fusion_emitters": False}
"""XLA's newer emitters of kernels take twice as long, for a step that is no faster."""


def compiled(function: Any, *arguments: Any) -> jax.stages.Compiled:
    """Return the program that a jitted function is for these arguments."""
    # of all that tracing makes nothing is garbage, and looking through it takes a quarter of the time
    collecting = gc.isenabled()
    gc.disable()
    try:
        lowered = function.lower(*arguments)
    finally:
        if collecting:
            gc.enable()
    if jax.default_backend() != "cpu":
        return lowered.compile()
    try:
        return lowered.compile(compiler_options=_CPU_OPTIONS)
    except jax.errors.JaxRuntimeError as error:
        # an XLA that has only the newer ones
        if "No such compile option" not in str(error):
            raise
        return lowered.compile()


class PerShape:
    """A jitted function, compiled by :func:`compiled` once for every shape of its arguments."""

    def __init__(self, jitted: Any) -> None:
        """Keep the function; nothing is compiled yet."""
        self._jitted = jitted
        self._programs: dict[Any, Any] = {}
        self.compile_s = 0.0
        """Time spent on tracing and compiling so far, s."""

    def __len__(self) -> int:
        """Return the number of programs compiled."""
        return len(self._programs)

    def __call__(self, *arguments: Any) -> Any:
        """Run the program for these arguments."""
        key = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(arguments))
        if key not in self._programs:
            start = time.perf_counter()
            self._programs[key] = compiled(self._jitted, *arguments)
            self.compile_s += time.perf_counter() - start
        return self._programs[key](*arguments)
