"""The same gradient by reverse mode: its cost does not grow with the number of parameters.

The run is taped as a chain of steps; states are kept at every n-th step only and computed anew in between on
the way back (Griewank & Walther, "Revolve", 2000, with one level of checkpoints), so that memory grows with
the number of checkpoints, not with the steps.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.core.types import ImuBatch, Scan
from lio_jax.core.xla import programs
from lio_jax.recipes.params import RecipeParams as Params
from lio_jax.recipes.transforms import RecipeLike, split_smooth, with_first_velocity
from lio_jax.run.track import run_steps
from lio_jax.tuning.objectives import Objective, Observed, Observing, TruePose
from lio_jax.tuning.parameters import ParameterVector
from lio_jax.tuning.recording import Recording
from lio_jax.tuning.streaming import add_scan, not_converged, split_objective, value_of


class TotalGradient(NamedTuple):
    """An objective over a recording and its derivative."""

    value: float
    gradient: NDArray[np.float64]
    """(p,) by the vector of :class:`ParameterVector`."""
    unconverged: tuple[int, ...]
    """Scans whose solve did not converge: the derivative is not to be trusted."""


def checkpointed_gradient(
    recipe: RecipeLike,
    free: ParameterVector,
    objective: Objective,
    x: Array,
    recording: Recording,
    every: int | None = None,
    through_map: bool = False,
) -> TotalGradient:
    """Return an objective and its gradient by reverse mode.

    Args:
        recipe: hashable.
        free: the parameters by which to differentiate.
        objective: of the whole recording.
        x: (p,) where.
        recording: run through once; its scans are kept until the way back.
        every: steps between checkpoints; None: the square root of their number.
        through_map: see :func:`lio_jax.recipes.transforms.with_tangents`.
    """
    every = every or max(1, math.isqrt(len(recording)))
    params = free.split(programs(ParameterVector.__call__)(free, x))
    tape = _Tape(Observing(recipe), params, objective, every, through_map)
    unconverged = []
    for fed, state, seen in run_steps(tape, recording.scan_inputs()):
        tape.count(state, seen, fed.scan, recording.truth_at(fed.end_ns))
        if not_converged(seen):
            unconverged.append(fed.index)
    value, params_bar = tape.unwound()
    x_bar = programs(_pull_params)(free, x, params_bar)
    return TotalGradient(value, np.asarray(x_bar), tuple(unconverged))


@dataclass
class _Operation:
    """One entry of the tape; its number is its place there, and that of the state it gave."""

    sources: tuple[int, ...]
    """Numbers of the states it was given: none for a first state, two for a velocity handed over."""
    scan: Scan | None = None
    imu: ImuBatch | None = None
    velocity: NDArray[np.float64] | None = None
    """Of a first state: replaces that of the params."""
    sums: Any = None
    """The objective's sums before."""
    truth: TruePose | None = None
    """Set where the result entered the objective."""


@dataclass
class _Taped:
    """A state and its place on the tape."""

    tape: "_Tape"
    number: int
    state: Any

    def with_velocity_of(self, found: "_Taped") -> "_Taped":
        """Return this first state with the velocity that a later state found."""
        return self.tape.handed_over(self, found)


