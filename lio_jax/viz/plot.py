"""Plots by matplotlib: trajectories, times, tunings and Allan deviations."""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path
from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.association import match_by_time
from lio_jax.evaluation.trajectory_error import align, position_errors
from lio_jax.imu.allan import NoiseFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ESTIMATE = "tab:blue"
_TRUTH = "tab:green"
# Below these spans (m) an axis would show rounding noise only.
_MIN_SPAN_M = 0.01


def plot_trajectory(path_png: Path, estimate: Trajectory, truth: Trajectory | None, title: str) -> None:
    """Draw the path from above, the height over time and, where truth is known, the error over time.

    The truth is aligned with the estimate's world in the same way as for the absolute error. Truth that
    shares no instant with the estimate is left out; the picture then states this.

    Args:
        path_png: file to write, complete or not at all.
        estimate: T_world_body, z up, at least one pose.
        truth: true poses of the same body frame, in any world.
        title: title of the picture, plain text.
    """
    figure = _figure(12.0, 6.5)
    figure.suptitle(title, parse_math=False)
    try:
        matched = None if truth is None else match_by_time(estimate, truth, "the estimate", "the truth")
    except LioJaxError as reason:
        matched = None
        figure.supxlabel(
            fill(f"Truth is not shown. {reason}", 120), fontsize="small", color="tab:red", parse_math=False
        )
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
    """Draw each stage's time over the scans, and the median, 95th and 99th percentile of each stage.

    Args:
        path_png: file to write, complete or not at all.
        stage_ms: time per scan, ms, one array for each stage; values that are not finite are left out.
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

    with atomic_path(path_png) as aside, letters_may_lack():
        FigureCanvasAgg(figure).print_png(str(aside))


@contextmanager
def letters_may_lack() -> Iterator[None]:
    """Let pictures show a box for a letter that the font lacks, without a warning."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from font")
        yield


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


def plot_tuning(
    path_png: Path,
    losses: Mapping[str, NDArray[np.float64]],
    parameters: Mapping[str, NDArray[np.float64]],
    intervals: Mapping[str, tuple[float, float]],
    best: int,
    counted: str = "evaluation",
) -> None:
    """Draw losses and parameters over the evaluations or epochs, with one panel for each parameter.

    Args:
        path_png: file to write, complete or not at all.
        losses: (n,) losses by name.
        parameters: (n,) values by name; positive ones are drawn on a log scale.
        intervals: 95 % interval of the best value by name, where known.
        best: index of the evaluation that was taken.
        counted: what the values are of; the first one is number 0.
    """
    panels = 1 + len(parameters)
    columns = min(3, panels)
    rows = -(-panels // columns)
    figure = _figure(4.2 * columns, 3.0 * rows)
    axes = np.ravel(figure.subplots(rows, columns, squeeze=False))
    for name, values in losses.items():
        axes[0].plot(values, ".-", label=name)
    axes[0].set_title("loss", fontsize="medium")
    axes[0].legend(fontsize="small")
    for panel, (name, values) in zip(axes[1:], parameters.items(), strict=False):
        panel.plot(values, ".-", color="tab:blue")
        if np.all(values > 0):
            panel.set_yscale("log")
        if name in intervals:
            low, high = intervals[name]
            panel.axhspan(low, high, color="tab:blue", alpha=0.15, label="95 % interval")
            panel.legend(fontsize="small")
        panel.set_title(name, fontsize="medium")
    for panel in axes[:panels]:
        panel.axvline(best, color="k", linewidth=0.8, linestyle=":")
        panel.set_xlabel(counted)
        panel.grid(True, which="both", alpha=0.25)
    for panel in axes[panels:]:
        panel.set_axis_off()
    _save(figure, path_png)


class Noise(Protocol):
    """The noise analysis of one sensor, as it is drawn."""

    @property
    def tau(self) -> NDArray[np.float64]:
        """Averaging times, (k,) s."""
        ...

    @property
    def deviation(self) -> NDArray[np.float64]:
        """Allan deviation of each axis, (k, 3), in the sensor's unit."""
        ...

    @property
    def combined(self) -> NoiseFit:
        """Fit to the mean variance of the axes."""
        ...


def plot_allan(path_png: Path, noises: Mapping[str, Noise], title: str) -> None:
    """Draw each sensor's Allan deviation, the fit, and the two densities at the times where they are read.

    Args:
        path_png: file to write, complete or not at all.
        noises: noise analyses by name and unit.
        title: title of the picture, plain text.
    """
    figure = _figure(6.0 * len(noises), 5.0)
    figure.suptitle(title, parse_math=False)
    for axes, (name, noise) in zip(np.ravel(figure.subplots(1, len(noises))), noises.items(), strict=True):
        fit = noise.combined
        for axis, colour in enumerate(("tab:red", "tab:green", "tab:blue")):
            axes.loglog(
                noise.tau, noise.deviation[:, axis], ".-", color=colour, label="xyz"[axis], markersize=3
            )
        low, high = float(np.nanmin(noise.deviation)), float(np.nanmax(noise.deviation))
        span = np.geomspace(min(noise.tau[0], 1.0), max(noise.tau[-1], 3.0), 200)
        axes.loglog(span, fit.deviation(span), "k-", linewidth=2.0, label="fit, axes combined", alpha=0.7)
        white = f"white noise {fit.white:.2e}/sqrt(Hz)"
        axes.loglog(span, fit.white / np.sqrt(span), "k:", label=white)
        axes.plot(1.0, fit.white, "ko", markersize=5)
        if fit.walk is not None:
            walk = f"bias random walk {fit.walk:.2e}/s/sqrt(Hz)"
            axes.loglog(span, fit.walk * np.sqrt(span / 3), "k--", label=walk)
            axes.plot(3.0, fit.walk, "ks", markersize=5)
            low = min(low, fit.walk)
        axes.set_ylim(low / 2, high * 2)
        axes.set_xlabel("averaging time [s]")
        axes.set_ylabel("Allan deviation")
        axes.set_title(name, fontsize="medium")
        axes.grid(True, which="both", alpha=0.25)
        axes.legend(loc="best", fontsize="small")
    _save(figure, path_png)
