"""What this library asks of XLA: fast compilation of its programs, and intermediate results computed once."""

import gc
import time
from typing import Any, TypeVar

import jax
import jax.numpy as jnp

_Tree = TypeVar("_Tree")


def computed_once(tree: _Tree) -> _Tree:
    """Return ``tree``, computed once and kept in memory.

    XLA's CPU backend fuses a chain of elementwise operations and gathers into each of its uses. So it repeats
    the chain for every column of a result. It ignores optimization barriers, but it does not optimise across
    a conditional whose condition is unknown at compile time.

    Args:
        tree: a pytree of arrays; its first leaf has at least one element.
    """
    first = jax.tree.leaves(tree)[0].ravel()[0].astype(jnp.float32)
    always = (first < 0) | (first >= 0) | (first != first)
    return jax.lax.cond(
        always, lambda leaves: leaves, lambda leaves: jax.tree.map(jnp.zeros_like, leaves), tree
    )


_CPU_OPTIONS: dict[str, bool | str] = {"xla_cpu_use_fusion_emitters": False}
"""Options of the CPU backend: XLA's newer kernel emitters compile twice as long, for a step no faster."""


def compiled(function: Any, *arguments: Any) -> jax.stages.Compiled:
    """Compile a jitted function for the shapes and dtypes of these arguments, and return the program."""
    # tracing makes many objects and no garbage: searching them would take a quarter of the time
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
        # a version of XLA that has only the newer emitters
        if "No such compile option" not in str(error):
            raise
        return lowered.compile()


class PerShape:
    """A jitted function that :func:`compiled` compiles once for each combination of shapes and dtypes."""

    def __init__(self, jitted: Any) -> None:
        """Keep the function; nothing is compiled yet."""
        self._jitted = jitted
        self._programs: dict[Any, Any] = {}
        self.compile_s = 0.0
        """Total time spent on tracing and compiling, s."""

    def __len__(self) -> int:
        """Return the number of programs compiled so far."""
        return len(self._programs)

    def __call__(self, *arguments: Any) -> Any:
        """Run the program for these arguments; compile it first where the shapes or dtypes are new."""
        key = tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(arguments))
        if key not in self._programs:
            start = time.perf_counter()
            self._programs[key] = compiled(self._jitted, *arguments)
            self.compile_s += time.perf_counter() - start
        return self._programs[key](*arguments)
