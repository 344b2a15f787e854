"""Recognise a spinning LiDAR whose messages hold parts of a turn, and where its sweeps start.

A recording shows three things if its messages are parts of a turn. From message to message the arc of
azimuth that holds the points moves on at a constant rate. Each arc is about as wide as this step. Within a
message the azimuth of the points moves on at the same rate. A sensor with a narrow view, a covered sensor and
a sensor that publishes whole sweeps see the same arc in each message, so no rate is found.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_TURN = 2 * np.pi
_BINS = 720
_WIDEST = 0.6
"""Share of a turn that a message covers at most if it is a part of a sweep."""
_FASTEST = 50.0
"""Highest rate that is looked for, turns/s."""
_FEWEST_TURNS = 1.5
_FEWEST_MESSAGES = 4
_STEADY = 0.9
"""Least length of the mean of unit vectors, one for each message's deviation from a constant rate."""
_STAGGER = np.deg2rad(25.0)
"""Azimuth by which the beams of one firing may differ, rad; those of an HDL-64E differ by about 20 deg."""
_ALIGNED, _WHOLE = 0.4, 0.005
"""Where messages begin at the same azimuths in each turn: least length of the mean of unit vectors, which
covered sectors shorten, and share by which their number in a turn may differ from a whole one."""
_USUAL_STARTS = (0.0, 0.5, 0.25, -0.25)
"""Azimuths atan2(y, x) at which drivers cut sweeps, turns: ahead (Velodyne, RoboSense), behind (Ouster), left
(Hesai), right."""


@dataclass(frozen=True)
class Arc:
    """The smallest arc of azimuth that holds all points of a message."""

    begin: float
    """Azimuth at its clockwise end, rad."""
    width: float
    """Width, rad."""

    @property
    def middle(self) -> float:
        """Return the azimuth of its middle, rad."""
        return self.begin + self.width / 2


def arc_of(points: NDArray[np.float32]) -> Arc | None:
    """Return the arc of azimuth of points (n, 3) m; None without points."""
    if not len(points):
        return None
    turned = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64) % _TURN
    bins = (turned * (_BINS / _TURN)).astype(np.intp) % _BINS
    full = np.flatnonzero(np.bincount(bins, minlength=_BINS))
    # the arc is what the largest gap leaves
    last = int(np.argmax(np.diff(full, append=full[0] + _BINS)))
    begin = float(turned[bins == full[(last + 1) % len(full)]].min())
    end = float(turned[bins == full[last]].max())
    return Arc(begin, (end - begin) % _TURN)


@dataclass(frozen=True)
class SeenMessage:
    """What the recognition uses of one message."""

    start_ns: int
    """Time of its first firing, ns."""
    arc: Arc
    rate: float
    """Rate at which the azimuth of its points moves on, counter-clockwise, turns/s; NaN where points have no
    times."""
    order: float
    """Correlation of azimuth and place in the message, -1 to 1."""
    restarts: bool
    """Whether its times start again after those of earlier messages ran on: a sweep starts here."""


def seen_message(
    start_ns: int, points: NDArray[np.float32], seconds: NDArray[np.float64] | None, restarts: bool
) -> SeenMessage | None:
    """Return what the recognition uses of a message; None without points.

    Args:
        start_ns: time of its first firing, ns.
        points: (n, 3) m, lidar frame, n > 0.
        seconds: (n,) times of the points from any zero, s; None where they have none.
        restarts: whether its times start again.
    """
    arc = arc_of(points)
    if arc is None:
        return None
    from_middle = (np.arctan2(points[:, 1], points[:, 0]).astype(np.float64) - arc.middle + np.pi) % _TURN
    rate = np.nan
    if seconds is not None and np.ptp(seconds) > 0:
        rate = _slope(seconds, from_middle) / _TURN
    place = np.arange(len(points), dtype=np.float64)
    spread = float(np.std(from_middle) * np.std(place))
    covered = float(np.mean((from_middle - from_middle.mean()) * (place - place.mean())))
    return SeenMessage(start_ns, arc, rate, covered / spread if spread else 0.0, restarts)


def _slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    x = x - x.mean()
    return float(x @ (y - y.mean()) / (x @ x))


@dataclass(frozen=True)
class Turning:
    """How the sensor turns and where its sweeps start."""

    rate: float
    """Turns per second; positive counter-clockwise seen from above."""
    messages: float
    """Messages in a turn, on average."""
    start: float
    """Azimuth atan2(y, x) where a sweep starts, rad."""

    @property
    def period(self) -> float:
        """Return the duration of a turn, s."""
        return 1.0 / abs(self.rate)

    def phase(self, arc: Arc) -> float:
        """Return the place of a message's middle in the sweep, 0 at its start to 1 at its end."""
        return float(np.sign(self.rate) * (arc.middle - self.start) / _TURN % 1.0)

    def seconds_of(self, points: NDArray[np.float32], arc: Arc) -> NDArray[np.float64]:
        """Return the time of each point of a message from the message's start, (n,) s, by its azimuth."""
        azimuth = np.arctan2(points[:, 1], points[:, 0]).astype(np.float64)
        since = (azimuth - arc.begin) % _TURN
        # rounding may put the first point a whole turn ahead
        since[since > arc.width + 1e-6] = 0.0
        return (since if self.rate > 0 else arc.width - since) / _TURN * self.period


def may_be_parts(arcs: Sequence[Arc]) -> bool:
    """Return whether messages are narrow enough to be parts of a sweep."""
    return len(arcs) > 0 and float(np.median([arc.width for arc in arcs])) <= _WIDEST * _TURN


