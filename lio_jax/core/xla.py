"""How programs are compiled by XLA and kept, how an intermediate result is not computed twice, and how a
table is changed where it lies."""

import gc
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable
from functools import partial, update_wrapper
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32

_Tree = TypeVar("_Tree")


def computed_once(tree: _Tree) -> _Tree:
    """Return ``tree``, computed once and kept in memory.

    XLA's CPU backend fuses a chain of elementwise operations and gathers into each of its uses. So it repeats
    the chain for every column of a result. It ignores optimization barriers, but it does not optimise across
    a conditional whose condition is unknown at compile time. Other backends have barriers; there a
    conditional waits for the host.

    Args:
        tree: a pytree of arrays; its first leaf has at least one element.
    """
    if _platform() != "cpu":
        return jax.lax.optimization_barrier(tree)
    first = jax.tree.leaves(tree)[0].ravel()[0].astype(jnp.float32)
    always = (first < 0) | (first >= 0) | (first != first)
    return jax.lax.cond(
        always, lambda leaves: leaves, lambda leaves: jax.tree.map(jnp.zeros_like, leaves), tree
    )


def _platform() -> str:
    """Return the platform for which programs are compiled, such as "cpu" or "gpu"."""
    chosen: Any = getattr(jax.config, "jax_default_device")  # noqa: B009 -- its type is not declared
    return str(getattr(chosen, "platform", chosen or jax.default_backend()))


_PIECE = 256
"""Number of rows that :func:`added_in_place` adds at a time."""


def added_in_place(
    table: Float[Array, "c w"],
    slots: Int32[Array, " n"],
    change: Float[Array, "n w"],
    total: Int32[Array, ""],
) -> Float[Array, "c w"]:
    """Return the table with the first ``total`` rows of ``change`` added at their slots.

    The table is written where it lies, in as many pieces as there are changes, both here and in the
    transposed function. To JAX this is the solution (table + S change, change) of a linear system, because a
    loop whose length is not known in advance can't be transposed otherwise.

    Args:
        table: c rows.
        slots: where to add each row of ``change``, below c.
        change: n rows, at least one.
        total: number of rows that count, the first ones.
    """
    size = min(_PIECE, len(slots))

    def in_pieces(start: _Tree, piece: Callable[[Array, Array, _Tree], _Tree]) -> _Tree:
        def body(number: Array, carry: _Tree) -> _Tree:
            first = jnp.minimum(number * size, len(slots) - size)
            some = first + jnp.arange(size, dtype=jnp.int32)
            mine = (some >= number * size) & (some < total)
            return piece(
                first, jnp.where(mine, slots.at[some].get(mode="promise_in_bounds"), len(table)), carry
            )

        return jax.lax.fori_loop(0, (total + size - 1) // size, body, start)

    def system(unknown: tuple[Array, Array]) -> tuple[Array, Array]:
        after, change = unknown
        held = jnp.where(jnp.arange(len(slots)) < total, slots, len(table))
        return after.at[held].add(-change, mode="drop"), change

    def solve(_: Any, right: tuple[Array, Array]) -> tuple[Array, Array]:
        change = right[1]

        def add(first: Array, held: Array, table: Array) -> Array:
            return table.at[held].add(jax.lax.dynamic_slice_in_dim(change, first, size), mode="drop")

        return in_pieces(right[0], add), change

    def solve_transposed(_: Any, right: tuple[Array, Array]) -> tuple[Array, Array]:
        after = right[0]

        def add(first: Array, held: Array, change: Array) -> Array:
            more = jax.lax.dynamic_slice_in_dim(change, first, size)
            more += after.at[held].get(mode="fill", fill_value=0.0)
            return jax.lax.dynamic_update_slice_in_dim(change, more, first, 0)

        return after, in_pieces(right[1], add)

    # JAX differentiates and transposes the solution only if neither half is constant or unused
    table = table.at[0].add(0 * change[0])
    after, same = jax.lax.custom_linear_solve(system, (table, change), solve, solve_transposed)
    return after.at[0].add(0 * same[0])


_CPU_OPTIONS: dict[str, bool | str] = {
    "xla_cpu_use_fusion_emitters": False,
    "xla_disable_hlo_passes": "cpu-parallel-task-assigner",
}
"""Options of the CPU backend. XLA's newer kernel emitters compile twice as long, for a step no faster.

XLA would divide among threads each kernel that reads more than some 20 kB or gathers from a large table. A
step has hundreds of such kernels, each of some microseconds, and waking the threads takes longer."""


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
    if _platform() != "cpu":
        return lowered.compile()
    try:
        return lowered.compile(compiler_options=_CPU_OPTIONS)
    except jax.errors.JaxRuntimeError as error:
        # a version of XLA that has only the newer emitters
        if "No such compile option" not in str(error):
            raise
        return lowered.compile()


class PerShape:
    """A jitted function, compiled by :func:`compiled` once for every structure and shape of its arguments."""

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
        """Run the program for these arguments."""
        return self._program(arguments)(*arguments)

    def result(self, *arguments: Any) -> Any:
        """Return the structure of the result, shape and dtype in the place of each array.

        Args:
            arguments: as for a call, or such structures.
        """

        def described(leaf: Any) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, weak_type=leaf.weak_type)

        # without the devices, for which the program would be compiled anew
        return jax.tree.map(described, self._program(arguments).out_info)

    def _program(self, arguments: tuple[Any, ...]) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        key = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        program = self._programs.get(key)
        if program is None:
            start = time.perf_counter()
            program = self._programs[key] = compiled(self._jitted, *arguments)
            self.compile_s += time.perf_counter() - start
        return program

    def forget(self) -> None:
        """Drop the programs; they are compiled anew when they are needed."""
        self._programs.clear()


_MOST_FUNCTIONS = 64
"""A process has room for a limited number of programs: each takes several of its memory mappings."""
_TRACED_BY = "jax_enable_x64", "jax_default_device"
"""Settings of JAX under which the same arguments give another program."""
_functions: OrderedDict[Hashable, PerShape] = OrderedDict()
_lock = threading.Lock()


def programs(function: Callable[..., Any], *static: Any, donate: tuple[int, ...] = ()) -> PerShape:
    """Return the programs of a pure function, kept for the life of the process.

    The same function with equal static arguments gives the same programs. The functions used longest ago are
    forgotten first.

    Args:
        function: of a module or a class, not a closure or a lambda: a new one would have programs of its own.
        static: its first arguments. None of them may change afterwards. One that can't be hashed equals only
            itself.
        donate: positions among the other arguments whose buffers the result may take.
    """
    setting = tuple(getattr(jax.config, name) for name in _TRACED_BY)
    key = (function, *map(_comparable, static), donate, setting)
    with _lock:
        if key not in _functions:
            bound = update_wrapper(partial(function, *static), function)
            _functions[key] = PerShape(jax.jit(bound, donate_argnums=donate))
        _functions.move_to_end(key)
        while len(_functions) > _MOST_FUNCTIONS:
            _functions.popitem(last=False)
        return _functions[key]


def forget_programs() -> None:
    """Drop all programs that :func:`programs` keeps, those in use elsewhere included.

    JAX keeps them too, until ``jax.clear_caches()``.
    """
    with _lock:
        for kept in _functions.values():
            kept.forget()
        _functions.clear()


class _Itself:
    """Equals only another one of the same object."""

    def __init__(self, held: Any) -> None:
        self._held = held

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Itself) and self._held is other._held

    def __hash__(self) -> int:
        return id(self._held)


def _comparable(static: Any) -> Hashable:
    try:
        hash(static)
    except TypeError:
        return _Itself(static)
    return static
