"""The same gradient by reverse mode: its cost does not grow with the number of parameters.

The run is taped as a chain of steps; states are kept at every n-th step only and computed anew in between on
the way back (Griewank & Walther, "Revolve", 2000, with one level of checkpoints), so that memory grows with
the number of checkpoints, not with the steps.
"""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from lio_jax.core.types import ImuBatch, Scan
from lio_jax.core.xla import PerShape
from lio_jax.recipes import recipe_named
from lio_jax.recipes.params import RecipeConfig as Config
from lio_jax.run.track import run_steps
from lio_jax.tuning.objectives import Objective, Observed, TruePose
from lio_jax.tuning.parameters import ParameterVector
from lio_jax.tuning.recording import Recording
from lio_jax.tuning.streaming import split_smooth

_KINDS = ("init", "restart", "step")
_SHORTEST = 8
"""Steps between checkpoints at least: the opening, which tries the second scan first, must not be cut."""


@dataclass
class _Operation:
    """One entry of the tape: from the state numbered ``source`` to the state of its own number."""

    kind: str
    source: int
    scan: Scan | None
    imu: ImuBatch | None
    sums: Any
    """The objective's sums before."""
    truth: TruePose | None = None
    """Set where the result entered the objective."""


@dataclass
class _Numbered:
    """A state and its place on the tape."""

    number: int
    state: Any


class CheckpointedGradient:
    """Programs for one recipe, one set of free parameters and one objective; compiled on first use."""

    def __init__(self, recipe: str, config: Config, free: ParameterVector, objective: Objective) -> None:
        """Keep what shapes the programs."""
        module = recipe_named(recipe)(config)
        self.objective = objective

        def forward(kind: str, x: Array, state: Any, scan: Any, imu: Any) -> tuple[Any, Observed | None]:
            if kind == "init":
                return module.init(free(x), imu), None
            if kind == "restart":
                return module.init(free(x), imu).with_velocity_of(state), None
            state, output = module.step(free(x), state, scan, imu)
            return state, Observed.of(state, output)

        def add(x: Array, sums: Any, seen: Observed, scan: Scan, truth: TruePose) -> Any:
            return objective.add(sums, seen.beside(scan, free(x)), truth)

        def backward(
            kind: str, x: Array, state: Any, sums: Any, scan: Any, imu: Any, truth: Any, cotangent: Any
        ) -> tuple[Array, Any, Any]:
            smooth, fixed = (None, None) if state is None else split_smooth(state)

            def smooth_part(x: Array, smooth: Any, sums: Any) -> tuple[Any, Any]:
                old = None if state is None else eqx.combine(smooth, fixed)
                new, seen = forward(kind, x, old, scan, imu)
                if seen is not None and truth is not None:
                    sums = add(x, sums, seen, scan, truth)
                return split_smooth(new)[0], sums

            _, pull = jax.vjp(smooth_part, x, smooth, sums)
            return pull(cotangent)

        self.forward = {kind: PerShape(jax.jit(partial(forward, kind))) for kind in _KINDS}
        self.backward = {kind: PerShape(jax.jit(partial(backward, kind))) for kind in _KINDS}
        self.add = PerShape(jax.jit(add))
        self.value = PerShape(jax.jit(jax.value_and_grad(objective.value)))

    def __call__(
        self, x: NDArray[np.float64] | Array, recording: Recording, every: int | None = None
    ) -> tuple[float, NDArray[np.float64]]:
        """Return the objective and its gradient at a vector of parameters.

        Args:
            x: (p,).
            recording: run through once; its scans are kept until the way back.
            every: steps between checkpoints, at least 8; None: the square root of their number.
        """
        tape = _Tape(self, jnp.asarray(x), max(every or math.isqrt(len(recording)), _SHORTEST))
        for fed, state, seen in run_steps(tape, recording.scan_inputs()):
            tape.count(state, seen, fed.scan, recording.truth_at(fed.end_ns))
        return tape.unwound()


class _Tape:
    """A :class:`lio_jax.run.track.Step` that remembers what it did."""

    def __init__(self, programs: CheckpointedGradient, x: Array, every: int) -> None:
        self._programs, self._x, self._every = programs, x, every
        self._operations: list[_Operation] = []
        self._kept: dict[int, Any] = {}
        self._sums = programs.objective.start()

    def initial_state(self, imu: ImuBatch | None) -> _Numbered:
        return self._done("init", None, None, imu)[0]

    def restarted(self, state: _Numbered, imu: ImuBatch | None) -> _Numbered:
        return self._done("restart", state, None, imu)[0]

    def __call__(self, state: _Numbered, scan: Scan, imu: ImuBatch | None) -> tuple[_Numbered, Any]:
        return self._done("step", state, scan, imu)

    def _done(
        self, kind: str, old: _Numbered | None, scan: Scan | None, imu: ImuBatch | None
    ) -> tuple[_Numbered, Any]:
        number = len(self._operations)
        state, seen = self._programs.forward[kind](self._x, old and old.state, scan, imu)
        self._operations.append(_Operation(kind, old.number if old else -1, scan, imu, self._sums))
        if number % self._every == 0:
            self._kept[number] = old and old.state
        return _Numbered(number, state), seen

    def count(self, state: _Numbered, seen: Observed, scan: Scan, truth: TruePose) -> None:
        """Add the last step to the objective."""
        self._operations[state.number].truth = truth
        self._sums = self._programs.add(self._x, self._sums, seen, scan, truth)

    def unwound(self) -> tuple[float, NDArray[np.float64]]:
        """Return the objective and its gradient, from the tape's end to its start."""
        value, sums_bar = self._programs.value(self._sums)
        x_bar = jnp.zeros_like(self._x)
        state_bar: dict[int, Any] = {}
        for start in sorted(self._kept, reverse=True):
            segment = range(start, min(start + self._every, len(self._operations)))
            states = {self._operations[start].source: self._kept.pop(start)}
            for number in segment:
                one = self._operations[number]
                states[number], _ = self._programs.forward[one.kind](
                    self._x, states[one.source], one.scan, one.imu
                )
            for number in reversed(segment):
                one = self._operations[number]
                bar = state_bar.pop(number, None)
                if bar is None:
                    bar = jax.tree.map(jnp.zeros_like, split_smooth(states[number])[0])
                fed = (one.sums, one.scan, one.imu, one.truth)
                own_bar, source_bar, sums_bar = self._programs.backward[one.kind](
                    self._x, states[one.source], *fed, (bar, sums_bar)
                )
                x_bar += own_bar
                if one.source >= 0:
                    before = state_bar.get(one.source)
                    both = source_bar if before is None else jax.tree.map(jnp.add, before, source_bar)
                    state_bar[one.source] = both
        return float(value), np.asarray(x_bar)
