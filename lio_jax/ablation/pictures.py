"""Pictures of an ablation as data URIs: a parameter against the error, and error against time."""

import base64
import io
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SIZE = (5.2, 3.6)
_DARK, _LIGHT = "#1f5f8b", "#9db8cc"
_LABELLED = 12
"""More names than this cover each other."""


def parameter_picture(path: str, values: Mapping[Any, list[float]], error: str) -> str:
    """Draw the error over a parameter's values: every run, and the mean of each value.

    Args:
        path: of the parameter.
        values: its value -> errors of all runs that had it.
        error: label of the error's axis.

    Returns:
        An SVG as a data URI.
    """
    figure, axes = _axes()
    numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    points = sorted(values) if numeric else list(values)
    places = np.array(points, float) if numeric else np.arange(len(points), dtype=float)
    for place, point in zip(places, points, strict=True):
        axes.plot([place] * len(values[point]), values[point], ".", color=_LIGHT, markersize=5)
    axes.plot(places, [np.mean(values[point]) for point in points], "o-" if numeric else "o", color=_DARK)
    if not numeric:
        axes.set_xticks(places, [_plain(str(point)) for point in points], rotation=20, ha="right")
    elif places.min() > 0 and places.max() / places.min() > 20:
        axes.set_xscale("log")
    everything = [value for found in values.values() for value in found]
    if min(everything) > 0 and max(everything) / min(everything) > 20:
        axes.set_yscale("log")
    axes.set_xlabel(_plain(path))
    axes.set_ylabel(_plain(error))
    return _uri(figure)


def pareto_picture(points: Mapping[str, tuple[float, float]], time: str, error: str) -> str:
    """Draw the variants by what they cost and how much they err, and the front that none beats in both.

    Args:
        points: variant -> (time, error), finite.
        time: label of the time's axis.
        error: label of the error's axis.

    Returns:
        An SVG as a data URI.
    """
    figure, axes = _axes()
    front = pareto_front(points)
    for name, (x, y) in points.items():
        axes.plot(x, y, "o", color=_DARK if name in front else _LIGHT)
        if name in front or len(points) <= _LABELLED:
            axes.annotate(_plain(name), (x, y), xytext=(4, 4), textcoords="offset points", fontsize=7)
    corners = np.array([points[name] for name in front])
    axes.step(corners[:, 0], corners[:, 1], where="post", color=_DARK, linewidth=1)
    axes.set_xlabel(_plain(time))
    axes.set_ylabel(_plain(error))
    return _uri(figure)


def pareto_front(points: Mapping[str, tuple[float, float]]) -> list[str]:
    """Return the names that none beats in both numbers, by rising first number."""
    front, best = [], math.inf
    for name in sorted(points, key=lambda name: points[name]):
        if points[name][1] < best:
            front.append(name)
            best = points[name][1]
    return front


def _axes() -> "tuple[Figure, Axes]":
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE, layout="constrained")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    return figure, axes


def _plain(text: str) -> str:
    """Keep matplotlib from reading a name as mathematics."""
    return text.replace("$", r"\$")


def _uri(figure: "Figure") -> str:
    from matplotlib import rc_context

    buffer = io.BytesIO()
    # the same results give the same bytes
    with rc_context({"svg.hashsalt": "lio_jax", "svg.fonttype": "none", "font.family": "sans-serif"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(buffer.getvalue()).decode()
