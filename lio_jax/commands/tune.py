"""``lio-jax tune``: optimise parameters by gradient on the user's recordings."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from lio_jax.commands.run import resolve_settings, truth_of
from lio_jax.commands.runtime import say
from lio_jax.core.errors import UsageError
from lio_jax.core.files import atomic_path
from lio_jax.data.detect import open_sequence
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.settings.settings import Settings
from lio_jax.tuning.parameters import ParameterVector
from lio_jax.tuning.problem import problem_of
from lio_jax.tuning.session import HISTORY, Iterate, Session
from lio_jax.tuning.tune import (
    Optimiser,
    Tuned,
    check_counts,
    given_tree,
    in_own_units,
    optimiser_for,
    tuned_by,
)

TUNED = "tuned.yaml"


@dataclass(frozen=True)
class TuneOptions:
    """Options of ``lio-jax tune`` apart from the recordings."""

    recipe: str | None
    assignments: tuple[str, ...]
    params_from: Path | None
    params: str
    objective: str | None
    """None: ``noise``, or ``ate`` for parameters of the back end."""
    optimiser: Optimiser
    iterations: int
    patience: int
    start: int
    scans: int | None
    segment: int | None
    seed: int
    overwrite: bool


def tune(
    data: tuple[Path, ...], validate: tuple[Path, ...], gt: Path | None, out: Path, options: TuneOptions
) -> None:
    """Tune from the command line and write tuned.yaml, history.json and tuning.png.

    Raises:
        UsageError: unknown parameters or objective, or truth is needed and missing.
        LioJaxError: a recording cannot be read, or the objective is not finite at the start.
    """
    check_counts(options.iterations, options.patience)
    base = resolve_settings(options.recipe, options.assignments, options.params_from)
    patterns = patterns_in(options.params)
    sequences, judges, truth = recordings_of(data, validate, gt, base)
    problem = problem_of(
        sequences,
        patterns,
        options.objective,
        base,
        judges,
        truth,
        options.start,
        options.scans,
        options.segment,
    )
    optimiser = optimiser_for(problem, options.optimiser)
    for note in problem.notes:
        say(f"note: {note}")
    prepare_folder(out, HISTORY, options.overwrite)
    session = Session(problem, out, options.patience, lambda iterate: _report(problem.free, iterate))
    if session.history:
        say(f"note: continuing after {len(session.history)} evaluations in {out / HISTORY}.")
    with _interruptible(session):
        session.run(optimiser, problem.first(), problem.bounds(), options.iterations, options.seed)
    found = tuned_by(problem, session)
    write_settings(out / TUNED, found.settings)
    _draw(out / "tuning.png", problem.free, found)
    print(_table(problem.free, found))
    if found.at_limit:
        say(
            f"note: {', '.join(found.at_limit)} ended at the limit of the range; the objective has no "
            "minimum within it, or is flat there."
        )
    print(f"results    {out / TUNED} (use it as --recipe), {HISTORY}, tuning.png")


def patterns_in(params: str) -> list[str]:
    """Return the parameters' names and globs in ``A,B``."""
    return [word.strip() for word in params.split(",") if word.strip()]


def recordings_of(
    data: tuple[Path, ...], validate: tuple[Path, ...], gt: Path | None, settings: Settings
) -> tuple[list[Sequence], list[Sequence], Trajectory | None]:
    """Open recordings to learn from and to judge by, with the truth of the first where a file holds it.

    Raises:
        UsageError: one file of truth is given for several recordings.
        LioJaxError: a recording cannot be read.
    """
    if gt is not None and len(data) > 1:
        raise UsageError("--gt goes with one recording; several have to bring their own truth.")
    sequences = [open_sequence(path, settings.run.data) for path in data]
    judges = [open_sequence(path, settings.run.data) for path in validate]
    return sequences, judges, None if gt is None else truth_of(sequences[0], gt)


def prepare_folder(out: Path, history: str, overwrite: bool) -> None:
    """Make the folder of a tuning or a training; ``overwrite`` drops its history.

    Raises:
        UsageError: it is a file.
    """
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: is a file; give a folder.")
    out.mkdir(parents=True, exist_ok=True)
    if overwrite:
        (out / history).unlink(missing_ok=True)


@contextmanager
def _interruptible(session: Session) -> Iterator[None]:
    """On Ctrl-C keep the results so far, if there are any."""
    try:
        yield
    except KeyboardInterrupt:
        if not session.history:
            raise
        say(f"interrupted: {len(session.history)} evaluations are kept; the same command goes on from there.")


def _report(free: ParameterVector, iterate: Iterate) -> None:
    shown = in_own_units(free, np.asarray(iterate.x))
    values = "  ".join(f"{name.split('.', 1)[1]} {value:.4g}" for name, value in shown.items())
    judged = "" if iterate.validation is None else f"  validation {iterate.validation:.6g}"
    say(f"loss {iterate.value:.6g}{judged}  {values}")
    if iterate.unconverged:
        say(
            f"warning: {iterate.unconverged} of {iterate.scans} scans did not converge; their part of the "
            "gradient means little (raise config.registration.max_iterations, or start nearer)."
        )


def write_settings(path: Path, settings: Settings) -> None:
    """Write a settings file that repeats what was given and holds what was found."""
    with atomic_path(path) as aside:
        aside.write_text(yaml.safe_dump(given_tree(settings), sort_keys=False, default_flow_style=None))


def _draw(path: Path, free: ParameterVector, found: Tuned) -> None:
    from lio_jax.viz.plot import plot_tuning

    history = found.history
    shown = [in_own_units(free, np.asarray(iterate.x)) for iterate in history]
    losses = {"training": np.array([iterate.value for iterate in history])}
    if found.best.validation is not None:
        losses["validation"] = np.array([iterate.validation for iterate in history], float)
    parameters = {name: np.array([one[name] for one in shown]) for name in free.names}
    plot_tuning(path, losses, parameters, found.intervals, history.index(found.best))


def _table(free: ParameterVector, found: Tuned) -> str:
    first, best = found.history[0], found.best
    before = in_own_units(free, np.asarray(first.x))
    lines = [f"{'parameter':42s} {'before':>11s} {'after':>11s}   95 % interval"]
    for name, value in found.values.items():
        low_high = "" if name not in found.intervals else "{:.4g} .. {:.4g}".format(*found.intervals[name])
        lines.append(f"{name:42s} {before[name]:11.4g} {value:11.4g}   {low_high}")
    lines.append(f"{'loss on training':42s} {first.value:11.6g} {best.value:11.6g}")
    if first.validation is not None and best.validation is not None:
        lines.append(f"{'loss on validation':42s} {first.validation:11.6g} {best.validation:11.6g}")
    scans = sum(iterate.scans for iterate in found.history)
    lines.append(f"{len(found.history)} evaluations, {scans} scans with gradient")
    return "\n".join(lines)
