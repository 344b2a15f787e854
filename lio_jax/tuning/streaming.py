"""A whole recording's objective in constant memory: its gradient, or its values at several vectors at once.

For P parameters, P tangents of the state and of the objective's running sums go through each step by
forward-mode differentiation. The state's map has tangents where the derivative is to go through it.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.core.types import ITERATION_LIMIT, NOT_FINITE, Scan
from lio_jax.core.xla import programs
from lio_jax.recipes.params import RecipeParams as Params
from lio_jax.recipes.transforms import Dual, RecipeLike, batched, push_forward, with_tangents
from lio_jax.run.compiled import Compiled
from lio_jax.run.track import run_steps
from lio_jax.tuning.objectives import Objective, Observed, Observing, TruePose
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


def streaming_gradient(
    recipe: RecipeLike,
    free: ParameterVector,
    objective: Objective,
    x: Array,
    recording: Recording,
    through_map: bool = False,
) -> Gradient:
    """Return an objective and its gradient by forward mode.

    Args:
        recipe: hashable.
        free: the parameters by which to differentiate.
        objective: of the whole recording.
        x: (p,) where.
        recording: run through once.
        through_map: see :func:`lio_jax.recipes.transforms.with_tangents`.
    """
    params = programs(ParameterVector.with_tangents)(free, x)
    arrays, static = split_objective(objective)
    add = programs(_add_with_tangents, static)
    sums = objective.start()
    dots = jax.tree.map(lambda leaf: jnp.zeros((len(x), *leaf.shape), leaf.dtype), sums)
    total = Dual(sums, dots)
    shares, unconverged = [], []
    stepper = Compiled(with_tangents(Observing(recipe), through_map), params)
    for fed, _, seen in run_steps(stepper, recording.scan_inputs()):
        before = total.dot
        total = add(arrays, params, total, seen, fed.scan, recording.truth_at(fed.end_ns))
        shares.append(jax.tree.map(lambda new, old: np.asarray(new) - np.asarray(old), total.dot, before))
        if not_converged(seen.value):
            unconverged.append(fed.index)
    each = jax.tree.map(lambda *rows: np.concatenate(rows), *shares)
    value, slopes = programs(_value_with_tangents, static)(arrays, Dual(total.value, each))
    scores = np.asarray(slopes).reshape(-1, len(x))
    return Gradient(float(value), scores.sum(0), scores, tuple(unconverged))


def objective_values(
    recipe: RecipeLike, free: ParameterVector, objective: Objective, xs: Array, recording: Recording
) -> NDArray[np.float64]:
    """Return an objective at each row of ``xs``, by one program for all of them.

    Args:
        recipe: hashable.
        free: the parameters as functions of a row.
        objective: of the whole recording.
        xs: (n, p).
        recording: run through once.
    """
    params = programs(_params_of_rows)(free, xs)
    arrays, static = split_objective(objective)
    add = programs(_add_of_rows, static)
    total = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(xs), *leaf.shape)), objective.start())
    stepper = Compiled(batched(Observing(recipe)), params)
    for fed, _, seen in run_steps(stepper, recording.scan_inputs()):
        total = add(arrays, params, total, seen, fed.scan, recording.truth_at(fed.end_ns))
    return np.asarray(programs(_value_of_rows, static)(arrays, total))


def not_converged(seen: Observed) -> bool:
    """Return whether a scan's solve ended before it converged."""
    return int(seen.status) in (ITERATION_LIMIT, NOT_FINITE)


def split_objective(objective: Objective) -> tuple[Any, Any]:
    """Return an objective's arrays, which programs take as arguments, and what is static in it."""
    try:
        hash(jax.tree.structure(objective))
    except TypeError:
        return None, objective
    return eqx.partition(objective, eqx.is_array)


def add_scan(
    static: Any, arrays: Any, params: Params, sums: Any, seen: Observed, scan: Scan, truth: TruePose
) -> Any:
    """Return an objective's sums with one more scan; the objective comes in two parts, static and arrays."""
    objective: Objective = eqx.combine(arrays, static)
    return objective.add(sums, seen.with_scan(scan, params), truth)


def value_of(static: Any, arrays: Any, sums: Any) -> Float[Array, ""]:
    """Return an objective's value; the objective comes in two parts, static and arrays."""
    objective: Objective = eqx.combine(arrays, static)
    return objective.value(sums)


def _add_with_tangents(
    static: Any, arrays: Any, params: Dual, sums: Dual, seen: Dual, scan: Scan, truth: TruePose
) -> Dual:
    def add(params: Params, sums: Any, seen: Observed) -> Any:
        return add_scan(static, arrays, params, sums, seen, scan, truth)

    return push_forward(add, params, sums, seen)


def _value_with_tangents(static: Any, arrays: Any, sums: Dual) -> Dual:
    return push_forward(lambda sums: value_of(static, arrays, sums), sums)


def _add_of_rows(
    static: Any, arrays: Any, params: Params, sums: Any, seen: Observed, scan: Scan, truth: TruePose
) -> Any:
    def add(params: Params, sums: Any, seen: Observed) -> Any:
        return add_scan(static, arrays, params, sums, seen, scan, truth)

    return jax.vmap(add)(params, sums, seen)


def _value_of_rows(static: Any, arrays: Any, sums: Any) -> Float[Array, " n"]:
    return jax.vmap(lambda sums: value_of(static, arrays, sums))(sums)


def _params_of_rows(free: ParameterVector, xs: Float[Array, "n p"]) -> Params:
    return jax.vmap(free)(xs)
