"""HTML reports: of one run, and of several runs next to each other."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lio_jax.core.errors import UsageError
from lio_jax.core.files import atomic_path
from lio_jax.evaluation.trajectory_error import position_errors
from lio_jax.run.verdict import in_words
from lio_jax.viz import run_figures
from lio_jax.viz.html import bullets, figure, figures, folded, page, paragraph, section, table, tiles
from lio_jax.viz.run_figures import relative_error_groups, way_of
from lio_jax.viz.run_record import RunRecord, read_run
from lio_jax.viz.svg import Line, box_chart, empty, equal_axes, line_chart, plan_chart

_FAILURES_SHOWN = 50


def write_report(folder: Path, out: Path | None = None) -> Path:
    """Write the report of a run folder and return its path.

    Args:
        folder: folder of a run.
        out: file to write; None: report.html in the folder.

    Raises:
        LioJaxError: the folder is not a run's, or a file of it is damaged.
    """
    path = out or folder / "report.html"
    text = run_report(read_run(folder))
    with atomic_path(path) as aside:
        aside.write_text(text, encoding="utf-8")
    return path


def run_report(run: RunRecord) -> str:
    """Return the report of one run as HTML."""
    compared = run.comparison
    environment = [(name, str(value)) for name, value in run.metrics.get("environment", {}).items()]
    return page(
        f"lio-jax: {run.title}",
        [
            paragraph(_opening(run), soft=True),
            tiles(headline(run)),
            section("Warnings and failures", *_complaints(run)),
            section("Trajectory", figures(*run_figures.from_above(run), run_figures.from_the_side(run))),
            _global_correction(run),
            section("Errors", figures(*run_figures.errors(run, compared))) if compared else "",
            section("Drift", figures(*run_figures.relative_error_boxes(compared))) if compared else "",
            section("What the filter believed", figures(*run_figures.belief(run))),
            section("Matching", figures(*run_figures.matching(run))),
            section("Time", figures(*run_figures.times(run))),
            section("Notes", bullets(run.metrics.get("notes", []))),
            section("Environment", table(("", ""), environment)),
            section("Configuration", folded("config.yaml, every value resolved", run.config_yaml)),
        ],
    )


def _global_correction(run: RunRecord) -> str:
    backend = run.metrics.get("backend")
    if not backend:
        return ""
    loops = backend["loops"]
    rows = [("keyframes", backend["keyframes"]), ("loops closed", loops["closed"])]
    rows += [("closed, but distrusted by the graph", loops["distrusted"])] if loops["distrusted"] else []
    rows += [(f"loops refused: {reason}", count) for reason, count in loops["refused"].items()]
    rows += [(f"GPS fixes: {reason}", count) for reason, count in backend["gps"].items()]
    return section(
        "Global correction",
        table(("", ""), [(name, str(count)) for name, count in rows]),
        figures(*run_figures.loops_closed(run)),
    )


def headline(run: RunRecord) -> dict[str, str]:
    """Return the most important numbers by name, as text with units."""
    metrics = run.metrics
    total = metrics.get("scan_ms", {}).get("total", {})
    values: dict[str, str] = {
        "scans": str(metrics.get("scans", "")),
        "travelled": f"{run.distance[-1]:.1f} m",
        "duration": f"{run.seconds[-1]:.1f} s",
    }
    if ate := metrics.get("ate"):
        values["ATE rmse"] = _metres(ate.get("rmse"))
        values["ATE largest"] = _metres(ate.get("max"))
    for key, name in (("kitti", "drift, KITTI segments"), ("kitti_short_10_80m", "drift over 10 to 80 m")):
        if segments := metrics.get(key):
            values[name] = f"{segments['translation_percent']:.2f} %"
    if total:
        values |= {"a scan, median": f"{total['median']:.1f} ms", "a scan, 95 %": f"{total['p95']:.1f} ms"}
    for key, name, unit in (
        ("compile_s", "compiling", "s"),
        ("wall_s", "in all", "s"),
        ("peak_rss_mb", "memory, peak", "MiB"),
    ):
        if key in metrics:
            values[name] = f"{metrics[key]:.{0 if unit == 'MiB' else 1}f} {unit}"
    if "verdict" in metrics:
        values["verdict"] = in_words(metrics["verdict"])
    values["failed scans"] = str(len(metrics.get("failures", [])))
    return values


def _opening(run: RunRecord) -> str:
    recording: dict[str, Any] = run.metrics.get("recording", {})
    words = [recording.get("format", ""), recording.get("sensor", ""), recording.get("path", "")]
    summary = ", ".join(str(word) for word in words if word)
    return f"{summary}. Motion predicted by {run.metrics.get('prediction', 'unknown')}." if summary else ""


def _complaints(run: RunRecord) -> list[str]:
    metrics = run.metrics
    failures = [failure["message"] for failure in metrics.get("failures", [])]
    hidden = len(failures) - _FAILURES_SHOWN
    reasons = metrics.get("verdict", {}).get("reasons", [])
    messages = [*reasons, *metrics.get("warnings", []), *run.remarks, *failures[:_FAILURES_SHOWN]]
    if hidden > 0:
        messages.append(f"{hidden} more failed scans; metrics.json lists them all.")
    return [bullets(messages, bad=True) or paragraph("None.")]


def _metres(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.3g} m"


def write_comparison(folders: Sequence[Path], out: Path) -> None:
    """Write a page that compares the runs of several folders.

    Raises:
        LioJaxError: a folder is not a run's, or a file of it is damaged.
        UsageError: a folder is given twice.
    """
    if len({folder.resolve() for folder in folders}) < len(folders):
        raise UsageError("the same folder is given twice; a run compared with itself shows nothing.")
    text = comparison([read_run(folder) for folder in folders])
    with atomic_path(out) as aside:
        aside.write_text(text, encoding="utf-8")


def comparison(runs: Sequence[RunRecord]) -> str:
    """Return the page as HTML."""
    names = _names(runs)
    legend = [(name, number) for number, name in enumerate(names)]
    return page(
        f"lio-jax: {len(runs)} runs compared",
        [
            section("Numbers", _numbers(names, runs)),
            section("What was set differently", _differences(names, runs)),
            section("Trajectory", figures(_from_above(runs, legend), _heights(runs, legend))),
            section("Errors", figures(*_errors(runs, legend), *_drift(names, runs))),
            section("Time", figures(_times(names, runs))),
            section("Complaints", *_complaints_of(names, runs)),
        ],
    )


def _names(runs: Sequence[RunRecord]) -> list[str]:
    """Return the folders' names, with as much of their paths as makes them unique."""
    parts = [run.folder.resolve().parts for run in runs]
    for length in range(1, max(map(len, parts)) + 1):
        names = ["/".join(part[-length:]) for part in parts]
        if len(set(names)) == len(names):
            return names
    return [str(run.folder) for run in runs]


