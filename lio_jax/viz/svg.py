"""Charts as inline SVG: small, sharp at any size, coloured by the page's style.

Curves are thinned to what can be seen, so a chart's size does not grow with the recording's length.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lio_jax.viz.html import series_colour
from lio_jax.viz.svg_axes import WIDTH, Axes, axes_of, frame

_SERIES_POINTS = 800
_PATH_POINTS = 4000
_CELL = 0.4
"""Consecutive points of a path closer than this are one, drawing units."""


@dataclass(frozen=True)
class Line:
    """One curve; values that are not finite interrupt it."""

    x: NDArray[np.floating]
    y: NDArray[np.floating]
    series: int = 0
    """Number of its colour."""
    dashed: bool = False
    sigma: NDArray[np.floating] | None = field(default=None)
    """Half height of a band around it."""


def line_chart(
    lines: Sequence[Line],
    x_label: str,
    y_label: str,
    *,
    band: tuple[NDArray, NDArray, NDArray] | None = None,
    marks: Sequence[float] = (),
    from_zero: bool = False,
    log: bool = False,
) -> str:
    """Draw curves over a shared axis.

    Args:
        lines: the curves.
        x_label: quantity and unit.
        y_label: quantity and unit.
        band: x, low and high of a shaded range.
        marks: x of upright strokes, such as failed scans.
        from_zero: let the scale begin at zero.
        log: logarithmic scale; values that are not positive are left out.
    """
    xs, ys = [line.x for line in lines], [line.y for line in lines]
    for line in lines:
        if line.sigma is not None:
            ys += [line.y - line.sigma, line.y + line.sigma]
    if band is not None:
        xs, ys = [*xs, band[0]], [*ys, *band[1:]]
    axes = axes_of(xs, ys, from_zero=from_zero, log=log)
    if axes is None:
        return empty("no values")
    drawn = [frame(axes, x_label, y_label)]
    if band is not None:
        drawn.append(_ribbon(axes, *band, series=7))
    for line in lines:
        if line.sigma is not None:
            drawn.append(_ribbon(axes, line.x, line.y - line.sigma, line.y + line.sigma, line.series))
    for mark in marks:
        place = axes.x(np.array([mark]))[0]
        stroke = f"M{place:.1f} {axes.top}V{axes.bottom}"
        drawn.append(f'<path class="curve" stroke="var(--bad)" opacity=".5" d="{stroke}"/>')
    drawn += [curve(axes, line) for line in lines]
    return _svg(drawn, f"{y_label} over {x_label}", axes)


def plan_chart(axes: Axes, lines: Sequence[Line], x_label: str, y_label: str, behind: str = "") -> str:
    """Draw paths with their start (dot), over a picture that fills the axes.

    Args:
        axes: of one scale in both directions.
        lines: the paths.
        x_label: quantity and unit.
        y_label: quantity and unit.
        behind: address of the picture, such as a data URI.
    """
    drawn = [frame(axes, x_label, y_label)]
    if behind:
        size = f'width="{axes.right - axes.left:.1f}" height="{axes.bottom - axes.top:.1f}"'
        drawn.append(
            f'<image x="{axes.left}" y="{axes.top}" {size} preserveAspectRatio="none" href="{behind}"/>'
        )
    drawn += [curve(axes, line) for line in lines]
    for line in lines:
        started = np.flatnonzero(np.isfinite(line.x) & np.isfinite(line.y))[:1]
        for x, y in zip(axes.x(line.x[started]), axes.y(line.y[started]), strict=True):
            drawn.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{series_colour(line.series)}"/>')
    return _svg(drawn, f"{y_label} over {x_label}", axes)


def stack_chart(parts: Mapping[str, NDArray[np.floating]], x: NDArray, x_label: str, y_label: str) -> str:
    """Draw quantities on top of each other, the first at the bottom; each is non-negative, over ``x``.

    The scale ends at the sum's 99th percentile, so that a single slow scan does not flatten all others.
    """
    layers = (
        np.cumsum([np.nan_to_num(values) for values in parts.values()], axis=0) if parts else np.zeros((0, 0))
    )
    if layers.size == 0:
        return empty("no values")
    limit = float(np.percentile(layers[-1], 99)) * 1.1
    layers = np.minimum(layers, limit)
    axes = axes_of([x], [np.array([0.0, limit])], from_zero=True)
    if axes is None:
        return empty("no values")
    drawn = [frame(axes, x_label, y_label)]
    below = np.zeros_like(layers[0])
    for number, layer in enumerate(layers):
        drawn.append(_ribbon(axes, x, below, layer, number, kind="area"))
        below = layer
    return _svg(drawn, f"{y_label} over {x_label}", axes)


def box_chart(groups: Mapping[str, NDArray[np.floating]], y_label: str, series: Sequence[int] = ()) -> str:
    """Draw each group's quartiles (box), median (stroke), 5 and 95 % (whiskers) and maximum (dot)."""
    groups = {name: values[np.isfinite(values)] for name, values in groups.items()}
    groups = {name: values for name, values in groups.items() if len(values)}
    columns = np.arange(len(groups)) + 0.5
    axes = axes_of([np.array([0.0, len(groups)])], list(groups.values()), from_zero=True)
    if axes is None:
        return empty("no values")
    drawn = [frame(axes, "", y_label, x_ticks=dict(zip(columns, groups, strict=True)))]
    half = min(26.0, 0.3 * (axes.right - axes.left) / len(groups))
    for number, (column, values) in enumerate(zip(columns, groups.values(), strict=True)):
        x = axes.x(np.array([column]))[0]
        low, first, median, third, high, most = axes.y(np.percentile(values, [5, 25, 50, 75, 95, 100]))
        colour = series_colour(series[number] if series else 0)
        whiskers = f"M{x:.1f} {low:.1f}V{first:.1f}M{x:.1f} {third:.1f}V{high:.1f}"
        middle = f"M{x - half:.1f} {median:.1f}H{x + half:.1f}"
        size = f'width="{2 * half:.1f}" height="{max(first - third, 0.5):.1f}"'
        drawn.append(
            f'<g stroke="{colour}" fill="{colour}"><path class="curve" d="{whiskers}{middle}"/>'
            f'<rect x="{x - half:.1f}" y="{third:.1f}" {size} fill-opacity=".25"/>'
            f'<circle cx="{x:.1f}" cy="{most:.1f}" r="2"/></g>'
        )
    return _svg(drawn, y_label, axes)


