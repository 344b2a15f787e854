"""Trajectory and timing pictures as PNG, drawn without pyplot: no global state, no display, a fast import."""

from collections.abc import Mapping
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path
from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.alignment import align, position_errors
from lio_jax.evaluation.association import match_by_time

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ESTIMATE = "tab:blue"
_TRUTH = "tab:green"
# Below these spans (m) an axis would show nothing but rounding noise.
_MIN_SPAN_M = 0.01


def plot_trajectory(path_png: Path, estimate: Trajectory, truth: Trajectory | None, title: str) -> None:
    """Draw the way from above, the height over time and, where truth is known, the error over time.

    The truth is laid into the estimate's world by the same alignment the absolute error uses. Truth that
    shares no instant with the estimate is left out, and the picture says so.

    Args:
        path_png: file to write, whole or not at all.
        estimate: T_world_body, z up, at least one pose.
        truth: of the same body frame, any world.
        title: shown above.
    """
    figure = _figure(12.0, 6.5)
    figure.suptitle(title)
    try:
        matched = None if truth is None else match_by_time(estimate, truth, "the estimate", "the truth")
    except LioJaxError as reason:
        matched = None
        figure.supxlabel(fill(f"Truth is not shown. {reason}", 120), fontsize="small", color="tab:red")
    grid = figure.add_gridspec(2, 2, width_ratios=(1.35, 1.0))
    top = figure.add_subplot(grid[:, 0])
    height = figure.add_subplot(grid[:, 1] if matched is None else grid[0, 1])
    seconds = _seconds(estimate, estimate)
    _line(top, estimate.positions[:, 0], estimate.positions[:, 1], _ESTIMATE, "estimate")
    _line(height, seconds, estimate.positions[:, 2], _ESTIMATE, "estimate")
    shown = estimate.positions
    if matched is not None:
        alignment = align(matched.estimate.poses, matched.reference.poses)
        laid = (np.linalg.inv(alignment.T_reference_estimate) @ matched.reference.poses)[:, :3, 3]
        shown = np.concatenate([shown, laid])
        seconds = _seconds(matched.reference, estimate)
        _line(top, laid[:, 0], laid[:, 1], _TRUTH, "truth, aligned", dashed=True)
        _line(height, seconds, laid[:, 2], _TRUTH, "truth, aligned", dashed=True)
        errors = position_errors(alignment, matched.estimate.poses, matched.reference.poses)
        error = figure.add_subplot(grid[1, 1])
        _line(error, seconds, errors, "tab:red", f"rmse {float(np.sqrt(np.mean(errors**2))):.3g} m")
        error.set_ylim(bottom=0.0)
        how = "by the first pose" if alignment.method == "first_pose" else "by least squares"
        _label(error, "time [s]", "position error [m]", f"error, aligned {how}")
    _mark_ends(top, estimate.positions)
    _frame_top_view(top, shown)
    _frame_height(height, shown[:, 2])
    _label(top, "x [m]", "y [m]", "from above")
    _label(height, "time [s]", "z [m]", "height")
    _save(figure, path_png)