def recognised_turning(seen: Sequence[SeenMessage]) -> Turning | None:
    """Return how the sensor turns; None where the messages are no parts of a turn.

    Args:
        seen: messages with points in ascending time, of at least one and a half turns.
    """
    if len(seen) < _FEWEST_MESSAGES or not may_be_parts([one.arc for one in seen]):
        return None
    seconds = np.array([one.start_ns - seen[0].start_ns for one in seen]) * 1e-9
    middles = np.array([one.arc.middle for one in seen])
    step = float(np.median(np.diff(seconds)))
    if step <= 0.0:
        return None
    rate, steadiness = _constant_rate(seconds, middles, step)
    half_turns = abs(rate) * step > 0.4
    if half_turns:
        # a step of half a turn is the same in both directions
        sense = float(np.nanmedian([one.order if np.isnan(one.rate) else one.rate for one in seen]))
        rate = float(np.copysign(rate, sense))
    if steadiness < _STEADY or abs(rate) * seconds[-1] < _FEWEST_TURNS:
        return None
    width, step_angle = float(np.median([one.arc.width for one in seen])), abs(rate) * step * _TURN
    if not 0.4 * step_angle <= width <= 1.5 * step_angle + _STAGGER:
        return None
    if not _moves_within(seen, rate, half_turns):
        return None
    # firings are sparse in small messages: one step says less than their mean
    steps = np.diff(seconds)
    usual = steps[(steps > 0.5 * step) & (steps < 1.5 * step)]
    messages = 1.0 / (abs(rate) * (float(np.mean(usual)) if usual.size else step))
    start, aligned = _start(seen, rate, messages)
    return Turning(rate, float(round(messages)) if aligned else messages, start % _TURN)


def _constant_rate(
    seconds: NDArray[np.float64], middles: NDArray[np.float64], step: float
) -> tuple[float, float]:
    """Return the rate (turns/s) at which the arcs move on most steadily, and how steadily, 0 to 1."""
    span = float(seconds[-1])
    highest = min(0.52 / step, _FASTEST)
    rates = np.linspace(-highest, highest, 2 * max(1, int(10 * highest * span)) + 1)
    directions = np.exp(1j * middles)
    steady = np.array([abs(np.mean(directions * np.exp(-1j * _TURN * one * seconds))) for one in rates])
    rate = float(rates[np.argmax(steady)])
    for _ in range(2):
        deviation = directions * np.exp(-1j * _TURN * rate * seconds)
        away = np.angle(deviation / np.mean(deviation))
        rate += _slope(seconds, away) / _TURN
    return rate, float(abs(np.mean(directions * np.exp(-1j * _TURN * rate * seconds))))


def _moves_within(seen: Sequence[SeenMessage], rate: float, half_turns: bool) -> bool:
    """Return whether azimuth moves on within the messages as it does from message to message."""
    within = np.array([one.rate for one in seen])
    if not np.isnan(within).all():
        return 0.5 < float(np.nanmedian(within)) / rate < 1.5
    # points that are stored beam after beam show nothing here; two halves need the evidence
    return not half_turns or abs(float(np.median([one.order for one in seen]))) > 0.5


def _start(seen: Sequence[SeenMessage], rate: float, messages: float) -> tuple[float, bool]:
    """Return the azimuth (rad) where sweeps start: where times start again, or where a driver would cut.

    The second value says whether the messages begin at the same azimuths in each turn.

    If the messages begin at the same azimuths in each turn, a sweep starts at one of them: at one of the
    usual starts if there is one, at the first message's begin otherwise. If they do not, no azimuth is
    preferred, and the first message starts a sweep.
    """
    sign = float(np.sign(rate))
    begins = np.array([one.arc.begin if sign > 0 else one.arc.begin + one.arc.width for one in seen])
    # in turns, growing with time
    begins = sign * begins / _TURN
    whole = round(messages)
    mean = np.mean(np.exp(1j * _TURN * whole * begins))
    aligned = bool(abs(mean) >= _ALIGNED) and abs(messages / whole - 1.0) < _WHOLE
    restarting = np.array([one.restarts for one in seen])
    if restarting.any():
        restart = np.mean(np.exp(1j * _TURN * begins[restarting]))
        return sign * float(np.angle(restart)), aligned
    first = float(begins[0])
    if aligned:
        mean_begin = float(np.angle(mean)) / (_TURN * whole)
        around = (begins - mean_begin + 0.5 / whole) % (1 / whole) - 0.5 / whole
        # missing returns make a message begin late, never early
        edge = mean_begin + float(np.percentile(around[np.abs(around) < 0.3 / whole], 10))
        middle = sign * seen[0].arc.middle / _TURN
        first = edge + np.floor((middle - edge) * whole) / whole
        reach = min(0.25 / whole, 5.0 / 360.0)
        usual = [sign * azimuth for azimuth in _USUAL_STARTS]
        if not any(_apart(first, azimuth) <= reach for azimuth in usual):
            nearest = [edge + round((azimuth - edge) * whole) / whole for azimuth in usual]
            fitting = [n for n, azimuth in zip(nearest, usual, strict=True) if _apart(n, azimuth) <= reach]
            first = fitting[0] if fitting else first
    return float(sign * first * _TURN), aligned


def _apart(one: float, other: float) -> float:
    """Return the distance of two azimuths, turns."""
    return abs((one - other + 0.5) % 1.0 - 0.5)
