"""Commands that look at recordings and results: inspect, eval, report and view."""

import json
from pathlib import Path

from lio_jax.commands.runtime import say
from lio_jax.core.errors import UsageError
from lio_jax.core.files import atomic_path
from lio_jax.data.detect import open_sequence
from lio_jax.evaluation.evaluate import evaluate_files, format_evaluation
from lio_jax.evaluation.gps_error import evaluate_gps_files, format_gps_evaluation
from lio_jax.inspection import format_inspection, inspect_sequence, settings_text
from lio_jax.settings.settings import Settings, load_settings, with_overrides
from lio_jax.viz.viewer import served, show


def evaluate(
    estimate: Path, reference: Path | None, gps: Path | None, assignments: tuple[str, ...], as_json: bool
) -> None:
    """Print the errors against a reference or against GPS fixes as a table, or as one JSON object."""
    if (reference is None) == (gps is None):
        raise UsageError("eval: needs either REFERENCE or --gps DATA; --help explains the command.")
    if gps is not None:
        _evaluate_gps(estimate, gps, assignments, as_json)
        return
    if assignments:
        raise UsageError("eval: --set has an effect with --gps only; leave it out.")
    assert reference is not None
    evaluation = evaluate_files(estimate, reference)
    print(json.dumps(evaluation.as_dict(), allow_nan=False) if as_json else format_evaluation(evaluation))


def _evaluate_gps(estimate: Path, gps: Path, assignments: tuple[str, ...], as_json: bool) -> None:
    is_odometry = estimate.name == "odometry.tum"
    resolved = (estimate.parent if is_odometry else estimate) / "config.yaml"
    of_run = load_settings(resolved) if resolved.is_file() else Settings()
    settings = with_overrides(of_run, assignments)
    corrected = of_run.run.backend.gps and not is_odometry
    found = evaluate_gps_files(estimate, gps, settings, used_by_run=corrected)
    print(json.dumps(found.as_dict(), allow_nan=False) if as_json else format_gps_evaluation(found))


def inspect(
    data: Path, assignments: tuple[str, ...], as_json: bool, config: Path | None, overwrite: bool
) -> None:
    """Print the results as a table or as one JSON object, and write the settings that fit."""
    if config is not None and config.exists() and not overwrite:
        raise UsageError(f"{config}: exists; choose another file or add --overwrite.")
    settings = with_overrides(Settings(), assignments)
    found = inspect_sequence(open_sequence(data, settings.run.data), settings)
    print(json.dumps(found.to_dict(), allow_nan=False) if as_json else format_inspection(found))
    if config is not None:
        with atomic_path(config) as aside:
            aside.write_text(settings_text(found))
        say(f"note: {config}: for lio-jax run {data} --recipe {config}")


def report(folders: tuple[Path, ...], out: Path | None) -> None:
    """Write the page and print where it is."""
    if not folders:
        raise UsageError("report: needs DIR [DIR ...]; --help explains the command.")
    if out is not None and out.is_dir():
        raise UsageError(f"{out}: is a folder; give a file such as {out / 'report.html'}.")
    if len(folders) == 1:
        from lio_jax.viz.report import write_report

        print(write_report(folders[0], out))
        return
    if out is None:
        raise UsageError("report: needs --out FILE.html to compare several runs.")
    from lio_jax.viz.report import write_comparison

    write_comparison(folders, out)
    print(out)


def view(path: Path, web: bool) -> None:
    """Show a run folder or an .rrd file in a window, or serve it to a browser until Ctrl-C."""
    recording = path / "recording.rrd" if path.is_dir() else path
    if not recording.is_file():
        raise UsageError(f"{recording}: is not there; give a folder that lio-jax run wrote, or an .rrd.")
    if not web:
        show(recording)
        return
    with served(recording) as server:
        try:
            say(f"open {server.page}\nCtrl-C ends it.")
            server.process.wait()
        except KeyboardInterrupt:
            return
