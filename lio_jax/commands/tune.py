"""``lio-jax tune``: optimise parameters by gradient on the user's recordings."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from lio_jax.commands.run import resolve_settings, truth_of
from lio_jax.commands.runtime import say
from lio_jax.core.errors import UsageError
from lio_jax.core.files import atomic_path
from lio_jax.data.detect import open_sequence
from lio_jax.run.fitted_settings import ring_count
from lio_jax.run.run import settings_for
from lio_jax.settings.settings import Settings
from lio_jax.tuning.corrected import CorrectedLoss, free_of_back_end, names_back_end
from lio_jax.tuning.gradient import Loss, wants_map
from lio_jax.tuning.objective_names import LIKELIHOODS, SHORT
from lio_jax.tuning.objectives import Named, objective_named
from lio_jax.tuning.optimise import Bounds
from lio_jax.tuning.parameters import ParameterVector, free_parameters
from lio_jax.tuning.recording import Recording
from lio_jax.tuning.session import HISTORY, Iterate, Session

Optimiser = Literal["auto", "scoring", "lbfgsb", "stationary", "adam"]

FACTOR = 1000.0
"""Largest change of a positive parameter from its start, as a factor."""
REACH = {
    "rotation": math.radians(20),
    "translation": 0.5,
    "time_offset": 0.1,
    "elevation_offset": 0.05,
    "ring_elevation_offset": 0.05,
    "range_offset": 0.5,
    "ring_range_offset": 0.5,
    "range_scale": math.log(1.2),
    "lever_arm": 3.0,
}
"""Largest change of parameters that move the points or the antenna, from their start: rad, m, s, and of a
logarithm."""


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
    _check(options, data, gt)
    base = resolve_settings(options.recipe, options.assignments, options.params_from)
    patterns = [word.strip() for word in options.params.split(",") if word.strip()]
    corrected = names_back_end(patterns, base)
    objective = options.objective or ("ate" if corrected else "noise")
    named, options = objective_named(objective), replace(options, objective=objective)
    optimiser = options.optimiser
    # a pose graph has no scores of single scans
    scored = named.likelihood and not corrected
    if optimiser == "scoring" and not scored:
        raise UsageError(
            "--optimizer scoring works with parameters of the recipe and a likelihood "
            f"({', '.join([*SHORT, *LIKELIHOODS])}), not with {options.params} and {options.objective}."
        )
    rings = partial(_rings_of, data[0], base)

    def free_in(settings: Settings) -> ParameterVector:
        if corrected:
            return free_of_back_end(settings, patterns, named)
        return free_parameters(settings.params(), patterns, rings)

    free_in(base)
    settings, training = _recordings(data, base, gt, named, options, options.segment)
    _, validation = _recordings(validate, settings, None, named, replace(options, start=0, scans=None), None)
    free = free_in(settings)
    _prepare(out, options.overwrite)
    through_map = not corrected and wants_map(named, free)
    if optimiser == "auto":
        # where points lie changes a loss by little, and every value of it changes choices
        moved = through_map and all(declared.moves_points for declared in free.declared)
        optimiser = "scoring" if scored else "stationary" if moved else "lbfgsb"
    loss: Loss | CorrectedLoss = (
        CorrectedLoss(settings, free, named.objective)
        if corrected
        else Loss(settings.recipe, settings.config, free, named.objective, through_map, scored)
    )
    session = Session(
        out,
        free,
        loss,
        training,
        validation,
        scored,
        options.patience,
        lambda iterate: _report(free, iterate),
    )
    if session.history:
        say(f"note: continuing after {len(session.history)} evaluations in {out / HISTORY}.")
    first = np.asarray(free.first())
    with _interruptible(session, out):
        session.run(optimiser, first, _bounds(free, first), options.iterations, options.seed)
    _write(out, base, free, session)
    print(_table(free, session))
    if at_limit := _at_limit(free, first, session.best):
        say(
            f"note: {', '.join(at_limit)} ended at the limit of the range; the objective has no minimum "
            "within it, or is flat there."
        )
    print(f"results    {out / 'tuned.yaml'} (use it as --recipe), {HISTORY}, tuning.png")


def _check(options: TuneOptions, data: tuple[Path, ...], gt: Path | None) -> None:
    for name in ("iterations", "patience"):
        if getattr(options, name) < 1:
            raise UsageError(f"--{name} must be 1 or more, not {getattr(options, name)}.")
    if options.start < 0 or (options.scans is not None and options.scans < 2):
        raise UsageError(
            f"--start must be 0 or more and --scans 2 or more, not {options.start} and {options.scans}."
        )
    if options.segment is not None and options.segment < 20:
        raise UsageError(
            f"--segment must be 20 scans or more, not {options.segment}: a shorter one shows the start only."
        )
    if gt is not None and len(data) > 1:
        raise UsageError("--gt goes with one recording; several have to bring their own truth.")


def _recordings(
    paths: tuple[Path, ...],
    settings: Settings,
    gt: Path | None,
    named: Named,
    options: TuneOptions,
    segment: int | None,
) -> tuple[Settings, list[Recording]]:
    """Return the recordings or their consecutive segments, and settings with the first one's extrinsics."""
    recordings: list[Recording] = []
    for path in paths:
        sequence = open_sequence(path, settings.run.data)
        truth = truth_of(sequence, gt)
        if named.needs_truth and truth is None:
            raise UsageError(
                f"{path}: holds no truth, which objective {options.objective} needs; give --gt FILE, or an "
                "--objective without truth (noise, or marginal for loops and GPS)."
            )
        if not recordings:
            settings, notes = settings_for(sequence, settings)
            for note in notes:
                say(f"note: {note}")
        count = min(options.scans or sequence.info.scan_count, sequence.info.scan_count - options.start)
        length = segment or count
        for begin in range(options.start, options.start + max(count - length, 0) + 1, max(length, 1)):
            recordings.append(Recording(sequence, settings, begin, length, truth))
            for note in recordings[-1].notes:
                say(f"note: {note}")
    return settings, recordings


