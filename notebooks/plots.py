"""The pictures of the notebooks: each function draws arrays that a cell has computed."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]

WIDTH = 7.2
"""Width of every picture, inches: a page of the site shows it without making its letters smaller."""
COLORS = ("C0", "C1", "C2")
"""Colors of x, y and z."""


class Band(NamedTuple):
    """A vector over time with its uncertainty and its true value."""

    value: Array
    """(n, 3)."""
    sigma: Array
    """(n, 3) standard deviations."""
    truth: Array
    """(n, 3)."""


class Features(NamedTuple):
    """Some points of a scan as directions from the sensor."""

    azimuth: Array
    """(n,) deg."""
    elevation: Array
    """(n,) deg."""
    color: str


def lines(
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    xlabel: str,
    ylabel: str,
    zero: bool = False,
) -> None:
    """Draw curves in one panel, with their names above it.

    Args:
        curves: x and y by name.
        xlabel: quantity and unit of x.
        ylabel: quantity and unit of y.
        zero: whether to draw the line y = 0.
    """
    figure, axes = _panels(1, 1, 3.6)
    for name, (x, y) in curves.items():
        axes[0].plot(x, y, label=name)
    if zero:
        axes[0].axhline(0.0, color="black", linewidth=0.8)
    axes[0].set(xlabel=xlabel, ylabel=ylabel)
    in_one_row = sum(len(name) + 6 for name in curves) < 80
    _legend_above(figure, axes[0], len(curves) if in_one_row else 2)
    plt.show()


def ways_on_map(points: Array, ways: Mapping[str, Array], margin: float = 20.0) -> None:
    """Draw a map from above, its heights as colors, with ways through it.

    Args:
        points: (n, 3) of the map, m.
        ways: (n, 3) positions by name, m; the first one is drawn wide and black below the others.
        margin: what is shown around the ways, m.
    """
    every = np.concatenate(list(ways.values()))[:, :2]
    (left, bottom), (right, top) = every.min(0) - margin, every.max(0) + margin
    figure, axes = _panels(1, 1, 1.8 + 0.88 * WIDTH * (top - bottom) / (right - left))
    low, high = np.percentile(points[:, 2], [2, 90])
    shade = axes[0].scatter(points[:, 0], points[:, 1], c=points[:, 2], s=1, vmin=low, vmax=high)
    for number, (name, way) in enumerate(ways.items()):
        style: dict[str, Any] = {"color": "black", "linewidth": 5} if number == 0 else {"linewidth": 1.8}
        axes[0].plot(way[:, 0], way[:, 1], label=name, **({"color": f"C{number}"} | style))
    axes[0].plot(*next(iter(ways.values()))[0, :2], "o", color="tab:red", label="start")
    axes[0].set(xlabel="x [m]", ylabel="y [m]", aspect="equal", xlim=(left, right), ylim=(bottom, top))
    _legend_above(figure, axes[0], len(ways) + 1)
    figure.colorbar(shade, ax=axes[0], label="height [m]", location="bottom", shrink=0.6, aspect=40)
    plt.show()


def drift(seconds: Array, position: Array, rotation: Array) -> None:
    """Draw the errors of a trajectory over time.

    Args:
        seconds: (n,).
        position: (n, 3) error along the vehicle's axes: forward, left, up; cm.
        rotation: (n,) angle, deg.
    """
    figure, (upper, lower) = _panels(2, 1, 4.8, sharex=True)
    for name, error, color in zip(("forward", "left", "up"), position.T, COLORS, strict=True):
        upper.plot(seconds, error, color=color, label=name)
    upper.axhline(0, color="black", linewidth=0.8)
    upper.set(ylabel="position error [cm]")
    lower.plot(seconds, rotation, color="C3")
    lower.set(xlabel="time [s]", ylabel="rotation error [deg]", ylim=(0, None))
    _legend_above(figure, upper, 3)
    plt.show()


def estimates(seconds: Array, bands: Mapping[str, Band]) -> None:
    """Draw estimated vectors with bands of two standard deviations, and their true values dashed.

    Args:
        seconds: (n,).
        bands: by quantity and unit.
    """
    figure, panels = _panels(1, len(bands), 3.6)
    for axes, (label, band) in zip(panels, bands.items(), strict=True):
        for name, value, sigma, truth, color in zip("xyz", *(one.T for one in band), COLORS, strict=True):
            axes.fill_between(
                seconds, value - 2 * sigma, value + 2 * sigma, color=color, alpha=0.1, linewidth=0
            )
            axes.plot(seconds, value, color=color, label=name)
            axes.plot(seconds, truth, "--", color=color, linewidth=1)
        spread = 3 * np.abs(band.truth).max()
        axes.set(xlabel="time [s]", ylabel=label, ylim=(-spread, spread))
    _legend_above(figure, panels[0], 3, "estimate with 2 sigma; dashed: truth")
    plt.show()


def stage_times(stages: Mapping[str, Array]) -> None:
    """Draw the computation time of each stage: its median, and its value for each scan.

    Args:
        stages: times by stage, ms.
    """
    figure, (bars, over) = _panels(1, 2, 3.2, width_ratios=(1, 1.4))
    medians = [float(np.median(ms)) for ms in stages.values()]
    drawn = bars.barh(list(stages), medians, color=[f"C{place}" for place in range(len(stages))])
    bars.bar_label(drawn, fmt=" %.2g ms")
    bars.set(xlabel="median [ms]", xlim=(0, 1.45 * max(medians)))
    bars.invert_yaxis()
    for name, ms in stages.items():
        over.plot(np.where(ms > 0, ms, np.nan), label=name)
    over.set(xlabel="scan", ylabel="time [ms]", yscale="log")
    _legend_above(figure, over, len(stages))
    plt.show()


def walls_from_above(
    scans: Mapping[str, Array], times: Array, map_means: Array, sensor: Array, half: tuple[float, float]
) -> None:
    """Draw the same points with and without motion compensation, on the means of the map's voxels.

    Args:
        scans: (n, 3) points by title, world, m.
        times: (n,) firing times, ms.
        map_means: (m, 3) world, m.
        sensor: (2,) position at the scan's end, m.
        half: half width and half height of the part that is shown, m.
    """
    figure, panels = _panels(1, len(scans), 4.4, sharex=True, sharey=True)
    for axes, (title, points) in zip(panels, scans.items(), strict=True):
        axes.plot(*map_means[:, :2].T, "+", color="0.6", markersize=6, label="means of the map's voxels")
        shade = axes.scatter(points[:, 0], points[:, 1], c=times, s=4, cmap="plasma")
        axes.plot(*sensor, "^", color="tab:green", markersize=9, label="sensor at the scan's end")
        axes.set(xlabel="x [m]", title=title, aspect="equal", **_around(sensor, half))
    panels[0].set_ylabel("y [m]")
    _legend_above(figure, panels[0], 2)
    figure.colorbar(shade, ax=panels, label="firing time [ms]", location="bottom", shrink=0.5, aspect=40)
    plt.show()


def features_on_rings(
    azimuth: Array, elevation: Array, distance: Array, features: Mapping[str, Mapping[str, Features]]
) -> None:
    """Draw a scan as azimuth against elevation, with the features that each method picks.

    Args:
        azimuth: (n,) of all points, deg.
        elevation: (n,) of all points, deg.
        distance: (n,) of all points, m.
        features: by method and kind.
    """
    figure, panels = _panels(len(features), 1, 5.6, sharex=True, sharey=True)
    for axes, (method, kinds) in zip(panels, features.items(), strict=True):
        shade = axes.scatter(azimuth, elevation, c=distance, s=1, cmap="Greys_r", vmax=40)
        for kind, found in kinds.items():
            label = f"{kind} ({len(found.azimuth)})"
            axes.plot(found.azimuth, found.elevation, ".", color=found.color, markersize=5, label=label)
        axes.set(ylabel="elevation [deg]", xlim=(180, -180))
        axes.set_title(method, loc="left")
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=3, frameon=False, borderaxespad=0.1)
        axes.grid(False)
    panels[-1].set(xlabel="azimuth [deg], 0 ahead, 90 to the left", xticks=range(180, -181, -45))
    figure.colorbar(shade, ax=panels, label="range [m]", location="bottom", shrink=0.5, aspect=40)
    plt.show()


def planes_from_above(
    mean: Array, normal: Array, thickness: Array, size: float, sensor: Array, detail: Array
) -> None:
    """Draw the outline of voxels and a line along the plane of each, colored by its thickness.

    Args:
        mean: (n, 3) of the voxels' points, world, m.
        normal: (n, 3) of their planes.
        thickness: (n,) cm.
        size: edge length of the voxels, m.
        sensor: (2,) its position, m.
        detail: (2,) middle of the detail on the right, m.
    """
    figure, panels = _panels(1, 2, 5.2, width_ratios=(1.5, 1))
    along = np.stack([-normal[:, 1], normal[:, 0]], axis=1)
    along /= np.linalg.norm(along, axis=1, keepdims=True).clip(1e-9)
    colors, scale = plt.get_cmap("viridis_r"), plt.Normalize(0, 15)
    corners = np.unique(np.floor(mean[:, :2] / size), axis=0) * size
    for axes, middle, half in zip(panels, (sensor, detail), ((21, 21), (4, 6)), strict=True):
        for corner in corners:
            outline = plt.Rectangle(corner, size, size, facecolor="none", edgecolor="0.88", linewidth=0.7)
            axes.add_patch(outline)
        for centre, direction, thick in zip(mean[:, :2], along, thickness, strict=True):
            ends = centre + np.outer([-0.5, 0.5], direction) * size
            axes.plot(*ends.T, color=colors(scale(thick)), linewidth=1.8)
        axes.plot(*sensor, "^", color="tab:red", markersize=9, label="sensor")
        axes.set(xlabel="x [m]", aspect="equal", **_around(middle, half))
        axes.grid(False)
    panels[0].set(ylabel="y [m]", title=f"{len(mean)} upright planes")
    panels[1].set(title="around the thickest")
    _legend_above(figure, panels[0], 1)
    legend = plt.cm.ScalarMappable(scale, colors)
    label = "thickness of the plane [cm]"
    figure.colorbar(legend, ax=panels, label=label, location="bottom", shrink=0.5, aspect=40)
    plt.show()


def residuals(cases: Mapping[str, Array]) -> None:
    """Draw the histogram of distances and the distribution of their absolute values.

    Args:
        cases: signed distances by name, cm.
    """
    figure, (histogram, below) = _panels(1, 2, 4.0)
    for (label, distance), color in zip(cases.items(), ("C3", "C1", "C0"), strict=True):
        bins = np.linspace(-25, 25, 101).tolist()
        histogram.hist(distance, bins, histtype="step", linewidth=1.3, color=color)
        below.plot(np.sort(np.abs(distance)), np.linspace(0, 100, len(distance)), color=color, label=label)
    histogram.set(xlabel="distance from the plane [cm]", ylabel="points", yscale="log")
    below.set(xlabel="|distance| less than [cm]", ylabel="points [%]", xlim=(0, 25), ylim=(0, 100))
    _legend_above(figure, below, 1)
    plt.show()


def tangent(factors: Array, values: Array, value: float, slope: float, name: str) -> None:
    """Draw the change of an objective by a parameter, and the tangent that a gradient gives.

    Args:
        factors: (n,) of the parameter's start value.
        values: (n,) of the objective there.
        value: of the objective at the start value.
        slope: derivative there by the parameter's logarithm.
        name: of the parameter.
    """
    figure, (axes,) = _panels(1, 1, 3.6)
    ends = np.array([factors.min(), factors.max()])
    axes.plot(ends, slope * np.log(ends), color="C1", label="tangent by the gradient")
    axes.plot(factors, values - value, "o", color="C0", label="whole runs")
    axes.plot(1, 0, "s", color="C3", label="start value")
    axes.set(xlabel=f"{name}, factor of the start value", ylabel="change of the objective", xscale="log")
    _plain_ticks(axes.xaxis, (0.7, 0.8, 1.0, 1.2, 1.5))
    _legend_above(figure, axes, 3)
    plt.show()


def tuning(values: Array, ratios: Mapping[str, Array], ends: Mapping[str, Array], best: int) -> None:
    """Draw the objective and the parameters of each evaluation of a tuning.

    Args:
        values: (n,) of the objective.
        ratios: (n,) values relative to the truth by parameter.
        ends: (2,) of the interval of the best value, relative to the truth, by parameter.
        best: number of the best evaluation.
    """
    figure, (left, right) = _panels(1, 2, 3.8, width_ratios=(1, 1.3))
    above = values - values[best]
    left.plot(above, "o-", color="C0")
    left.plot(best, above[best], "s", color="C3")
    left.set(ylabel="objective above its lowest value")
    for place, (name, ratio) in enumerate(ratios.items()):
        color, shift = f"C{place}", 0.12 * (place - (len(ratios) - 1) / 2)
        right.plot(ratio, "o-", color=color, label=name)
        right.plot([best + shift] * 2, ends[name], color=color, linewidth=5, alpha=0.3)
    right.axhline(1.0, color="black", linewidth=0.8)
    right.set(ylabel="value / truth", yscale="log")
    _plain_ticks(right.yaxis, (0.1, 0.2, 0.5, 1, 2, 3, 5, 10))
    for axes in (left, right):
        axes.set(xlabel="evaluation", xticks=range(len(values)))
    right.plot([], "s", color="C3", label="lowest objective")
    _legend_above(figure, right, len(ratios) + 1, "bars: 95 % interval")
    plt.show()


def paired(metrics: Mapping[str, Mapping[str, Mapping[str, float]]]) -> None:
    """Draw the results of variants on the same recordings: a line joins those of one recording.

    Args:
        metrics: numbers by label of the metric, by variant and by recording.
    """
    figure, panels = _panels(1, len(metrics), 3.8)
    for axes, (label, variants) in zip(panels, metrics.items(), strict=True):
        for place, recording in enumerate(next(iter(variants.values()))):
            numbers = [values[recording] for values in variants.values()]
            axes.plot(numbers, "o-", color=f"C{place}", label=recording)
        means = [np.mean(list(values.values())) for values in variants.values()]
        axes.plot(means, "_", color="black", markersize=40, markeredgewidth=2)
        axes.plot([], color="black", linewidth=2, label="mean")
        axes.set_xticks(range(len(variants)), list(variants))
        axes.set(ylabel=label, xlim=(-0.5, len(variants) - 0.5), ylim=(0, None))
    _legend_above(figure, panels[0], 4)
    plt.show()


def objective_and_gradient(x: Array, values: Array, slopes: Array, truth: float) -> None:
    """Draw an objective and its gradient over an elevation offset.

    Args:
        x: (n,) offsets, deg.
        values: (n,) of the objective, mrad^2.
        slopes: (n,) its derivative, mrad^2 / deg.
        truth: the true offset, deg.
    """
    figure, (left, right) = _panels(1, 2, 3.4)
    left.plot(x, values, "o-")
    left.set(ylabel="objective map [mrad²]")
    right.plot(x, slopes, "o-")
    right.axhline(0.0, color="black", linewidth=0.8)
    right.set(ylabel="gradient [mrad²/deg]")
    for axes in (left, right):
        axes.axvline(truth, color="C3", linewidth=1, label="true offset")
        axes.set(xlabel="elevation offset [deg]")
    _legend_above(figure, left, 1)
    plt.show()


def search(path: Array, truth: Array, xlabel: str, ylabel: str) -> None:
    """Draw the values that a search of two parameters has tried, in their order.

    Args:
        path: (n, 2).
        truth: (2,).
        xlabel: first parameter and its unit.
        ylabel: second parameter and its unit.
    """
    figure, (axes,) = _panels(1, 1, 3.8)
    axes.plot(*path.T, "o-", label="evaluations")
    axes.plot(*path[0], "s", color="black", label="start")
    axes.plot(*truth, "*", color="C3", markersize=14, label="truth")
    axes.set(xlabel=xlabel, ylabel=ylabel)
    _legend_above(figure, axes, 3)
    plt.show()


def _panels(rows: int, columns: int, height: float, **given: Any) -> tuple[Figure, list[Axes]]:
    """Return a picture of the common width and its panels."""
    figure, axes = plt.subplots(
        rows, columns, figsize=(WIDTH, height), dpi=140, layout="constrained", squeeze=False, **given
    )
    panels = list(axes.flat)
    for one in panels:
        one.grid(alpha=0.3)
        one.set_axisbelow(True)
    return figure, panels


def _legend_above(figure: Figure, axes: Axes, columns: int, title: str = "") -> None:
    """Put the names of one panel's curves above all panels, where they hide no data."""
    figure.legend(
        *axes.get_legend_handles_labels(),
        loc="outside upper center",
        ncols=columns,
        frameon=False,
        title=title or None,
    )


def _around(middle: Array, half: tuple[float, float]) -> dict[str, tuple[float, float]]:
    """Return the limits of a panel around a place."""
    (x, y), (width, height) = middle, half
    return {"xlim": (x - width, x + width), "ylim": (y - height, y + height)}


def _plain_ticks(axis: Any, ticks: Sequence[float]) -> None:
    """Label a logarithmic axis by plain numbers, those of them that lie within its limits."""
    low, high = axis.get_view_interval()
    shown = [one for one in ticks if low <= one <= high]
    axis.set_ticks(shown, [f"{one:g}" for one in shown])
    axis.set_minor_locator(plt.NullLocator())
