"""``lio-jax run``: resolve the settings, run a recording into a folder, and print the results."""

from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from lio_jax.commands.runtime import say
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import atomic_path
from lio_jax.data.detect import open_sequence
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory, write_tum
from lio_jax.recipes import recipe_named
from lio_jax.run.folder import run_folder, write_json
from lio_jax.run.journal import opened_journal
from lio_jax.run.run import check_start, run_sequence, settings_for
from lio_jax.run.sinks import RunResult, Sink
from lio_jax.run.track import ScanResult
from lio_jax.run.unfinished import CONFIG, finished_scans, read_unfinished
from lio_jax.run.verdict import in_words
from lio_jax.settings.settings import Settings, load_settings, recipe_settings, with_overrides
from lio_jax.settings.translate import ForeignKey, ForeignSettings, load_foreign_settings
from lio_jax.viz.recording import ViewerRecording
from lio_jax.viz.run_recording import RecordingSink


def run(
    data: Path,
    recipe: str | None,
    assignments: tuple[str, ...],
    params_from: Path | None,
    out: Path,
    start: int,
    scans: int | None,
    gt: Path | None,
    overwrite: bool,
    live: bool = False,
    resume: bool = False,
) -> None:
    """Run one recording from the command line."""
    if start < 0 or (scans is not None and scans < 1):
        raise UsageError(f"--start must be 0 or more and --scans 1 or more, not {start} and {scans}.")
    if resume and overwrite:
        raise UsageError("--resume goes on with the run in the folder and --overwrite replaces it; give one.")
    if resume and (done := finished_scans(out)) is not None:
        say(f"{out}: the run of {done} scans is finished; there is nothing left to do.")
        return
    begun = read_unfinished(out) if resume else None
    if begun is not None and (recipe, assignments, params_from, start, scans) == (None, (), None, 0, None):
        say(f"note: the settings are those of the unfinished run in {out}.")
        settings, start, scans = load_settings(out / CONFIG), begun.start, begun.count
    else:
        settings = resolve_settings(recipe, assignments, params_from)
    sequence = open_sequence(data, settings.run.data)
    truth = truth_of(sequence, gt)
    if live and not settings.run.output.recording:
        raise UsageError("--live shows the recording, and config.output.recording=false leaves it out.")
    run_and_report(sequence, settings, out, start, scans, truth, overwrite, live, resume)


def run_and_report(
    sequence: Sequence,
    settings: Settings,
    out: Path,
    start: int,
    count: int | None,
    truth: Trajectory | None,
    overwrite: bool,
    live: bool = False,
    resume: bool | None = None,
) -> RunResult:
    """Run a recording into a folder, evaluate against truth, draw, and print a summary.

    Args:
        sequence: the recording.
        settings: of the run.
        out: the run folder.
        start: first scan.
        count: number of scans; None: to the end.
        truth: T_truth_imu, where it is known.
        overwrite: whether an earlier run in the folder may be replaced.
        live: whether a browser of this computer shows the run.
        resume: whether an unfinished run in the folder goes on; None: and this run leaves nothing from which
            it could go on later.

    Raises:
        UsageError: the recording ends before ``start``, or the folder may not be written.
        LioJaxError: nothing could be read, or the run ended early; what was computed is written.
    """
    check_start(sequence, start)
    with run_folder(out, overwrite, bool(resume)):
        return run_into(sequence, settings, out, start, count, truth, live, resume is not None)


def beneath_recipe(foreign: ForeignSettings, recipe: str | None, is_file: bool) -> Settings:
    """Return the settings of a recipe, overridden by another system's, overridden by a settings file's.

    Args:
        foreign: settings from the other system's file.
        recipe: name or settings file; None: the recipe that follows the other system's method. It is also
            used if the settings file names no recipe.
        is_file: whether ``recipe`` is a file.

    Raises:
        UsageError: a file is unreadable, or holds an unknown key or an impossible value.
    """
    if not is_file:
        return foreign.applied_to(recipe_settings(recipe or foreign.system.recipe))
    file = Path(str(recipe))
    named = load_settings(file, recipe_settings(foreign.system.recipe)).recipe
    return load_settings(file, foreign.applied_to(recipe_settings(named)))


def mapping_table(foreign: ForeignSettings, settings: Settings) -> str:
    """Return a table of the file's keys, with the effect of each key on a run's settings."""
    system, recipe = foreign.system, settings.recipe
    taken = foreign.taken(recipe)
    left = [entry for entry in foreign.keys if entry not in taken]
    width = max(len(entry.key) for entry in foreign.keys)
    lines = [f"{foreign.source}: {system.name}'s parameters, recipe {recipe}"]
    for entry in taken:
        lines.append(
            f"  {entry.key:{width}}  {_short(entry.value)} -> {_ours(entry, settings)}{_comment(entry.word)}"
        )
    if left:
        lines.append("not taken:")
    for entry in left:
        why = f"of {system.name}'s method, not taken by the recipe {recipe}" if entry.settings else entry.word
        lines.append(f"  {entry.key:{width}}  {_short(entry.value)}{_comment(why)}")
    return "\n".join(lines)


