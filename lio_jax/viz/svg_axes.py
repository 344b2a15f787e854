"""Where values stand in a drawing: scales, round ticks, grid and labels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 480.0, 250.0
"""Drawing units; text of 11 units stays legible when this width fills a phone's."""
_LEFT, _RIGHT, _TOP, _BOTTOM = 60.0, 12.0, 10.0, 34.0


@dataclass(frozen=True)
class Axes:
    """A rectangle of the drawing and the values at its edges."""

    x_low: float
    x_high: float
    y_low: float
    y_high: float
    log: bool = False
    """Whether y is logarithmic; the bounds are then exponents of ten."""
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
        """Return where values stand, drawing units from the left."""
        share = (np.asarray(values, np.float64) - self.x_low) / (self.x_high - self.x_low)
        return self.left + share * (self.right - self.left)

    def y(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return where values stand, drawing units from the top; NaN where a logarithm has none."""
        numbers = np.asarray(values, np.float64)
        if self.log:
            numbers = np.log10(numbers, out=np.full_like(numbers, np.nan), where=numbers > 0)
        share = (numbers - self.y_low) / (self.y_high - self.y_low)
        return self.bottom - share * (self.bottom - self.top)


def axes_of(
    xs: Sequence[NDArray], ys: Sequence[NDArray], *, from_zero: bool = False, log: bool = False
) -> Axes | None:
    """Return axes that hold all finite values; None where there are none."""
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
    """Return axes of one scale in both directions, at most as high as wide; None without finite values."""
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
    """Return the multiples of 1, 2 or 5 times a power of ten within a range, ``most`` at most."""
    rough = (high - low) / most
    power = 10.0 ** np.floor(np.log10(rough))
    step = next((factor * power for factor in (1, 2, 5) if factor * power >= rough), 10 * power)
    return np.arange(np.ceil(low / step - 1e-9), np.floor(high / step + 1e-9) + 1) * step


def frame(axes: Axes, x_label: str, y_label: str, x_ticks: Mapping[float, str] | None = None) -> str:
    """Draw grid, ticks and labels.

    Args:
        axes: to draw.
        x_label: quantity and unit, plain text.
        y_label: the same of the upright axis.
        x_ticks: texts at places, instead of numbers.
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
    below, beside = f'x="{across}" y="{axes.height - 5}"', f'transform="translate(11 {upright}) rotate(-90)"'
    texts += [
        f'<text {place} text-anchor="middle">{escape(label)}</text>'
        for place, label in ((below, x_label), (beside, y_label))
    ]
    return f'<path class="grid" d="{grid}"/>' + "".join(texts)


def _log_ticks(low: float, high: float) -> NDArray[np.float64]:
    """Return round numbers between two powers of ten, the finer the nearer these are."""
    decades = high - low
    step = max(1, round(decades / 6))
    powers = np.arange(np.floor(low / step) * step, high + step, step)
    factors = (1,) if decades > 3 else (1, 3) if decades > 1.5 else (1, 2, 5)
    if decades < 0.5:
        return round_ticks(10.0**low, 10.0**high, 5)
    ticks = np.sort(np.outer(10.0**powers, factors).ravel())
    return ticks[(ticks >= 10.0**low) & (ticks <= 10.0**high)]


def _numbers(ticks: NDArray[np.float64]) -> list[str]:
    """Write ticks with as many decimals as tell them apart."""
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
