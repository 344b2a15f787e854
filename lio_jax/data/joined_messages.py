"""Join messages that hold parts of a sweep: which messages belong together, and one cloud of several."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.cloud_fields import RawCloud
from lio_jax.data.point_time import PointTiming
from lio_jax.data.turning import Arc, Turning, arc_of


class Part(NamedTuple):
    """A message that holds a part of a sweep."""

    number: int
    """Its place among the recording's messages."""
    start_ns: int
    """Time of its first firing, ns."""
    cloud: RawCloud


@dataclass(frozen=True)
class Joining:
    """How messages become the clouds of whole sweeps."""

    turning: Turning | None
    """How the sensor turns; None where a fixed number of messages is joined."""
    messages: float
    """Messages in a sweep, on average."""
    step: float
    """Usual time between messages, s."""
    timing: PointTiming | None
    """Meaning of the messages' point times; None where they hold none."""
    stamp_at: Literal["start", "end"]
    """Which end of a message its header stamp marks if ``timing`` is None."""
    compensated: bool = False
    """Whether the points are motion compensated, so that they have no times of their own."""

    @property
    def period(self) -> float:
        """Return the usual duration of a sweep, s."""
        return self.step * self.messages if self.turning is None else self.turning.period

    def start_ns(self, cloud: RawCloud) -> int:
        """Return when a message's first firing was, ns."""
        timing, limits = self.timing, self.limits(cloud)
        if timing is None or limits is None:
            return cloud.stamp_ns
        low, high = limits
        return timing.at_ns(cloud.stamp_ns, low, low, high)

    def limits(self, cloud: RawCloud) -> tuple[float, float] | None:
        """Return the smallest and the largest possible tick of a message; None where there is none."""
        if self.timing is None or cloud.time is None or cloud.time_range is None:
            return None
        if self.timing.can_be_scan(*cloud.time_range):
            return cloud.time_range
        wrong = self.timing.outliers(cloud.time)
        possible = cloud.time if wrong is None else cloud.time[~wrong]
        return (possible.min().item(), possible.max().item()) if possible.size else None

    def whole_timing(self) -> PointTiming | None:
        """Return the meaning of the times of joined clouds; None where they are motion compensated."""
        if self.compensated:
            return None
        timing = self.timing
        if timing is not None and timing.absolute:
            return replace(timing, sweep=self.period)
        anchor: Literal["end", "inside"] = (
            "end" if timing is not None and timing.anchor == "end" else "inside"
        )
        return PointTiming(1, False, anchor, self.period, "")

    def whole(self, parts: Sequence[RawCloud]) -> RawCloud:
        """Return the cloud that a driver of whole sweeps would have published.

        Args:
            parts: the messages of one sweep in order, at least one.
        """
        at_end = self.timing is not None and self.timing.anchor == "end"
        stamp_ns = parts[-1 if at_end else 0].stamp_ns
        timed = [self._times(part, stamp_ns) for part in parts]
        times = [time for time, _ in timed if time is not None]
        ranges = [limits for _, limits in timed if limits is not None]
        rings = [part.ring for part in parts if part.ring is not None]
        return RawCloud(
            stamp_ns,
            np.concatenate([part.points for part in parts]),
            np.concatenate([part.intensity for part in parts]),
            np.concatenate(rings) if len(rings) == len(parts) else None,
            parts[0].ring_source,
            np.concatenate(times) if len(times) == len(parts) else None,
            parts[0].time_field,
            (min(low for low, _ in ranges), max(high for _, high in ranges)) if ranges else None,
            sum(part.dropped for part in parts),
        )

    def _times(
        self, part: RawCloud, stamp_ns: int
    ) -> tuple[NDArray[np.generic] | None, tuple[float, float] | None]:
        """Return the times of a message and their range: its own absolute ticks, or ns from ``stamp_ns``."""
        if self.compensated:
            return None, None
        timing, later = self.timing, float(part.stamp_ns - stamp_ns)
        if timing is None:
            time = self._reconstructed(part) * 1e9 + later
            return time, (float(time.min()), float(time.max())) if time.size else None
        if part.time is None or timing.absolute:
            return part.time, part.time_range
        limits = self.limits(part)
        header = 0.0 if limits is None else float(timing.header_tick(*limits))

        def since(ticks: NDArray[np.float64]) -> NDArray[np.float64]:
            # float64 states times from a stamp to far less than a ns; the reading drops impossible ones
            return (np.clip(ticks, -_FARTHEST, _FARTHEST) - header) * timing.tick_ns + later

        times = since(part.time.astype(np.float64))
        if part.time_range is None:
            return times, None
        low, high = since(np.array(part.time_range, np.float64)).tolist()
        return times, (low, high)

    def _reconstructed(self, part: RawCloud) -> NDArray[np.float64]:
        """Return the time of each point from the message's header stamp, (n,) s."""
        arc = arc_of(part.points)
        if self.turning is not None and arc is not None:
            seconds = self.turning.seconds_of(part.points, arc)
            length = arc.width / (2 * np.pi) * self.turning.period
        else:
            # only the order of the points is known
            count = len(part.points)
            seconds, length = self.step * np.arange(count) / max(count, 1), self.step
        return seconds - length if self.stamp_at == "end" else seconds