class _Tape:
    """A :class:`lio_jax.recipes.transforms.Stepper` that remembers what it did."""

    def __init__(
        self,
        recipe: RecipeLike,
        params: tuple[Params, Params],
        objective: Objective,
        every: int,
        through_map: bool,
    ) -> None:
        """Begin a tape.

        Args:
            recipe: its output is what the objective sees.
            params: the leaves that are tuned, and the others.
            objective: of the whole recording.
            every: steps between checkpoints.
            through_map: see :func:`lio_jax.recipes.transforms.with_tangents`.
        """
        self._params, self._every, self._through_map = params, every, through_map
        self._arrays, static = split_objective(objective)
        # unlike a run's, these don't consume the state, which may be a checkpoint
        self._init = programs(type(recipe).init, recipe)
        self._step = programs(type(recipe).step, recipe)
        self._add = programs(add_scan, static)
        self._value = programs(_value_and_slopes, static)
        self._pull_init = programs(_pull_init, recipe, through_map)
        self._pull_step = programs(_pull_step, recipe, static, through_map)
        self._operations: list[_Operation] = []
        self._kept: dict[int, Any] = {}
        self._sums = objective.start()

    def init(self, imu: ImuBatch | None, velocity: NDArray[np.float64] | None = None) -> _Taped:
        """Return the state before the first scan.

        Args:
            imu: samples up to its end, or None.
            velocity: (3,) replaces ``params.initial.velocity``, m/s; None: it holds.
        """
        return self._noted(_Operation((), imu=imu, velocity=velocity), ())[0]

    def step(self, state: _Taped, scan: Scan, imu: ImuBatch | None) -> tuple[_Taped, Observed]:
        """Return the state after a scan and what it leaves to see."""
        number = len(self._operations)
        # what comes after a step needs no state before it
        if number - max(self._kept) >= self._every:
            self._kept[number] = state.state
        return self._noted(_Operation((state.number,), scan, imu, sums=self._sums), (state.state,))

    def handed_over(self, first: _Taped, found: _Taped) -> _Taped:
        """Return a first state with the velocity that a later state found."""
        return self._noted(_Operation((first.number, found.number)), (first.state, found.state))[0]

    def count(self, state: _Taped, seen: Observed, scan: Scan, truth: TruePose) -> None:
        """Add the last step to the objective."""
        self._operations[state.number].truth = truth
        self._sums = self._add(self._arrays, eqx.combine(*self._params), self._sums, seen, scan, truth)

    def unwound(self) -> tuple[float, Params]:
        """Return the objective and its derivative by the tuned leaves, from the tape's end to its start."""
        value, sums_bar = self._value(self._arrays, self._sums)
        params_bar = jax.tree.map(jnp.zeros_like, self._params[0])
        bars: dict[int, Any] = {}
        end = len(self._operations)
        for start in sorted(self._kept, reverse=True):
            segment = self._operations[start:end]
            states = dict.fromkeys(segment[0].sources, self._kept[start])
            for number, one in enumerate(segment, start):
                states[number], _ = self._done(one, tuple(states[source] for source in one.sources))
            for number, one in reversed(list(enumerate(segment, start))):
                bar = bars.pop(number, None)
                if bar is None:
                    bar = jax.tree.map(jnp.zeros_like, split_smooth(states[number], self._through_map)[0])
                given = tuple(states[source] for source in one.sources)
                own, sources, sums_bar = self._pulled(one, given, bar, sums_bar)
                params_bar = jax.tree.map(jnp.add, params_bar, own)
                for source, more in zip(one.sources, sources, strict=True):
                    before = bars.get(source)
                    bars[source] = more if before is None else jax.tree.map(jnp.add, before, more)
            end = start
            del self._kept[start]
        return float(value), params_bar

    def _noted(self, operation: _Operation, given: tuple[Any, ...]) -> tuple[_Taped, Any]:
        number = len(self._operations)
        if not self._kept:
            self._kept[number] = None
        self._operations.append(operation)
        state, seen = self._done(operation, given)
        return _Taped(self, number, state), seen

    def _done(self, operation: _Operation, given: tuple[Any, ...]) -> tuple[Any, Observed | None]:
        """Return the state that an operation gives, and what it leaves to see."""
        params = eqx.combine(*self._params)
        if operation.scan is not None:
            return self._step(params, *given, operation.scan, operation.imu)
        if given:
            first, found = given
            return first.with_velocity_of(found), None
        return self._init(with_first_velocity(params, operation.velocity), operation.imu), None

    def _pulled(
        self, operation: _Operation, given: tuple[Any, ...], bar: Any, sums_bar: Any
    ) -> tuple[Params, tuple[Any, ...], Any]:
        """Return the derivatives by params, by the states given and by the sums before an operation."""
        if operation.scan is not None:
            fed = operation.sums, operation.scan, operation.imu, operation.truth
            own, before, sums_bar = self._pull_step(self._arrays, self._params, *given, *fed, bar, sums_bar)
            return own, (before,), sums_bar
        if given:
            first, found = given
            none = jax.tree.map(jnp.zeros_like, self._params[0])
            return none, _pull_velocity(self._through_map, first, found, bar), sums_bar
        return self._pull_init(self._params, operation.imu, operation.velocity, bar), (), sums_bar


def _pull_params(free: ParameterVector, x: Array, bar: Params) -> Array:
    return jax.vjp(lambda x: free.split(free(x))[0], x)[1](bar)[0]


def _pull_init(
    recipe: RecipeLike,
    through_map: bool,
    params: tuple[Params, Params],
    imu: ImuBatch | None,
    velocity: Float[Array | np.ndarray, "3"] | None,
    bar: Any,
) -> Params:
    tuned, others = params

    def init(tuned: Params) -> Any:
        begun = with_first_velocity(eqx.combine(tuned, others), velocity)
        return split_smooth(recipe.init(begun, imu), through_map)[0]

    return jax.vjp(init, tuned)[1](bar)[0]


def _pull_step(
    recipe: RecipeLike,
    static: Any,
    through_map: bool,
    arrays: Any,
    params: tuple[Params, Params],
    state: Any,
    sums: Any,
    scan: Scan,
    imu: ImuBatch | None,
    truth: TruePose | None,
    bar: Any,
    sums_bar: Any,
) -> tuple[Params, Any, Any]:
    (tuned, others), (smooth, fixed) = params, split_smooth(state, through_map)

    def step(tuned: Params, smooth: Any, sums: Any) -> tuple[Any, Any]:
        whole = eqx.combine(tuned, others)
        new, seen = recipe.step(whole, eqx.combine(smooth, fixed), scan, imu)
        if truth is not None:
            sums = add_scan(static, arrays, whole, sums, seen, scan, truth)
        return split_smooth(new, through_map)[0], sums

    return jax.vjp(step, tuned, smooth, sums)[1]((bar, sums_bar))


def _pull_velocity(through_map: bool, first: Any, found: Any, bar: Any) -> tuple[Any, Any]:
    halves = split_smooth(first, through_map), split_smooth(found, through_map)

    def hand_over(*smooth: Any) -> Any:
        whole = [eqx.combine(own, rest) for own, (_, rest) in zip(smooth, halves, strict=True)]
        return split_smooth(whole[0].with_velocity_of(whole[1]), through_map)[0]

    return jax.vjp(hand_over, *(smooth for smooth, _ in halves))[1](bar)


def _value_and_slopes(static: Any, arrays: Any, sums: Any) -> tuple[Array, Any]:
    return jax.value_and_grad(lambda sums: value_of(static, arrays, sums))(sums)