def curve(axes: Axes, line: Line) -> str:
    """Draw one curve in given axes."""
    x, y = axes.x(line.x), axes.y(line.y)
    finite = np.isfinite(x) & np.isfinite(y)
    pieces = np.split(np.flatnonzero(finite), np.flatnonzero(np.diff(np.flatnonzero(finite)) > 1) + 1)
    path = "".join(_path(*_thinned(x[piece], y[piece])) for piece in pieces if len(piece))
    dashed = " dashed" if line.dashed else ""
    return f'<path class="curve{dashed}" stroke="{series_colour(line.series)}" d="{path}"/>'


def empty(text: str) -> str:
    """Return a drawing that says why there is none."""
    words = f'<text x="{WIDTH / 2}" y="40" text-anchor="middle">{escape(text)}</text>'
    return _svg([words], text, Axes(0.0, 1.0, 0.0, 1.0, height=80.0))


def _svg(parts: Sequence[str], name: str, axes: Axes) -> str:
    size = f"0 0 {axes.width:g} {axes.height:g}"
    return f'<svg viewBox="{size}" role="img" aria-label="{escape(name)}">' + "".join(parts) + "</svg>"


def _ribbon(axes: Axes, x: NDArray, low: NDArray, high: NDArray, series: int, kind: str = "band") -> str:
    finite = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    if not finite.any():
        return ""
    x, low, high = x[finite], low[finite], high[finite]
    groups = np.unique(np.linspace(0, len(x), min(len(x), _SERIES_POINTS), endpoint=False).astype(int))
    # the widest within each group: a thinned band must not hide what it covers
    across, least, most = x[groups], np.minimum.reduceat(low, groups), np.maximum.reduceat(high, groups)
    along = np.concatenate([axes.x(across), axes.x(across)[::-1]])
    edge = np.concatenate([axes.y(most), axes.y(least)[::-1]])
    return f'<path class="{kind}" fill="{series_colour(series)}" d="{_path(along, edge)}Z"/>'


def _thinned(x: NDArray, y: NDArray) -> tuple[NDArray, NDArray]:
    """Return the points that make a visible difference: extremes of a series, distinct places of a path."""
    if len(x) > 2 * _SERIES_POINTS and np.all(np.diff(x) >= 0):
        edges = np.linspace(0, len(x), _SERIES_POINTS // 2 + 1).astype(int)
        kept = [
            start + place
            for start, end in pairwise(edges.tolist())
            for place in sorted((int(np.argmin(y[start:end])), int(np.argmax(y[start:end]))))
        ]
        return x[kept], y[kept]
    return _without_repeats(x, y, _CELL)


def _without_repeats(x: NDArray, y: NDArray, cell: float) -> tuple[NDArray, NDArray]:
    """Return a path without points in the cell of the one before; in coarser cells until few are left."""
    cells = np.round(np.stack([x, y]) / cell)
    kept = np.any(np.diff(cells, axis=1, prepend=np.inf) != 0, axis=0)
    kept[-1] = True
    if np.count_nonzero(kept) > _PATH_POINTS:
        return _without_repeats(x, y, 2 * cell)
    return x[kept], y[kept]


def _path(x: NDArray, y: NDArray) -> str:
    points = [f"{a:.1f} {b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True)]
    # a single point shows as the round end of a line without length
    return "M" + "L".join(points if len(points) > 1 else points * 2)
