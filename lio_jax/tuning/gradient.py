"""The gradient of a recording's objective in one line, and of the mean over several recordings."""

import math
from collections.abc import Sequence as Listing
from dataclasses import dataclass
from typing import Literal

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.recipes import recipe_named
from lio_jax.recipes.params import RecipeConfig as Config
from lio_jax.run.fitted_settings import ring_count
from lio_jax.run.run import settings_for
from lio_jax.settings.settings import Settings, recipe_of, recipe_settings
from lio_jax.tuning.corrected import CorrectedLoss, free_of_back_end, names_back_end
from lio_jax.tuning.evaluated import Evaluated
from lio_jax.tuning.objectives import Named, Objective, as_named, nothing_counts, nothing_depends
from lio_jax.tuning.parameters import ParameterVector, free_parameters
from lio_jax.tuning.recording import Recording
from lio_jax.tuning.reverse import TotalGradient, checkpointed_gradient
from lio_jax.tuning.streaming import Gradient, objective_values, streaming_gradient

Mode = Literal["auto", "forward", "reverse"]
"""How a derivative is taken."""


@dataclass(frozen=True)
class NamedGradient:
    """An objective's value and its derivatives by name."""

    value: float
    gradient: dict[str, float]
    """By the logarithm of positive parameters, by the others themselves (m, rad, s)."""
    unconverged: tuple[int, ...]
    """Scans whose solve did not converge: the derivative is not to be trusted."""
    through_map: bool
    """Whether the derivative goes through the map; False: the map was a constant of it."""


def gradient(
    sequence: Sequence,
    patterns: Listing[str],
    objective: str | Objective = "noise",
    settings: Settings | None = None,
    truth: Trajectory | None = None,
    start: int = 0,
    count: int | None = None,
    mode: Mode = "auto",
    through_map: bool | None = None,
) -> NamedGradient:
    """Return the objective of a recording and its gradient.

    The first call compiles; others with the same recipe, config, parameters' names and objective do not, in
    the same process.

    With parameters of the back end (``loop.*``, ``gps.*``, ``backend.*``) it is that of the trajectory after
    loops and GPS, and ``marginal`` is that of the pose graph. The odometry and the choices of the back end
    are then constants, and ``mode`` and ``through_map`` have no effect.

    Args:
        sequence: the recording.
        patterns: parameters by name or glob, such as ``imu.*_noise``.
        objective: by name (see :mod:`lio_jax.tuning.objective_names`), a sum of them, or one's own.
        settings: recipe, config and params; None: the default recipe's.
        truth: in place of the recording's own.
        start: first scan.
        count: number of scans; None: to the end.
        mode: forward: constant memory, time grows with the number of parameters; reverse: time does not grow
            with it, memory grows with the number of scans, all of which are kept, and the programs take about
            ten times as long to compile; auto: reverse where there are more than 32 parameters. A parameter
            with n numbers, such as a network's weights, counts n times.
        through_map: whether the map moves with the poses at which its points were inserted, which costs time
            and memory: per parameter 40 bytes for each slot of a voxel map, and 324 bytes for each block of a
            map of points, of which loam and lio_sam have two; None: where :func:`wants_map` says so.

    Raises:
        UsageError: a parameter, an objective or a mode is not known, or can't be differentiated.
        LioJaxError: the objective is a likelihood and does not depend on the parameters, or the pose graph
            has no unique solution.
    """
    if mode not in ("auto", "forward", "reverse"):
        raise UsageError(f"mode '{mode}' is not known; there are: auto, forward, reverse.")
    resolved, _ = settings_for(sequence, settings or recipe_settings("default"))
    named = as_named(objective)
    if names_back_end(patterns, resolved):
        free = free_of_back_end(resolved, patterns, named)
        recording = Recording(sequence, resolved, start, count, truth, keep=False)
        found = CorrectedLoss(resolved, free, named.objective)(np.asarray(free.first()), [recording])
        if not math.isfinite(found.value):
            raise LioJaxError(
                f"{recording.name}: the objective is not finite, because the pose graph has no unique "
                "solution with these parameters; check them with lio-jax run."
            )
        if named.likelihood and not found.gradient.any():
            raise nothing_depends(free.names)
        return NamedGradient(found.value, _by_name(free, found.gradient), (), False)
    free = free_parameters(resolved.params(), list(patterns), lambda: ring_count(sequence.scans()))
    recipe = recipe_of(resolved)
    through_map = wants_map(named, free) if through_map is None else through_map
    recording = Recording(sequence, resolved, start, count, truth, keep=False)
    forward = mode == "forward" or (mode == "auto" and len(free.names) <= _MOST_FORWARD)
    differentiate = streaming_gradient if forward else checkpointed_gradient
    result = differentiate(recipe, free, named.objective, free.first(), recording, through_map=through_map)
    if named.likelihood and not result.gradient.any():
        raise nothing_counts(len(recording))
    return NamedGradient(result.value, _by_name(free, result.gradient), result.unconverged, through_map)


