"""Write a run's report.html, the overview of its results; it needs only the run's folder."""

from pathlib import Path
from typing import Any

from lio_jax.core.files import atomic_path
from lio_jax.viz import run_figures
from lio_jax.viz.html import bullets, figures, folded, page, paragraph, section, table, tiles
from lio_jax.viz.run_record import RunRecord, read_run

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
            section("Environment", table(("", ""), run.metrics.get("environment", {}).items())),
            section("Configuration", folded("config.yaml, every value resolved", run.config_yaml)),
        ],
    )


def _global_correction(run: RunRecord) -> str:
    said = run.metrics.get("backend")
    if not said:
        return ""
    loops = said["loops"]
    rows = [("keyframes", said["keyframes"]), ("loops closed", loops["closed"])]
    rows += [("closed, but distrusted by the graph", loops["distrusted"])] if loops["distrusted"] else []
    rows += [(f"loops refused: {reason}", count) for reason, count in loops["refused"].items()]
    rows += [(f"GPS fixes: {reason}", count) for reason, count in said["gps"].items()]
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
    values["failed scans"] = str(len(metrics.get("failures", [])))
    return values


def _opening(run: RunRecord) -> str:
    recording: dict[str, Any] = run.metrics.get("recording", {})
    words = [recording.get("format", ""), recording.get("sensor", ""), recording.get("path", "")]
    said = ", ".join(word for word in words if word)
    return f"{said}. Motion predicted by {run.metrics.get('prediction', 'unknown')}." if said else ""


def _complaints(run: RunRecord) -> list[str]:
    metrics = run.metrics
    failures = [failure["message"] for failure in metrics.get("failures", [])]
    hidden = len(failures) - _FAILURES_SHOWN
    said = [*metrics.get("warnings", []), *run.remarks, *failures[:_FAILURES_SHOWN]]
    if hidden > 0:
        said.append(f"{hidden} more failed scans; metrics.json lists them all.")
    return [bullets(said, bad=True) or paragraph("None.")]


def _metres(value: float | None) -> str:
    return "not finite" if value is None else f"{value:.3g} m"
