"""Find the noise of odometry, inertial samples and fixes by the marginal likelihood of a recording."""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from lio_jax.core.types import CONVERGED
from lio_jax.fusion.params import FusionParams
from lio_jax.fusion.problem import FusedStates, Problem
from lio_jax.fusion.solve import negative_log_likelihood, search

NOISES = (
    "odometry.rotation_drift",
    "odometry.translation_drift",
    "odometry.rotation_noise",
    "odometry.translation_noise",
    "imu.gyro_noise",
    "imu.accel_noise",
    "imu.gyro_bias_walk",
    "imu.accel_bias_walk",
)
"""Parameters that are found where there are no fixes; with fixes gps.sigma_scale is found too."""
SCALE = "gps.sigma_scale"
_PRIOR = math.log(100.0)
"""Standard deviation of the logarithm of each parameter about its start: a noise that the recording does not
show keeps its value."""
_FARTHEST = math.log(1e4)
"""Largest change of a logarithm."""
_LONGEST = 4.0
"""Largest change of a logarithm in one step."""


class Tuned(NamedTuple):
    """The noise found."""

    params: FusionParams
    """The parameters with the best likelihood that was seen."""
    states: FusedStates
    """The most probable unknowns for them."""
    history: list[dict[str, float]]
    """Each trial: the value per parameter, and ``negative_log_likelihood``; NaN where a trial failed."""


def read(params: FusionParams, names: Sequence[str]) -> NDArray[np.float64]:
    """Return the values of parameters by their paths."""
    return np.array([float(_at(params, name)) for name in names])


def replaced(params: FusionParams, names: Sequence[str], values: jax.Array) -> FusionParams:
    """Return parameters with the values at the paths replaced, which may be traced."""
    for name, value in zip(names, values, strict=True):
        params = eqx.tree_at(partial(_at, name=name), params, value)
    return params


def _at(params: FusionParams, name: str) -> jax.Array:
    part, leaf = name.split(".")
    value: jax.Array = getattr(getattr(params, part), leaf)
    return value


def tune(
    problem: Problem,
    params: FusionParams,
    states: FusedStates,
    names: Sequence[str] | None = None,
    trials: int = 120,
) -> Tuned:
    """Minimise the negative log-likelihood of the measurements by the logarithms of the noise.

    L-BFGS-B with the gradient at the most probable unknowns of each trial, which starts the next search. A
    trial without a finite likelihood is refused, and the best point seen is returned.

    Args:
        problem: the measurements.
        params: start, priors and calibration.
        states: first guess of the unknowns.
        names: paths of the parameters; None: all noise.
        trials: largest number of evaluations.
    """
    fixed = len(problem.fixes.link) > 0
    names = tuple(names) if names is not None else (*NOISES, *((SCALE,) if fixed else ()))
    start = np.log(read(params, names))
    kernel = params.gps.kernel if fixed else jnp.full_like(params.gps.kernel, jnp.inf)
    most, at_first = jnp.asarray(60, jnp.int32), jnp.asarray(400, jnp.int32)
    # noise that is far off makes the first search long; the later ones begin at its end
    for width in (jnp.full_like(kernel, jnp.inf), kernel) if fixed else (kernel,):
        states = search(problem, params, states, width, at_first)[0]

    @eqx.filter_jit
    def score(problem: Problem, logs: jax.Array, states: FusedStates) -> tuple[jax.Array, jax.Array]:
        def value(logs: jax.Array) -> jax.Array:
            trial = replaced(params, names, jnp.exp(logs))
            return negative_log_likelihood(problem, trial, states, kernel, exact=False)

        return jax.value_and_grad(value)(logs)

    best = (math.inf, start, states)
    history: list[dict[str, float]] = []

    def evaluate(logs: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
        nonlocal best
        trial = replaced(params, names, jnp.exp(jnp.asarray(logs, states.common.dtype)))
        found, status, _, _ = search(problem, trial, best[2], kernel, most)
        scored = score(problem, jnp.asarray(logs, states.common.dtype), found)
        value, gradient = float(scored[0]), np.asarray(scored[1], np.float64)
        good = math.isfinite(value) and bool(np.isfinite(gradient).all()) and int(status) == CONVERGED
        away = (logs - start) / _PRIOR
        history.append(
            dict(zip(names, np.exp(logs).tolist(), strict=True))
            | {"negative_log_likelihood": value if good else math.nan}
        )
        if not good:
            # a wall that leads back: the line search then shortens its step
            back = logs - best[1]
            return _wall(best[0]) + float(back @ back), 2 * back
        value, gradient = value + float(away @ away) / 2, gradient + away / _PRIOR
        if value < best[0]:
            best = (value, logs.copy(), found)
        return value, gradient

    at = start
    left = trials
    while left > 0:
        # boxes around the best point keep a line search from leaping to where nothing converges
        low = np.maximum(at - _LONGEST, start - _FARTHEST)
        high = np.minimum(at + _LONGEST, start + _FARTHEST)
        before = len(history)
        minimize(
            evaluate,
            at,
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(low, high, strict=True)),
            options={"maxfun": left, "ftol": 1e-9, "gtol": 0.05},
        )
        left -= len(history) - before
        inside = bool(((best[1] > low + 1e-9) & (best[1] < high - 1e-9)).all())
        if inside or np.allclose(at, best[1]):
            break
        at = best[1]
    return Tuned(replaced(params, names, jnp.exp(jnp.asarray(best[1]))), best[2], history)


def _wall(best: float) -> float:
    return best + 1e3 if math.isfinite(best) else 1e12
