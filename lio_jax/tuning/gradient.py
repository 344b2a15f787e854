"""The gradient of a recording's objective in one line."""

from collections.abc import Sequence as Listing
from dataclasses import dataclass

from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.run.run import settings_for
from lio_jax.settings.settings import Settings, recipe_settings
from lio_jax.tuning.objectives import Objective, objective_named
from lio_jax.tuning.parameters import free_parameters
from lio_jax.tuning.recording import Recording
from lio_jax.tuning.streaming import StreamingGradient


@dataclass(frozen=True)
class NamedGradient:
    """An objective's value and its derivatives by name."""

    value: float
    gradient: dict[str, float]
    """By the logarithm of positive parameters, by the others themselves (m, rad, s)."""
    unconverged: tuple[int, ...]
    """Scans whose solve did not converge: the derivative is not to be trusted."""


def gradient(
    sequence: Sequence,
    patterns: Listing[str],
    objective: str | Objective = "noise",
    settings: Settings | None = None,
    truth: Trajectory | None = None,
    start: int = 0,
    count: int | None = None,
) -> NamedGradient:
    """Return the objective of a recording and its gradient.

    Args:
        sequence: the recording.
        patterns: parameters by name or glob, such as ``imu.*_noise``.
        objective: by name (see :mod:`lio_jax.tuning.objective_names`), a sum of them, or one's own.
        settings: recipe, config and params; None: the default recipe's.
        truth: in place of the recording's own.
        start: first scan.
        count: number of scans; None: to the end.

    Raises:
        UsageError: a parameter or an objective is not known, or can't be differentiated.
    """
    resolved, _ = settings_for(sequence, settings or recipe_settings("default"))
    free = free_parameters(resolved.params(), list(patterns))
    chosen = objective_named(objective).objective if isinstance(objective, str) else objective
    recording = Recording(sequence, resolved, start, count, truth, keep=False)
    result = StreamingGradient(resolved.recipe, resolved.config, free, chosen)(free.first(), recording)
    by_name = dict(zip(free.names, result.gradient.tolist(), strict=True))
    return NamedGradient(result.value, by_name, result.unconverged)