def _numbers(names: list[str], runs: Sequence[RunRecord]) -> str:
    values = [{"recipe": str(run.config.get("recipe", ""))} | headline(run) for run in runs]
    rows = list(dict.fromkeys(name for numbers in values for name in numbers))
    recordings = {str(run.metrics.get("recording", {}).get("name")) for run in runs}
    warning = "These runs are of different recordings: " + ", ".join(sorted(recordings)) + "."
    numbers = table(("", *names), [(row, *(numbers.get(row, "-") for numbers in values)) for row in rows])
    return (paragraph(warning) if len(recordings) > 1 else "") + numbers


def _differences(names: list[str], runs: Sequence[RunRecord]) -> str:
    leaves = [_leaves(run.config) for run in runs]
    paths = dict.fromkeys(path for values in leaves for path in values)
    rows = [
        (path, *(_text(values.get(path, "-")) for values in leaves))
        for path in paths
        if len({str(values.get(path)) for values in leaves}) > 1
    ]
    return table(("", *names), rows) if rows else paragraph("Nothing: the settings are the same.")


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _leaves(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    found: dict[str, Any] = {}
    for key, value in tree.items():
        found |= _leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return found


def _from_above(runs: Sequence[RunRecord], legend: list[tuple[str, int]]) -> str:
    lines = []
    for number, run in enumerate(runs):
        xy = run.trajectory.positions
        lines.append(Line(xy[:, 0], xy[:, 1], number))
    compared = next((run.comparison for run in runs if run.comparison), None)
    if compared:
        xy = compared.truth.positions
        lines.append(Line(xy[:, 0], xy[:, 1], 7, dashed=True))
        legend = [*legend, ("truth, aligned with the first run that has it", 7)]
    axes = equal_axes([line.x for line in lines], [line.y for line in lines])
    svg = empty("no pose is finite") if axes is None else plan_chart(axes, lines, "x [m]", "y [m]")
    return figure(
        "From above", svg, "Each in its own world, which begins at its first pose.", legend, wide=True
    )


def _heights(runs: Sequence[RunRecord], legend: list[tuple[str, int]]) -> str:
    lines = [Line(run.distance, run.trajectory.positions[:, 2], number) for number, run in enumerate(runs)]
    svg = line_chart(lines, "distance travelled [m]", "z [m]")
    return figure("From the side", svg, "Height over the way.", legend)


def _errors(runs: Sequence[RunRecord], legend: list[tuple[str, int]]) -> list[str]:
    lines, known = [], []
    for number, run in enumerate(runs):
        if not run.comparison:
            continue
        matched = run.comparison.matched
        metres = position_errors(run.comparison.alignment, matched.estimate.poses, matched.reference.poses)
        lines.append(Line(way_of(run, matched.estimate), metres, number))
        known.append(legend[number])
    if not lines:
        return []
    svg = line_chart(lines, "distance travelled [m]", "position error [m]", from_zero=True)
    return [figure("Position error over distance", svg, "Each aligned on its own.", known)]


def _drift(names: list[str], runs: Sequence[RunRecord]) -> list[str]:
    groups = {
        name: relative_error_groups(run.comparison)
        for name, run in zip(names, runs, strict=True)
        if run.comparison
    }
    shared = set.intersection(*(set(metres) for metres, _ in groups.values())) if groups else set()
    if not shared:
        return []
    length = max(shared, key=lambda name: float(name.split()[0]))
    series = [number for number, name in enumerate(names) if name in groups]
    caption = f"Over {length} from every pose on; box: quartiles, whiskers: 5 and 95 %, dot: largest."
    return [
        figure(
            title,
            box_chart({name: group[kind][length] for name, group in groups.items()}, unit, series),
            caption,
        )
        for kind, (title, unit) in enumerate(
            (("Relative position error", "error [% of the way]"), ("Relative attitude error", "error [deg]"))
        )
    ]


def _times(names: list[str], runs: Sequence[RunRecord]) -> str:
    totals = {
        name: np.asarray(run.scans["total_ms"])
        for name, run in zip(names, runs, strict=True)
        if "total_ms" in run.scans
    }
    series = [number for number, name in enumerate(names) if name in totals]
    caption = "Box: quartiles, whiskers: 5 and 95 %, dot: largest."
    return figure("Time of a scan", box_chart(totals, "time [ms]", series), caption) if totals else ""


def _complaints_of(names: list[str], runs: Sequence[RunRecord]) -> list[str]:
    messages = []
    for name, run in zip(names, runs, strict=True):
        failures = len(run.metrics.get("failures", []))
        messages += [f"{name}: {failures} failed scans"] * (failures > 0)
        verdict = run.metrics.get("verdict", {})
        if verdict.get("state", "sound") != "sound":
            messages.append(f"{name}: {in_words(verdict)}")
        sentences = (*verdict.get("reasons", []), *run.metrics.get("warnings", []), *run.remarks)
        messages += [f"{name}: {sentence}" for sentence in sentences]
    return [bullets(messages, bad=True) or paragraph("None.")]
