"""``lio-jax train``: train learned parts by stochastic gradient steps on the user's recordings."""

from pathlib import Path

from lio_jax.commands.run import resolve_settings
from lio_jax.commands.runtime import say
from lio_jax.commands.tune import patterns_in, prepare_folder, recordings_of, write_settings
from lio_jax.tuning.problem import problem_of
from lio_jax.tuning.train import TRAINING, Epoch, Schedule, Trained, TrainingSession

TRAINED = "trained.yaml"


def train(
    data: tuple[Path, ...],
    params: str,
    out: Path,
    objective: str | None,
    recipe: str | None,
    assignments: tuple[str, ...],
    validate: tuple[Path, ...],
    gt: Path | None,
    segment: int,
    schedule: Schedule,
    overwrite: bool,
) -> None:
    """Train from the command line and write trained.yaml, training.npz and training.png.

    Raises:
        UsageError: unknown parameters or objective, or truth is needed and missing.
        LioJaxError: a recording cannot be read, or the objective is not finite.
    """
    base = resolve_settings(recipe, assignments, None)
    sequences, judges, truth = recordings_of(data, validate, gt, base)
    problem = problem_of(
        sequences, patterns_in(params), objective, base, judges, truth, segment=segment, mode="reverse"
    )
    for note in problem.notes:
        say(f"note: {note}")
    prepare_folder(out, TRAINING, overwrite)
    session = TrainingSession(problem, schedule, out)
    if session.epochs:
        say(f"note: continuing after {len(session.epochs)} epochs in {out / TRAINING}.")
    say(f"{len(problem.training)} pieces, {len(problem.free.names)} numbers to train")
    try:
        session.run(lambda epoch: say(_line(len(session.epochs), schedule.epochs, epoch)))
    except KeyboardInterrupt:
        if not session.epochs:
            raise
        say(f"interrupted: {len(session.epochs)} epochs are kept; the same command goes on from there.")
    found = session.trained()
    write_settings(out / TRAINED, found.settings)
    _draw(out / "training.png", found)
    print(_table(found))
    print(f"results    {out / TRAINED} (use it as --recipe), {TRAINING}, training.png")


def _line(number: int, of: int, epoch: Epoch) -> str:
    judged = "" if epoch.validation is None else f"  validation {epoch.validation:.6g}"
    skipped = "" if not epoch.skipped else f"  {epoch.skipped} batches without a finite gradient were skipped"
    return f"epoch {number} of {of}: loss {epoch.training:.6g}{judged}{skipped}"


def _draw(path: Path, found: Trained) -> None:
    import numpy as np

    from lio_jax.viz.plot import plot_tuning

    losses = {"training": np.array([epoch.training for epoch in found.epochs])}
    if found.epochs[0].validation is not None:
        losses["validation"] = np.array([epoch.validation for epoch in found.epochs], float)
    plot_tuning(path, losses, {}, {}, found.best, "epoch, from 0")


def _table(found: Trained) -> str:
    first, best = found.epochs[0], found.epochs[found.best]
    lines = [
        f"epoch {found.best + 1} of {len(found.epochs)} was taken",
        f"{'':24} {'first':>11} {'taken':>11}",
    ]
    lines.append(f"{'loss on training':24} {first.training:11.6g} {best.training:11.6g}")
    if first.validation is not None and best.validation is not None:
        lines.append(f"{'loss on validation':24} {first.validation:11.6g} {best.validation:11.6g}")
    return "\n".join(lines)
