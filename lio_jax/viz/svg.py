"""Charts as SVG."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lio_jax.viz.html import series_colour

WIDTH, HEIGHT = 480.0, 250.0
"""Size in drawing units; text of 11 units is legible when this width fills a phone's screen."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 60.0, 12.0, 10.0, 34.0


@dataclass(frozen=True)
class Axes:
    """A rectangle of the drawing, and the values at its edges."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float
    log: bool = False
    """Whether y is logarithmic; the bounds are then powers of ten by their exponents."""
    width: float = WIDTH
    height: float = HEIGHT
    left: float = _LEFT
    top: float = _TOP

    @property
    def right(self) -> float:
        """Right edge, drawing units."""
        return self.width - _RIGHT

    @property
    def bottom(self) -> float:
        """Lower edge, drawing units."""
        return self.height - _BOTTOM

    def x(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the places of values, drawing units from the left."""
        share = (np.asarray(values, np.float64) - self.x_low) / (self.x_high - self.x_low)
        return self.left + share * (self.right - self.left)

    def y(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the places of values, drawing units from the top; NaN where the logarithm is not defined."""
        numbers = np.asarray(values, np.float64)
        if self.log:
            numbers = np.log10(numbers, out=np.full_like(numbers, np.nan), where=numbers > 0)
        share = (numbers - self.y_low) / (self.y_high - self.y_low)
        return self.bottom - share * (self.bottom - self.top)


def axes_of(
    xs: Sequence[NDArray], ys: Sequence[NDArray], *, from_zero: bool = False, log: bool = False
) -> Axes | None:
    """Return axes that contain all finite values; None where there are none."""
    x, y = _finite(xs), _finite(ys)
    if log:
        y = np.log10(y[y > 0])
    if not len(x) or not len(y):
        return None
    x_low, x_high = _span(float(x.min()), float(x.max()), 0.0)
    y_low, y_high = _span(float(y.min()), float(y.max()), 0.06)
    if from_zero and not log and y.min() >= 0:
        y_low = 0.0
    return Axes(x_low, x_high, y_low, y_high, log)


def equal_axes(xs: Sequence[NDArray], ys: Sequence[NDArray], width: float = 720.0) -> Axes | None:
    """Return axes with one scale in both directions, at most as high as wide; None without finite values."""
    x, y = _finite(xs), _finite(ys)
    if not len(x) or not len(y):
        return None
    room = width - _LEFT - _RIGHT
    spans = np.maximum([np.ptp(x), np.ptp(y)], [1e-2, 1e-2]) * 1.06
    height = float(np.clip(room * spans[1] / spans[0], 0.3 * room, 0.75 * room))
    scale = max(spans[0] / room, spans[1] / height)
    half = 0.5 * scale * np.array([room, height])
    middle = [(x.min() + x.max()) / 2, (y.min() + y.max()) / 2]
    (x_low, y_low), (x_high, y_high) = middle - half, middle + half
    return Axes(x_low, x_high, y_low, y_high, width=width, height=height + _TOP + _BOTTOM)


def round_ticks(low: float, high: float, most: int = 6) -> NDArray[np.float64]:
    """Return the multiples of 1, 2 or 5 times a power of ten within a range, at most ``most`` of them."""
    rough = (high - low) / most
    power = 10.0 ** np.floor(np.log10(rough))
    step = next((factor * power for factor in (1, 2, 5) if factor * power >= rough), 10 * power)
    return np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step


def frame(axes: Axes, x_label: str, y_label: str, x_ticks: Mapping[float, str] | None = None) -> str:
    """Draw grid, ticks and labels.

    Args:
        axes: the axes to draw.
        x_label: quantity and unit, plain text.
        y_label: quantity and unit of the vertical axis, plain text.
        x_ticks: texts at given values, in place of numbers.
    """
    if x_ticks is None:
        places = round_ticks(axes.x_low, axes.x_high, round(axes.width / 80))
        x_ticks = dict(zip(places.tolist(), _numbers(places), strict=True))
    if axes.log:
        uprights = _log_ticks(axes.y_low, axes.y_high)
        names = [f"{tick:g}" for tick in uprights]
    else:
        uprights = round_ticks(axes.y_low, axes.y_high, max(2, round(axes.height / 45)))
        names = _numbers(uprights)
    x = axes.x(np.array(list(x_ticks)))
    y = axes.y(uprights)
    grid = "".join(f"M{place:.1f} {axes.top}V{axes.bottom}" for place in x) if x_label else ""
    grid += "".join(f"M{axes.left} {place:.1f}H{axes.right}" for place in y)
    texts = [
        f'<text x="{place:.1f}" y="{axes.bottom + 14}" text-anchor="middle">{escape(text)}</text>'
        for place, text in zip(x, x_ticks.values(), strict=True)
    ]
    texts += [
        f'<text x="{axes.left - 5}" y="{place + 4:.1f}" text-anchor="end">{text}</text>'
        for place, text in zip(y, names, strict=True)
    ]
    across, upright = (axes.left + axes.right) / 2, (axes.top + axes.bottom) / 2
    below, at_left = f'x="{across}" y="{axes.height - 5}"', f'transform="translate(11 {upright}) rotate(-90)"'
    texts += [
        f'<text {place} text-anchor="middle">{escape(label)}</text>'
        for place, label in ((below, x_label), (at_left, y_label))
    ]
    return f'<path class="grid" d="{grid}"/>' + "".join(texts)


def _log_ticks(low: float, high: float) -> NDArray[np.float64]:
    """Return round numbers between two powers of ten; the nearer the powers, the finer the numbers."""
    decades = high - low
    step = max(1, round(decades / 6))
    powers = np.arange(np.floor(low / step) * step, high + step, step)
    factors = (1,) if decades > 3 else (1, 3) if decades > 1.5 else (1, 2, 5)
    if decades < 0.5:
        return round_ticks(10.0**low, 10.0**high, 5)
    ticks = np.sort(np.outer(10.0**powers, factors).ravel())
    return ticks[(ticks >= 10.0**low) & (ticks <= 10.0**high)]


def _numbers(ticks: NDArray[np.float64]) -> list[str]:
    """Write ticks with enough decimals to distinguish them."""
    if not len(ticks):
        return []
    largest = float(np.max(np.abs(ticks)))
    step = float(ticks[1] - ticks[0]) if len(ticks) > 1 else largest or 1.0
    if largest >= 1e5 or step < 1e-4:
        return [f"{tick:.3g}" for tick in ticks + 0.0]
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    return [f"{tick + 0.0:.{decimals}f}" for tick in ticks]


def _finite(arrays: Sequence[NDArray]) -> NDArray[np.float64]:
    values = (
        np.concatenate([np.ravel(np.asarray(array, np.float64)) for array in arrays])
        if arrays
        else np.zeros(0)
    )
    return values[np.isfinite(values)]


def _span(low: float, high: float, margin: float) -> tuple[float, float]:
    if high - low <= 1e-12 * max(1.0, abs(low), abs(high)):
        half = 0.5 * max(1e-9, 0.1 * abs(low)) if low else 0.5
        return low - half, high + half
    return low - margin * (high - low), high + margin * (high - low)


_SERIES_POINTS = 800
_PATH_POINTS = 4000
_CELL = 0.4
"""Consecutive points of a path that are closer than this are drawn as one, drawing units."""


@dataclass(frozen=True)
class Line:
    """One curve; values that are not finite interrupt it."""

    x: NDArray[np.floating]
    y: NDArray[np.floating]
    series: int = 0
    """Number of the curve's colour."""
    dashed: bool = False
    sigma: NDArray[np.floating] | None = field(default=None)
    """Half height of a band around the curve, in units of y."""


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
    """Draw curves over a common axis.

    Args:
        lines: the curves.
        x_label: quantity and unit of x.
        y_label: quantity and unit of y.
        band: x, lower and upper bound of a shaded range.
        marks: x of vertical strokes, for example failed scans.
        from_zero: whether the scale begins at zero.
        log: whether the scale is logarithmic; values that are not positive are left out.
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
    """Draw paths, each with a dot at its start, over a picture that fills the axes.

    Args:
        axes: axes with one scale in both directions.
        lines: the paths.
        x_label: quantity and unit of x.
        y_label: quantity and unit of y.
        behind: address of the picture, for example a data URI.
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
    """Draw non-negative quantities over ``x`` on top of each other; the first is at the bottom.

    The scale ends at the 99th percentile of the sum, so that a single slow scan does not flatten the rest.
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
    """Draw one curve in the given axes."""
    x, y = axes.x(line.x), axes.y(line.y)
    finite = np.isfinite(x) & np.isfinite(y)
    pieces = np.split(np.flatnonzero(finite), np.flatnonzero(np.diff(np.flatnonzero(finite)) > 1) + 1)
    path = "".join(_path(*_thinned(x[piece], y[piece])) for piece in pieces if len(piece))
    dashed = " dashed" if line.dashed else ""
    return f'<path class="curve{dashed}" stroke="{series_colour(line.series)}" d="{path}"/>'


def empty(text: str) -> str:
    """Return a drawing with the reason why there is no chart."""
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
    # the widest of each group: a thinned band must not hide values that it covers
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
    """Return a path without points in the cell of the point before; cells grow until few points are left."""
    cells = np.round(np.stack([x, y]) / cell)
    kept = np.any(np.diff(cells, axis=1, prepend=np.inf) != 0, axis=0)
    kept[-1] = True
    if np.count_nonzero(kept) > _PATH_POINTS:
        return _without_repeats(x, y, 2 * cell)
    return x[kept], y[kept]


def _path(x: NDArray, y: NDArray) -> str:
    points = [f"{a:.1f} {b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True)]
    # a single point is drawn as the round end of a line without length
    return "M" + "L".join(points if len(points) > 1 else points * 2)