def _rings_of(path: Path, settings: Settings) -> int:
    return ring_count(open_sequence(path, settings.run.data).scans())


def _reach(free: ParameterVector) -> np.ndarray:
    """Return the largest change of each component from its start."""
    return np.array([REACH.get(name.split(".")[1], math.log(FACTOR)) for name in free.names])


def _bounds(free: ParameterVector, first: np.ndarray) -> Bounds:
    width = _reach(free)
    upper = first + width
    for place, name in enumerate(free.names):
        if name == "registration.information_scale":
            upper[place] = 0.0
    return Bounds(first - width, np.maximum(upper, first))


def _at_limit(free: ParameterVector, first: np.ndarray, iterate: Iterate) -> list[str]:
    """Return the components that changed as far as the tuning lets them."""
    change = np.abs(np.asarray(iterate.x) - first)
    # the difference of a bound and the start is rounded
    return [name for name, at in zip(free.names, change > 0.999 * _reach(free), strict=True) if at]


def _prepare(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: is a file; give a folder.")
    out.mkdir(parents=True, exist_ok=True)
    if overwrite:
        (out / HISTORY).unlink(missing_ok=True)


@contextmanager
def _interruptible(session: Session, out: Path) -> Iterator[None]:
    """On Ctrl-C keep the results so far, if there are any."""
    try:
        yield
    except KeyboardInterrupt:
        if not session.history:
            raise
        say(f"interrupted: {len(session.history)} evaluations are kept; the same command goes on from there.")


def _report(free: ParameterVector, iterate: Iterate) -> None:
    values = "  ".join(
        f"{name.split('.', 1)[1]} {value:.4g}" for name, value in _shown(free, iterate).items()
    )
    judged = "" if iterate.validation is None else f"  validation {iterate.validation:.6g}"
    say(f"loss {iterate.value:.6g}{judged}  {values}")
    if iterate.unconverged:
        say(
            f"warning: {iterate.unconverged} of {iterate.scans} scans did not converge; their part of the "
            "gradient means little (raise config.registration.max_iterations, or start nearer)."
        )


def _shown(free: ParameterVector, iterate: Iterate) -> dict[str, float]:
    """Return the components in their own units: exp of the components on a log scale."""
    return {
        name: math.exp(value) if declared.tuned == "log" else value
        for name, declared, value in zip(free.names, free.declared, iterate.x, strict=True)
    }


def _interval(free: ParameterVector, iterate: Iterate) -> dict[str, tuple[float, float]]:
    """Return each component's 95 % interval, where it is known."""
    if iterate.sigma is None:
        return {}
    intervals = {}
    components = zip(free.names, free.declared, iterate.x, iterate.sigma, strict=True)
    for name, declared, value, sigma in components:
        ends = (value - 1.96 * sigma, value + 1.96 * sigma)
        if declared.tuned == "log":
            ends = (math.exp(max(ends[0], -700)), math.exp(min(ends[1], 700)))
        intervals[name] = ends
    return intervals


def tuned_settings(base: Settings, tuned: dict[str, Any]) -> dict[str, Any]:
    """Return the tree of a settings file that repeats what was given and holds what was tuned.

    What was taken from the recording is left out: a run takes it from its own recording.

    Args:
        base: settings as they were given, by a file, ``--params-from`` or ``--set``.
        tuned: tuned values by their paths, such as ``params.imu.gyro_noise``.
    """
    given = base.as_dict()
    tree: dict[str, Any] = {"recipe": base.recipe}
    for path in sorted(base.given | tuned.keys()):
        kind, section, name = path.split(".")
        value = tuned[path] if path in tuned else given[kind][section][name]
        tree.setdefault(kind, {}).setdefault(section, {})[name] = value
    return tree


def _write(out: Path, base: Settings, free: ParameterVector, session: Session) -> None:
    best = session.best
    tree = tuned_settings(base, free.overrides(np.asarray(best.x)))
    with atomic_path(out / "tuned.yaml") as aside:
        aside.write_text(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None))
    from lio_jax.viz.plot import plot_tuning

    shown = [_shown(free, iterate) for iterate in session.history]
    losses = {"training": np.array([iterate.value for iterate in session.history])}
    if best.validation is not None:
        losses["validation"] = np.array([iterate.validation for iterate in session.history], float)
    parameters = {name: np.array([one[name] for one in shown]) for name in free.names}
    plot_tuning(out / "tuning.png", losses, parameters, _interval(free, best), session.history.index(best))


def _table(free: ParameterVector, session: Session) -> str:
    first, best = session.history[0], session.best
    before, after, intervals = _shown(free, first), _shown(free, best), _interval(free, best)
    lines = [f"{'parameter':42s} {'before':>11s} {'after':>11s}   95 % interval"]
    for name in free.names:
        low_high = "" if name not in intervals else "{:.4g} .. {:.4g}".format(*intervals[name])
        lines.append(f"{name:42s} {before[name]:11.4g} {after[name]:11.4g}   {low_high}")
    lines.append(f"{'loss on training':42s} {first.value:11.6g} {best.value:11.6g}")
    if first.validation is not None and best.validation is not None:
        lines.append(f"{'loss on validation':42s} {first.validation:11.6g} {best.validation:11.6g}")
    scans = sum(iterate.scans for iterate in session.history)
    lines.append(f"{len(session.history)} evaluations, {scans} scans with gradient")
    return "\n".join(lines)
