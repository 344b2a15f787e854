"""Objectives by name, and weighted sums of them, as the command line takes them."""

from dataclasses import dataclass

from lio_jax.core.errors import UsageError
from lio_jax.tuning.objective import Objective
from lio_jax.tuning.objectives import (
    MarginalLikelihood,
    MeanOverScans,
    WeightedSum,
    map_consistency,
    point_innovation,
    pose_innovation,
    range_noise,
)
from lio_jax.tuning.trajectory_objectives import AbsoluteError, RelativeError


@dataclass(frozen=True)
class Named:
    """An objective and what has to be known about it."""

    objective: Objective
    needs_truth: bool
    likelihood: bool
    """A mean negative log-likelihood per scan: its scores give the parameters' uncertainty."""


_OPENING = 10
"""Scans at a recording's start that tell of the first state's sigmas, not of the noise."""
_SINGLE = {
    "pose": Named(MeanOverScans(pose_innovation, _OPENING), False, True),
    "point": Named(MeanOverScans(point_innovation, _OPENING), False, True),
    "marginal": Named(MarginalLikelihood(_OPENING), False, True),
    "ranges": Named(MeanOverScans(range_noise, _OPENING), False, True),
    "map": Named(MeanOverScans(map_consistency), False, False),
    "ate": Named(AbsoluteError(), True, False),
    "rpe": Named(RelativeError(), True, False),
    "rpe-rotation": Named(RelativeError(rotation=True), True, False),
}
_SHORT = {"noise": "pose+ranges"}
"""What is called by a name of its own."""


def objective_named(text: str) -> Named:
    """Return an objective by name, or a sum such as ``ate+0.01*pose``.

    Raises:
        UsageError: a name is not known (lists those there are), or a weight is no number.
    """
    terms = _SHORT.get(text, text).split("+")
    parts, weights = [], []
    for term in terms:
        weight, star, name = term.rpartition("*")
        if name.strip() not in _SINGLE:
            names = ", ".join([*_SINGLE, *_SHORT])
            raise UsageError(
                f"objective '{name.strip()}' is not known; there are: {names}, and sums like ate+0.01*pose."
            )
        try:
            weights.append(float(weight) if star else 1.0)
        except ValueError:
            raise UsageError(f"objective '{term}': '{weight}' is no number to weigh {name} with.") from None
        parts.append(_SINGLE[name.strip()])
    if len(parts) == 1 and weights == [1.0]:
        return parts[0]
    return Named(
        WeightedSum(tuple(part.objective for part in parts), tuple(weights)),
        any(part.needs_truth for part in parts),
        all(part.likelihood for part in parts) and set(weights) == {1.0},
    )