_FARTHEST = 1e18
"""Ticks beyond this are impossible in any unit, and are read as this limit."""


class Order(Protocol):
    """Which messages belong to one sweep."""

    def take(self, start_ns: int, arc: Arc | None) -> tuple[bool, float]:
        """Take the next message: whether it starts a sweep, and its place in the sweep from 0 to 1."""
        ...


class OrderByTurn:
    """A sweep ends where the azimuth has passed its start; a lost message shortens its own sweep alone."""

    def __init__(self, turning: Turning) -> None:
        """Begin before the first message."""
        self._turning = turning
        self._last: tuple[int, float] | None = None

    def take(self, start_ns: int, arc: Arc | None) -> tuple[bool, float]:
        """Take the next message; one without points is placed by its time."""
        if self._last is None:
            phase = 0.0 if arc is None else self._turning.phase(arc)
            self._last = start_ns, phase
            return True, phase
        last_ns, last = self._last
        turned = (start_ns - last_ns) * 1e-9 / self._turning.period
        if arc is None:
            begins, phase = last + turned >= 1.0, (last + turned) % 1.0
        else:
            phase = self._turning.phase(arc)
            # time says how many turns lie between two azimuths
            begins = round(turned - (phase - last)) >= 1
        self._last = start_ns, phase
        return begins, phase


class OrderByCount:
    """A sweep is a fixed number of messages; a gap counts as the messages that would have filled it."""

    def __init__(self, messages: int, step: float) -> None:
        """Begin before the first message; ``step`` is the usual time between two, s."""
        self._messages, self._step = messages, step
        self._last_ns: int | None = None
        self._place = 0
        self._early = 0.0

    def take(self, start_ns: int, arc: Arc | None) -> tuple[bool, float]:
        """Take the next message."""
        begins = self._last_ns is None
        if self._last_ns is not None:
            steps = (start_ns - self._last_ns) * 1e-9 / self._step + self._early
            passed = max(1, round(steps))
            # a late message makes the next step short: what is left is counted there
            self._early = _FORGET * float(np.clip(steps - passed, -1.0, 1.0))
            begins = self._place + passed >= self._messages
            self._place = (self._place + passed) % self._messages
        self._last_ns = start_ns
        return begins, (self._place + 0.5) / self._messages


_FORGET = 0.8
"""Share of a step's remainder that is kept for the next step."""


class Grouping:
    """Collect messages to sweeps as they come.

    What the recording holds of its first and of its last sweep is left out if it is less than half: a sliver
    of a turn is no scan.
    """

    def __init__(self, order: Order, from_start: bool = True) -> None:
        """Begin before the first message.

        Args:
            order: which messages belong together.
            from_start: whether the first message is the recording's first, which may lie inside a sweep.
        """
        self._order, self._from_start = order, from_start
        self._parts: list[Part] = []
        self._sliver = False
        self._phase = 0.0
        self._complete = 0

    def take(self, part: Part) -> list[Part]:
        """Take a message; return the messages of the sweep that it ends, or nothing."""
        begins, self._phase = self._order.take(part.start_ns, arc_of(part.cloud.points))
        ended: list[Part] = []
        if begins and self._parts:
            ended = [] if self._sliver else self._parts
            self._parts, self._sliver = [], False
        elif not self._parts and not self._complete:
            self._sliver = self._from_start and self._phase > 0.5
        self._parts.append(part)
        self._complete += bool(ended)
        return ended

    def rest(self) -> list[Part]:
        """Return the messages of the last sweep, no more come; nothing if they are less than half of one."""
        parts, self._parts = self._parts, []
        if self._complete and self._phase < 0.5:
            return []
        return parts


def grouped(parts: Iterable[Part], order: Order, from_start: bool) -> Iterator[list[Part]]:
    """Yield the messages of each sweep; the arguments are those of :class:`Grouping`."""
    grouping = Grouping(order, from_start)
    for part in parts:
        if ended := grouping.take(part):
            yield ended
    if left := grouping.rest():
        yield left


def order_of(joining: Joining) -> Order:
    """Return which messages belong together, before the first message."""
    if joining.turning is not None:
        return OrderByTurn(joining.turning)
    return OrderByCount(round(joining.messages), joining.step)
