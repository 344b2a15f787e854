"""Gradients of a whole recording's objective in constant memory: tangents travel along from scan to scan.

For P parameters, P tangents of the state (without the map, which is a constant of the derivative) and of the
objective's running sums go through each step by forward-mode differentiation. Solves are differentiated
implicitly, so that a tangent costs no iterations (:mod:`lio_jax.core.implicit`).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from numpy.typing import NDArray

from lio_jax.core.status import ITERATION_LIMIT, NOT_FINITE
from lio_jax.core.types import ImuBatch, NavState, Scan
from lio_jax.core.xla import PerShape
from lio_jax.recipes import recipe_named
from lio_jax.recipes.params import RecipeConfig as Config
from lio_jax.run.track import run_steps
from lio_jax.tuning.objectives import Objective, Observed, TruePose
from lio_jax.tuning.parameters import ParameterVector
from lio_jax.tuning.recording import Recording


class Gradient(NamedTuple):
    """An objective over a recording and its derivative."""

    value: float
    gradient: NDArray[np.float64]
    """(p,) by the vector of :class:`ParameterVector`."""
    scores: NDArray[np.float64]
    """(n, p) each scan's share of the gradient."""
    unconverged: tuple[int, ...]
    """Scans whose solve did not converge: the derivative is not to be trusted."""


class _Moving(NamedTuple):
    """A state and the derivatives, P along the first axis, of what in it is smooth."""

    state: Any
    dot: Any

    @property
    def nav(self) -> NavState:
        return self.state.nav


class StreamingGradient:
    """Programs for one recipe, one set of free parameters and one objective; compiled on first use."""

    def __init__(self, recipe: str, config: Config, free: ParameterVector, objective: Objective) -> None:
        """Keep what shapes the programs."""
        self.free = free
        self.objective = objective
        self._steps = _TangentSteps(recipe, config, free)
        self._add = PerShape(jax.jit(self._add_with_tangents))
        self._pushed_value = PerShape(jax.jit(self._value_with_tangents))

    def __call__(self, x: NDArray[np.float64] | Array, recording: Recording) -> Gradient:
        """Return the objective and its gradient at a vector of parameters."""
        x = jnp.asarray(x)
        sums = self.objective.start()
        sums_dot = jax.tree.map(lambda leaf: jnp.zeros((len(x), *leaf.shape), leaf.dtype), sums)
        shares, unconverged = [], []
        for fed, _, (seen, seen_dot) in run_steps(self._steps.at(x), recording.scan_inputs()):
            before = sums_dot
            truth = recording.truth_at(fed.end_ns)
            sums, sums_dot = self._add(x, sums, sums_dot, seen, seen_dot, fed.scan, truth)
            shares.append(jax.tree.map(lambda new, old: np.asarray(new) - np.asarray(old), sums_dot, before))
            if int(seen.status) in (ITERATION_LIMIT, NOT_FINITE):
                unconverged.append(fed.index)
        value, scores = self._pushed_value(sums, jax.tree.map(lambda *each: np.concatenate(each), *shares))
        scores = np.asarray(scores).reshape(-1, len(x))
        return Gradient(float(value), scores.sum(0), scores, tuple(unconverged))

    def _add_with_tangents(
        self, x: Array, sums: Any, sums_dot: Any, seen: Observed, seen_dot: Any, scan: Scan, truth: TruePose
    ) -> tuple[Any, Any]:
        smooth, fixed = eqx.partition(seen, eqx.is_inexact_array)

        def add(x: Array, sums: Any, smooth: Any) -> tuple[Any, None]:
            seen = eqx.combine(smooth, fixed).beside(scan, self.free(x))
            return self.objective.add(sums, seen, truth), None

        tangents = jnp.eye(len(x), dtype=x.dtype), sums_dot, seen_dot
        sums, _, sums_dot = push_forward(add, (x, sums, smooth), tangents)
        return sums, sums_dot

    def _value_with_tangents(self, sums: Any, dots: Any) -> tuple[Array, Array]:
        value, _, slopes = push_forward(lambda sums: (self.objective.value(sums), None), (sums,), (dots,))
        return value, slopes


class _TangentSteps:
    """A recipe's programs with tangents."""

    def __init__(self, recipe: str, config: Config, free: ParameterVector) -> None:
        module = recipe_named(recipe)(config)

        def first(x: Array, imu: ImuBatch | None) -> _Moving:
            def start(x: Array) -> tuple[Any, Any]:
                return split_smooth(module.init(free(x), imu))

            return _moving(push_forward(start, (x,), (jnp.eye(len(x), dtype=x.dtype),)))

        def step(x: Array, moving: _Moving, scan: Scan, imu: ImuBatch | None) -> tuple[_Moving, Any]:
            smooth, fixed = split_smooth(moving.state)

            def forward(x: Array, smooth: Any) -> tuple[Any, Any]:
                state, output = module.step(free(x), eqx.combine(smooth, fixed), scan, imu)
                smooth, rest = split_smooth(state)
                seen, unseen = eqx.partition(Observed.of(state, output), eqx.is_inexact_array)
                return (smooth, seen), (rest, unseen)

            (smooth, seen), (rest, unseen), (dot, seen_dot) = push_forward(
                forward, (x, smooth), (jnp.eye(len(x), dtype=x.dtype), moving.dot)
            )
            return _Moving(eqx.combine(smooth, rest), dot), (eqx.combine(seen, unseen), seen_dot)

        self.init = PerShape(jax.jit(first))
        self.step = PerShape(jax.jit(step, donate_argnums=1))

    def at(self, x: Array) -> "_StepAt":
        """Return the programs at a vector of parameters."""
        return _StepAt(self, x)


class _StepAt:
    """A :class:`lio_jax.run.track.Step` whose state carries its tangents."""

    def __init__(self, programs: _TangentSteps, x: Array) -> None:
        self._programs, self._x = programs, x

    def initial_state(self, imu: ImuBatch | None) -> _Moving:
        return self._programs.init(self._x, imu)

    def restarted(self, state: _Moving, imu: ImuBatch | None) -> _Moving:
        fresh = self.initial_state(imu)
        return _Moving(fresh.state.with_velocity_of(state.state), fresh.dot.with_velocity_of(state.dot))

    def __call__(self, state: _Moving, scan: Scan, imu: ImuBatch | None) -> tuple[_Moving, Any]:
        return self._programs.step(self._x, state, scan, imu)


def push_forward(
    function: Callable[..., tuple[Any, Any]], primals: tuple, tangents: tuple
) -> tuple[Any, Any, Any]:
    """Return ``function(*primals)``, a pair (value, rest), and the value's P derivatives.

    Args:
        function: smooth in its arguments, as far as the value goes.
        primals: its arguments.
        tangents: of the arguments, P along the first axis.
    """

    def along(*tangent: Any) -> tuple[Any, Any, Any]:
        value, dot, rest = jax.jvp(function, primals, tangent, has_aux=True)
        return value, rest, dot

    return jax.vmap(along, out_axes=(None, None, 0))(*tangents)


def split_smooth(state: Any) -> tuple[Any, Any]:
    """Return what is smooth in a state, and the map and all that is counted or chosen."""
    outside = eqx.tree_at(lambda tree: tree.map, jax.tree.map(eqx.is_inexact_array, state), False)
    return eqx.partition(state, outside)


def _moving(result: tuple[Any, Any, Any]) -> _Moving:
    smooth, rest, dot = result
    return _Moving(eqx.combine(smooth, rest), dot)