def plot_timings(path_png: Path, stage_ms: Mapping[str, ArrayLike]) -> None:
    """Draw each stage's time over the scans, and the median, 95th and 99th percentile of each.

    Args:
        path_png: file to write, whole or not at all.
        stage_ms: ms per scan, one array per stage; values that are not finite are left out.
    """
    values = {name: np.atleast_1d(np.asarray(times, np.float64)) for name, times in stage_ms.items()}
    values = {name: times for name, times in values.items() if np.isfinite(times).any()}
    figure = _figure(12.0, 4.8)
    over_scans, summary = figure.subplots(1, 2, width_ratios=(1.5, 1.0))
    if not values:
        figure.suptitle("no scan was timed")
        _save(figure, path_png)
        return
    colours = [f"C{index % 10}" for index in range(len(values))]
    for (name, times), colour in zip(values.items(), colours, strict=True):
        _line(over_scans, np.arange(float(len(times))), times, colour, name, width=0.9)
    limit = 1.5 * max(float(np.nanpercentile(times[np.isfinite(times)], 95.0)) for times in values.values())
    beyond = sum(int(np.sum(times > limit)) for times in values.values())
    over_scans.set_ylim(0.0, limit if limit > 0.0 else 1.0)
    subtitle = f"time of each scan ({beyond} off the scale)" if beyond else "time of each scan"
    _label(over_scans, "scan", "time [ms]", subtitle)
    rows = np.arange(len(values))[::-1]
    labels = []
    for row, (name, times), colour in zip(rows, values.items(), colours, strict=True):
        median, p95, p99 = np.percentile(times[np.isfinite(times)], [50.0, 95.0, 99.0])
        summary.barh(row, median, color=colour, height=0.6)
        summary.plot([median, p95], [row, row], color="black", linewidth=1.0)
        summary.plot([p95], [row], "|", color="black", markersize=10)
        summary.plot([p99], [row], ".", color="black", markersize=4)
        labels.append(f"{name}\n{median:.3g} ms")
    summary.set_yticks(rows, labels)
    summary.set_xlim(left=0.0)
    summary.set_xlabel("time [ms]")
    summary.set_title("median (bar), 95 % (tick), 99 % (dot)", fontsize="medium")
    summary.grid(True, axis="x", alpha=0.3)
    _save(figure, path_png)


def _figure(width: float, height: float) -> "Figure":
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=110, layout="constrained")


def _save(figure: "Figure", path_png: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    with atomic_path(path_png) as aside:
        FigureCanvasAgg(figure).print_png(str(aside))


def _seconds(trajectory: Trajectory, origin: Trajectory) -> NDArray[np.float64]:
    return (trajectory.stamp_ns - origin.stamp_ns[0]) * 1e-9


def _line(
    axes: "Axes",
    x: NDArray[np.floating],
    y: NDArray[np.floating],
    colour: str,
    label: str,
    *,
    dashed: bool = False,
    width: float = 1.5,
) -> None:
    style = "--" if dashed else "-"
    marker = "o" if len(x) == 1 else None
    axes.plot(x, y, style, color=colour, label=label, marker=marker, markersize=4, linewidth=width)


def _mark_ends(axes: "Axes", positions: NDArray[np.float64]) -> None:
    axes.plot(*positions[0, :2], "o", color="black", markersize=5, label="start", zorder=4)
    if len(positions) > 1:
        axes.plot(*positions[-1, :2], "s", color="tab:red", markersize=5, label="end", zorder=4)


def _frame_top_view(axes: "Axes", positions: NDArray[np.float64]) -> None:
    finite = positions[np.isfinite(positions).all(axis=1), :2]
    low, high = (finite.min(axis=0), finite.max(axis=0)) if len(finite) else (np.zeros(2), np.zeros(2))
    centre, half = (low + high) / 2, np.maximum((high - low) / 2, _MIN_SPAN_M / 2)
    axes.update_datalim([centre - half, centre + half])
    axes.set_aspect("equal", adjustable="datalim")
    axes.autoscale_view()


def _frame_height(axes: "Axes", values: NDArray[np.float64]) -> None:
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return
    centre = (float(finite.min()) + float(finite.max())) / 2
    half = max((float(finite.max()) - float(finite.min())) * 0.55, _MIN_SPAN_M / 2)
    axes.set_ylim(centre - half, centre + half)


def _label(axes: "Axes", x: str, y: str, title: str) -> None:
    axes.set_xlabel(x)
    axes.set_ylabel(y)
    axes.set_title(title, fontsize="medium")
    axes.grid(True, alpha=0.3)
    axes.ticklabel_format(useOffset=False)
    axes.legend(loc="best", fontsize="small")