def _by_name(free: ParameterVector, gradient: NDArray[np.float64]) -> dict[str, float]:
    return dict(zip(free.names, gradient.tolist(), strict=True))


def wants_map(named: Named, free: ParameterVector) -> bool:
    """Return whether a derivative is wrong as long as the map is a constant of it.

    It is for trajectory errors, the blur of the map and all derivatives by extrinsics and by corrections of
    the points. It is not for likelihoods by noise densities and weights: ``python
    experiments/gradient_check.py`` compares both with the slope of the objective.

    Args:
        named: the objective.
        free: the parameters.
    """
    return not named.likelihood or any(one.moves_points for one in free.declared)


_MOST_FORWARD = 32
"""Number of parameters up to which forward mode is taken, whatever they are.

The cost of a tangent hardly depends on its parameter: in the default recipe the weights of a network behind
the range noise cost as much as the noise densities. From about 12 numbers on, reverse mode takes less time a
scan in small scans, and from about 30 on in large ones. Forward mode compiles in a tenth of the time.
"""


class Loss:
    """Mean objective over recordings, weighted by their numbers of scans.

    Its gradient is by forward mode, or by reverse mode where that is wanted, or where there are so many
    parameters that this is faster and nobody needs the scores.
    """

    def __init__(
        self,
        recipe: str,
        config: Config,
        free: ParameterVector,
        objective: Objective,
        through_map: bool = False,
        scores: bool = True,
        mode: Mode = "auto",
    ) -> None:
        """Keep what the loss is of, whether its derivative goes through the map, and who needs scores."""
        self._loss_of = recipe_named(recipe)(config), free, objective
        self._through_map = through_map
        self._forward = mode == "forward" or (mode == "auto" and (scores or len(free.names) <= _MOST_FORWARD))

    def __call__(self, x: NDArray[np.float64], recordings: Listing[Recording]) -> Evaluated:
        """Return the loss at a vector of parameters, with its gradient."""
        about = *self._loss_of, jnp.asarray(x)
        results: list[Gradient] | list[TotalGradient]
        if self._forward:
            results = [streaming_gradient(*about, one, self._through_map) for one in recordings]
            counts = [len(result.scores) for result in results]
            weighted = [count * result.scores for count, result in zip(counts, results, strict=True)]
            scores = np.concatenate(weighted)
        else:
            results = [
                checkpointed_gradient(*about, one, through_map=self._through_map) for one in recordings
            ]
            counts, scores = [len(one) for one in recordings], None
        return Evaluated.mean(
            counts,
            [result.value for result in results],
            [result.gradient for result in results],
            scores,
            sum(len(result.unconverged) for result in results),
        )

    def values(self, xs: NDArray[np.float64], recording: Recording) -> NDArray[np.float64]:
        """Return the objective of one recording at each row of ``xs``, without gradients."""
        return objective_values(*self._loss_of, jnp.asarray(xs), recording)