def _ours(entry: ForeignKey, settings: Settings) -> str:
    words = []
    for path, value in entry.settings.items():
        kind, section, name = path.split(".")
        final = settings.as_dict()[kind][section][name]
        replaced = f" (replaced: {_short(final)})" if final != _as_held(value, final) else ""
        words.append(f"{path}={_short(value)}{replaced}")
    return ", ".join(words)


def _as_held(value: Any, final: Any) -> Any:
    if isinstance(final, str):
        return value or ""
    return float(value) if isinstance(final, float) else value


def _comment(word: str) -> str:
    return f"  ({word})" if word else ""


def _short(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return _cut(f"[{','.join(_short(item) for item in value)}]")
    return _cut(str(value))


_LONGEST_VALUE = 200


def _cut(text: str) -> str:
    """Return the beginning of a value that no line of a table has room for; a damaged file may hold one."""
    return text if len(text) <= _LONGEST_VALUE else f"{text[:_LONGEST_VALUE]}..."


def resolve_settings(
    recipe: str | None, assignments: tuple[str, ...], params_from: Path | None = None
) -> Settings:
    """Return the settings of a recipe name or settings file, with ``--set`` applied.

    Another system's parameters override the recipe's own values, and a settings file's values override them.
    A printed table lists the parameters that were used.

    Args:
        recipe: name or file; None: default, or the recipe that follows the other system's method.
        assignments: arguments of ``--set``.
        params_from: parameter file of LIO-SAM or FAST-LIO2.

    Raises:
        UsageError: unknown recipe, unreadable file, unknown key or impossible value.
    """
    is_file = recipe is not None and recipe.endswith((".yaml", ".yml"))
    if params_from is not None:
        foreign = load_foreign_settings(params_from)
        settings = beneath_recipe(foreign, recipe, is_file)
    else:
        name = recipe or Settings.recipe
        settings = load_settings(Path(name)) if is_file else recipe_settings(name)
    recipe_named(settings.recipe)
    settings = with_overrides(settings, assignments)
    if params_from is not None:
        say(mapping_table(foreign, settings))
    return settings


def run_into(
    sequence: Sequence,
    settings: Settings,
    out: Path,
    start: int,
    count: int | None,
    truth: Trajectory | None,
    live: bool = False,
    resumable: bool = False,
) -> RunResult:
    """Run a recording into a folder, empty or of an unfinished run; see :func:`run_and_report`."""
    settings, notes = settings_for(sequence, settings)
    info = sequence.info
    for note in (*info.notes, *notes):
        say(f"note: {note}")
    remaining = max(0, info.scan_count - start)
    total = remaining if count is None else min(count, remaining)
    with ExitStack() as stack:
        sinks: list[Sink] = []
        if settings.run.output.recording:
            address = _live_viewer(stack) if live else None
            recording = stack.enter_context(ViewerRecording(out / "recording.rrd", total, address))
            sinks.append(RecordingSink(recording, out, truth))
        sinks.append(_ProgressBar(total))
        opened = opened_journal(out, sequence, settings, start, count, say) if resumable else nullcontext()
        journal = stack.enter_context(opened)
        result = run_sequence(sequence, settings, out, start, count, sinks, say, journal)
        if isinstance(result.interruption, KeyboardInterrupt):
            say("interrupted: finishing the files of what was computed ...")
    result.metrics["notes"] = [*sequence.info.notes, *notes]
    evaluation_text = ""
    try:
        evaluation_text = _finish(result, truth, settings, out, info.name)
    except Exception:
        # a file that the run could not write is the cause of what cannot be drawn
        if result.interruption is None:
            raise
    _warn(result.metrics["warnings"])
    _warn(result.metrics["verdict"]["reasons"])
    _warn([failure["message"] for failure in result.metrics["failures"]])
    print(_summary(result, out), end="\n\n" if evaluation_text else "\n")
    if evaluation_text:
        print(evaluation_text)
    _raise_if_interrupted(result, out, resumable)
    if journal is not None:
        journal.remove()
    return result


_WARNINGS_SHOWN = 5


def _warn(sentences: list[str]) -> None:
    for sentence in sentences[:_WARNINGS_SHOWN]:
        say(f"warning: {sentence}")
    if (hidden := len(sentences) - _WARNINGS_SHOWN) > 0:
        say(f"warning: {hidden} more of these; metrics.json lists them all.")


def _live_viewer(stack: ExitStack) -> str:
    """Serve a viewer during the run, and return the address to which results are sent."""
    from lio_jax.viz.viewer import served

    server = stack.enter_context(served())
    say(f"live: open {server.page}")
    return server.stream


class _ProgressBar(Sink):
    """Shows how many scans are done."""

    def __init__(self, total: int) -> None:
        self._bar = tqdm(total=total, unit="scan", disable=None, leave=False)

    def take(self, result: ScanResult) -> None:
        self._bar.update()

    def close(self) -> None:
        self._bar.close()


def truth_of(sequence: Sequence, gt: Path | None) -> Trajectory | None:
    """Return the recording's ground truth, or the ground truth in a file.

    Raises:
        UsageError: the file has no time stamps.
    """
    if gt is None:
        return sequence.truth()
    from lio_jax.evaluation.load import load_trajectory

    loaded = load_trajectory(gt)
    if not loaded.stamped:
        raise UsageError(f"{gt}: has no time stamps; give a TUM file, or KITTI poses with their times.txt.")
    known = loaded.trajectory.finite()
    if not len(known):
        raise UsageError(f"{gt}: holds no pose with finite numbers; give another ground truth.")
    return known


def _finish(result: RunResult, truth: Trajectory | None, settings: Settings, out: Path, name: str) -> str:
    """Add notes and errors against truth to the folder, draw, and return the errors as a table."""
    text = ""
    if truth is not None:
        from lio_jax.evaluation.association import match_by_time
        from lio_jax.evaluation.evaluate import evaluate, format_evaluation

        try:
            evaluation = evaluate(result.trajectory, truth)
        except LioJaxError as error:
            say(f"warning: no comparison with the truth: {error}")
        else:
            # the evaluation adds notes of its own
            noted = [*result.metrics["notes"], *evaluation.notes]
            result.metrics |= evaluation.as_dict() | {"notes": noted}
            if result.odometry is not None:
                result.metrics["odometry"] = evaluate(result.odometry, truth).as_dict()
            text = format_evaluation(evaluation)
            with atomic_path(out / "truth.tum") as aside:
                write_tum(aside, match_by_time(result.trajectory, truth).reference)
    write_json(out / "metrics.json", result.metrics)
    if settings.run.output.plot:
        from lio_jax.viz.plot import plot_timings, plot_trajectory

        plot_trajectory(out / "trajectory.png", result.trajectory, truth, name)
        stages = {name: ms for name, ms in result.stage_ms.items() if ms and name != "total"}
        plot_timings(out / "timings.png", stages)
    if settings.run.output.report:
        from lio_jax.viz.report import write_report

        write_report(out)
    return text


def _summary(result: RunResult, out: Path) -> str:
    metrics = result.metrics
    total = metrics["scan_ms"]["total"]
    steps = np.linalg.norm(np.diff(result.trajectory.positions, axis=0), axis=1)
    corrected = _corrected(metrics["backend"]) if "backend" in metrics else []
    return "\n".join(
        [
            f"scans      {metrics['scans']}  ({steps.sum():.2f} m travelled)",
            f"predicted  by {metrics['prediction']}",
            f"per scan   {total['median']:.1f} ms median, {total['p95']:.1f} ms p95",
            f"compile    {metrics['compile_s']:.2f} s",
            f"wall       {metrics['wall_s']:.1f} s",
            f"memory     {metrics['peak_rss_mb']:.0f} MiB peak",
            f"verdict    {in_words(metrics['verdict'])}",
            *corrected,
            f"results    {out}",
        ]
    )


def _corrected(backend: dict[str, Any]) -> list[str]:
    loops, fixes = backend["loops"], backend["gps"]
    refused = sum(loops["refused"].values())
    lines = [
        f"loops      {loops['closed']} closed, {loops['distrusted']} of them distrusted, {refused} refused"
    ]
    if fixes:
        lines.append(f"GPS        {fixes['used']} of {backend['keyframes']} keyframes have a fix")
    return lines


def _raise_if_interrupted(result: RunResult, out: Path, resumable: bool) -> None:
    error = result.interruption
    if error is None:
        return
    if isinstance(error, OSError) and error.strerror:
        # an error in write(), for example on a full disk, names no file
        place = error.filename or out
        raise LioJaxError(
            f"{place}: {error.strerror}; check the path, its permissions and the free space."
        ) from error
    done = f"the first {result.metrics['scans']} scans are in {out}"
    if error in result.unfinished:
        raise error
    if isinstance(error, KeyboardInterrupt):
        further = "; add --resume to go on" if resumable else ""
        raise LioJaxError(f"interrupted; {done}{further}.") from error
    if isinstance(error, LioJaxError):
        raise LioJaxError(f"{error} The run ended early; {done}.") from error
    raise error
