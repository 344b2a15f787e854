"""Tune parameters by gradient: the minimum of an objective over one's recordings."""

from collections.abc import Callable
from collections.abc import Sequence as Listing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.settings.settings import Settings
from lio_jax.tuning.objective_names import LIKELIHOODS, SHORT
from lio_jax.tuning.objectives import Objective
from lio_jax.tuning.optimise import covariance_by_curvature
from lio_jax.tuning.parameters import ParameterVector
from lio_jax.tuning.problem import Problem, problem_of
from lio_jax.tuning.session import Iterate, Session

Optimiser = Literal["auto", "scoring", "lbfgsb", "stationary", "adam"]


@dataclass(frozen=True)
class Tuned:
    """What a tuning found."""

    settings: Settings
    """The settings that were given, with the values found. What was taken from the recordings is left out: a
    run takes it from its own recording."""
    values: dict[str, float]
    """Values found by component, such as ``imu.gyro_noise``."""
    intervals: dict[str, tuple[float, float]]
    """95 % intervals by component; empty where the objective is no likelihood."""
    best: Iterate
    """The evaluation that was taken."""
    history: tuple[Iterate, ...]
    """All evaluations, in their order."""
    at_limit: tuple[str, ...]
    """Components that ended at the limit of their range: the objective has no minimum in it, or is flat."""


def tune(
    recordings: Listing[Sequence],
    patterns: Listing[str],
    objective: str | Objective | None = None,
    settings: Settings | None = None,
    validate: Listing[Sequence] = (),
    truth: Trajectory | None = None,
    start: int = 0,
    count: int | None = None,
    segment: int | None = None,
    optimiser: Optimiser = "auto",
    iterations: int = 40,
    patience: int = 10,
    seed: int = 0,
    out: Path | None = None,
    observer: Callable[[Iterate], None] = lambda iterate: None,
) -> Tuned:
    """Tune parameters by gradient.

    For tens of parameters, whose values with their intervals are the result. Weights of learned parts are
    trained by :func:`lio_jax.tuning.train.train`, which has no intervals and needs no evaluation of all
    recordings.

    Args:
        recordings: to tune on.
        patterns: parameters by name or glob, such as ``imu.*_noise``.
        objective: by name, a sum of names, or one's own; None: ``noise``, which needs no truth, or ``ate``
            for parameters of the back end.
        settings: recipe, config and params to start from; None: the default recipe's.
        validate: recordings that decide which evaluation is taken and when to stop.
        truth: in place of that of the recordings.
        start: first scan of each recording.
        count: number of scans of each; None: to the end.
        segment: cut the recordings into pieces of this many scans, each of which starts on its own.
        optimiser: auto takes scoring for likelihoods, stationary for extrinsics and corrections of points,
            lbfgsb for the others; adam steps along the gradient of one segment at a time, for recordings
            that are too long to be evaluated whole at every step.
        iterations: largest number of evaluations.
        patience: number of evaluations without a better one after which the tuning ends.
        seed: of the segments that adam draws.
        out: folder for ``history.json``, made where there is none, from which the same call goes on after
            a kill; None: nothing is written.
        observer: called after every evaluation.

    Raises:
        UsageError: see :func:`lio_jax.tuning.problem.problem_of`; or the optimiser does not suit the
            objective.
        LioJaxError: the objective is not finite at the start, or does not depend on the parameters.
    """
    check_counts(iterations, patience)
    problem = problem_of(recordings, patterns, objective, settings, validate, truth, start, count, segment)
    chosen = optimiser_for(problem, optimiser)
    session = Session(problem, out, patience, observer)
    session.run(chosen, problem.first(), problem.bounds(), iterations, seed)
    return tuned_by(problem, session)


def check_counts(iterations: int, patience: int) -> None:
    """Refuse a tuning without evaluations.

    Raises:
        UsageError: a number is not positive.
    """
    for name, count in (("iterations", iterations), ("patience", patience)):
        if count < 1:
            raise UsageError(f"--{name} must be 1 or more, not {count}.")


def optimiser_for(problem: Problem, optimiser: Optimiser) -> str:
    """Return the optimiser that is used.

    Raises:
        UsageError: it is not known, or needs scores that the objective has not.
    """
    if optimiser not in get_args(Optimiser):
        raise UsageError(
            f"optimizer '{optimiser}' is not known; there are: {', '.join(get_args(Optimiser))}."
        )
    if optimiser == "scoring" and not problem.scored:
        raise UsageError(
            "optimizer scoring works with parameters of the recipe and a likelihood "
            f"({', '.join([*SHORT, *LIKELIHOODS])}) alone."
        )
    if optimiser != "auto":
        return optimiser
    # where points lie changes a loss by little, and every value of it changes choices
    moved = problem.through_map and all(declared.moves_points for declared in problem.free.declared)
    return "scoring" if problem.scored else "stationary" if moved else "lbfgsb"


def tuned_by(problem: Problem, session: Session) -> Tuned:
    """Return what a tuning found so far; it has one evaluation at least."""
    best = session.best
    x = np.asarray(best.x)
    return Tuned(
        problem.tuned_settings(x),
        in_own_units(problem.free, x),
        _intervals(problem, best),
        best,
        tuple(session.history),
        tuple(problem.at_limit(x)),
    )


def in_own_units(free: ParameterVector, x: NDArray[np.float64]) -> dict[str, float]:
    """Return the components of a vector in their own units: exp of those on a log scale."""
    logarithmic = [declared.tuned == "log" for declared in free.declared]
    # an interval of what is hardly observable may end where exp overflows
    values = np.where(logarithmic, np.exp(np.clip(x, -700.0, 700.0)), x)
    return dict(zip(free.names, values.tolist(), strict=True))


def _intervals(problem: Problem, iterate: Iterate) -> dict[str, tuple[float, float]]:
    x, free = np.asarray(iterate.x), problem.free
    if iterate.sigma is not None:
        sigma = np.asarray(iterate.sigma)
    elif problem.of_graph:
        sigma = np.sqrt(np.diag(covariance_by_curvature(_summed_gradient(problem), x)))
    else:
        return {}
    low, high = in_own_units(free, x - 1.96 * sigma), in_own_units(free, x + 1.96 * sigma)
    return {name: (low[name], high[name]) for name in free.names}


def _summed_gradient(problem: Problem) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the gradient of the sum over all scans, of which the loss is the mean."""

    def gradient(x: NDArray[np.float64]) -> NDArray[np.float64]:
        result = problem.loss(x, problem.training)
        return result.gradient * result.scans

    return gradient


def given_tree(settings: Settings) -> dict[str, Any]:
    """Return the tree of a settings file that repeats what was given in the settings, and nothing else."""
    values = settings.as_dict()
    tree: dict[str, Any] = {"recipe": settings.recipe}
    for path in sorted(settings.given):
        kind, section, name = path.split(".")
        tree.setdefault(kind, {}).setdefault(section, {})[name] = values[kind][section][name]
    return tree
