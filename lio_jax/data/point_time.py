"""When each point was measured: unit, reference and anchor of point times, recognised from the first scans.

Recordings answer three questions in different ways. Each answer is recognised by magnitudes and can be
overridden in :class:`~lio_jax.core.config.DataConfig`:

- Absolute or relative? Absolute times advance from scan to scan as the header stamps do; relative times start
  again in each scan.
- Which unit? The unit in which that advance equals the header's; for relative times the unit in which a
  scan's spread is nearest to the time between scans. Units differ by a factor of 1000, so the choice is
  clear.
- What does the header stamp mark? Absolute times on the header's clock place the scan without the stamp.
  Relative times below zero count from the header stamp. Relative times from zero fit a stamp at either end. A
  message cannot be received before its scan ended: if it is received sooner after the stamp than the scan
  lasts, the stamp marks the end. Otherwise "start" is assumed, as most drivers do it, and the note states it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.timestamps import FARTHEST_NS
from lio_jax.data.config import DataConfig

TICK_NS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}

_CLEARLY_RECEIVED_LATER = 0.002
"""Latency above which a receipt is evidence, s: in converted bags the receipt equals the stamp."""
_LONGEST_LATENCY = 5.0
"""Latency above which the recorder's clock differs from the sensor's, s."""
_MOST_TICKS = 1e30
"""Ticks beyond this are impossible in any unit, and are read as this limit: sums and products stay finite."""
_LEAST_TICKS = 1e-30
"""Differences of ticks below this are none: quotients stay above zero."""


@dataclass(frozen=True)
class TimeSample:
    """Stamps and time range of one scan."""

    header_ns: int
    """Header stamp, ns."""
    received_ns: int
    """When the recorder got the message, ns."""
    low: float | int
    """Smallest per-point time, ticks."""
    high: float | int
    """Largest per-point time, ticks."""


@dataclass(frozen=True)
class PointTiming:
    """How per-point ticks become seconds from the scan's start."""

    tick_ns: int
    """Length of a tick, ns."""
    absolute: bool
    """Whether ticks count from an epoch instead of from the scan."""
    anchor: Literal["points", "start", "end", "inside"]
    """What places the scan in time: its own absolute times, or the header stamp at that place in the scan."""
    sweep: float
    """Usual duration of a scan, s."""
    note: str

    def outliers(self, time: NDArray[Any]) -> NDArray[np.bool_] | None:
        """Mark the points whose time cannot belong to their scan, (n,); None where all can.

        Args:
            time: (n,) ticks of the real returns.
        """
        longest = 2.0 * self.sweep * 1e9 / self.tick_ns
        if time.size == 0 or self.can_be_scan(time.min().item(), time.max().item()):
            return None
        ticks = np.clip(time.astype(np.float64), -_MOST_TICKS, _MOST_TICKS)
        middle = float(np.median(ticks))
        if not abs(middle) * self.tick_ns < FARTHEST_NS:
            return np.ones(time.shape, bool)
        beyond = ~(np.abs(ticks) * self.tick_ns < FARTHEST_NS)
        wrong: NDArray[np.bool_] = (np.abs(ticks - middle) > 0.75 * longest) | beyond
        return wrong

    def can_be_scan(self, low: float | int, high: float | int) -> bool:
        """Return whether ticks from ``low`` to ``high`` are those of one scan, at a time that ns can hold."""
        longest = 2.0 * self.sweep * 1e9 / self.tick_ns
        return high - low <= longest and max(abs(low), abs(high)) * self.tick_ns < FARTHEST_NS

    def place(
        self, header_ns: int, time: NDArray[Any], low: float | int, high: float | int
    ) -> tuple[int, NDArray[np.float32], float]:
        """Return the scan's start in ns, the points' times in s from there, and the scan's duration in s.

        Args:
            header_ns: header stamp of the message, ns.
            time: (n,) ticks.
            low, high: smallest and largest tick of the scan.
        """
        tick = self.tick_ns * 1e-9
        # Relative times from zero keep their zero: the first firings may have no return.
        zero = low if self.absolute else min(low, 0)
        duration = float((self._last_tick(low, high) - zero) * tick)
        # Subtract in the ticks' own type: only the difference fits into a float32.
        since = (time - time.dtype.type(zero)) * tick
        times = np.clip(since.astype(np.float32), 0.0, np.float32(duration))
        return self.at_ns(header_ns, zero, low, high), times, duration

    def at_ns(self, header_ns: int, tick: float | int, low: float | int, high: float | int) -> int:
        """Return when a tick of a scan was, ns.

        Args:
            header_ns: header stamp of the message, ns.
            tick: what is asked for.
            low, high: smallest and largest tick of the scan.
        """
        if self.anchor == "points":
            return ticks_to_ns(tick, self.tick_ns)
        return header_ns + round((tick - self.header_tick(low, high)) * self.tick_ns)

    def header_tick(self, low: float | int, high: float | int) -> float | int:
        """Return the tick at which the header stamp of a scan lies, where it places the scan.

        Args:
            low, high: smallest and largest tick of the scan.
        """
        if self.anchor == "end":
            return self._last_tick(low, high)
        if self.anchor == "inside":
            return 0
        return low if self.absolute else min(low, 0)

    def _last_tick(self, low: float | int, high: float | int) -> float | int:
        """Return where a scan ends: times below zero that count from its end may lack their last firings."""
        counts_down = self.anchor == "end" and low < 0 and not self.absolute
        return max(high, 0) if counts_down else high


def scan_period(header_ns: Sequence[int], fallback: float) -> float:
    """Return the usual time between scans in s, from their header stamps in any order."""
    steps = np.diff(np.unique(np.asarray(header_ns, np.int64)))
    return float(np.median(steps)) * 1e-9 if steps.size else fallback


def recognise_point_time(
    samples: Sequence[TimeSample],
    field: str,
    kind: str,
    config: DataConfig,
    stamped: bool = True,
    called: str = "scan",
) -> PointTiming | None:
    """Settle the meaning of per-point times from the first scans; None where all times are equal.

    Args:
        samples: time samples of several consecutive scans, at least one.
        field: name of the time field, for the note.
        kind: its data type, for the note.
        config: overrides, and the scan period to use where there is only one scan.
        stamped: whether the header stamps are recorded; false where scans are only counted.
        called: word for a cloud in the note: scan, or message where several are joined to a scan.
    """
    period = scan_period([sample.header_ns for sample in samples], config.scan_period)
    samples = _possible(samples)
    spread = float(np.median([sample.high - sample.low for sample in samples]))
    if spread < _LEAST_TICKS:
        return None
    absolute = (
        _is_absolute(samples, spread)
        if config.time_reference == "auto"
        else config.time_reference == "absolute"
    )
    unit = config.time_unit if config.time_unit != "auto" else _unit(samples, spread, period, absolute)
    tick_ns = TICK_NS[unit]
    sweep = spread * tick_ns * 1e-9
    anchor, where = _anchor(samples, tick_ns, absolute, sweep, config, stamped, called)
    note = (
        f"per-point time: field {field!r}, {kind} {unit} {'absolute' if absolute else 'relative'}, "
        f"{sweep:.4f} s a {called}, {where}"
    )
    if not 0.1 <= sweep / period <= 2.0:
        note += f"; that does not fit the {period:.4g} s between {called}s, check config.data.time_unit"
    return PointTiming(tick_ns, absolute, anchor, sweep, note)


def stamp_end(
    samples: Sequence[TimeSample], sweep: float, config: DataConfig, called: str
) -> tuple[Literal["start", "end"], str]:
    """Return which end of a scan header stamps mark, where points do not state it, and the evidence.

    Args:
        samples: time samples of several consecutive scans, at least one.
        sweep: usual duration of a scan, s.
        config: says what stamps mark, or leaves it to the evidence.
        called: word for a cloud in the evidence: scan, or message where several are joined to a scan.
    """
    stamp = f"header stamp at {called}"
    if config.stamp_at != "auto":
        return config.stamp_at, f"{stamp} {config.stamp_at} (config.data.stamp_at)"
    latency = np.array([sample.received_ns - sample.header_ns for sample in samples]) * 1e-9
    if latency.min() > _CLEARLY_RECEIVED_LATER and latency.max() < 0.9 * sweep:
        return "end", f"{stamp} end (received {np.median(latency):.3f} s after it)"
    if latency.min() >= 0.9 * sweep and latency.max() < _LONGEST_LATENCY:
        return "start", f"{stamp} start"
    return "start", f"{stamp} start (assumed; config.data.stamp_at=end otherwise)"


def _is_absolute(samples: Sequence[TimeSample], spread: float) -> bool:
    if min(abs(sample.low) for sample in samples) > 10 * spread:
        return True
    ordered = sorted(samples, key=lambda sample: sample.header_ns)
    advances = [
        later.low - earlier.low for earlier, later in pairwise(ordered) if later.header_ns > earlier.header_ns
    ]
    return bool(advances) and float(np.median(advances)) > 0.5 * spread


def _unit(samples: Sequence[TimeSample], spread: float, period: float, absolute: bool) -> str:
    ticks, nanoseconds = spread, period * 1e9
    if absolute:
        first, last = min(samples, key=_header), max(samples, key=_header)
        if last.header_ns > first.header_ns and last.low - first.low > _LEAST_TICKS:
            ticks, nanoseconds = float(last.low - first.low), float(last.header_ns - first.header_ns)
        elif first.header_ns > 0 and first.low > 0:
            since_epoch = {unit: first.low * tick / first.header_ns for unit, tick in TICK_NS.items()}
            for unit, ratio in since_epoch.items():
                if 0.5 < ratio < 2.0:
                    return unit
    return min(TICK_NS, key=lambda unit: abs(math.log(ticks * TICK_NS[unit] / nanoseconds)))


def _anchor(
    samples: Sequence[TimeSample],
    tick_ns: int,
    absolute: bool,
    sweep: float,
    config: DataConfig,
    stamped: bool,
    called: str,
) -> tuple[Literal["points", "start", "end", "inside"], str]:
    if absolute and not stamped:
        return "points", f"these times place the {called}s, instead of counted stamps"
    if config.stamp_at != "auto":
        return stamp_end(samples, sweep, config, called)
    if absolute:
        # Place of the header in the scan on the points' own clock: 0 is its start, 1 its end.
        offsets = [(s.header_ns - ticks_to_ns(s.low, tick_ns)) * 1e-9 for s in samples]
        place = float(np.median(offsets)) / sweep
        if -1.0 < place < 2.0:
            where = (
                f"{called} start"
                if abs(place) < 0.1
                else f"{called} end"
                if abs(place - 1.0) < 0.1
                else f"{place:.2f} of the {called}"
            )
            return "points", f"header stamp at {where}"
        anchor, note = stamp_end(samples, sweep, config, called)
        return anchor, f"{note}, points on another clock than the header ({np.median(offsets):+.3f} s)"
    low = float(np.median([s.low for s in samples])) * tick_ns * 1e-9
    high = float(np.median([s.high for s in samples])) * tick_ns * 1e-9
    if low < -0.02 * sweep:
        if high <= 0.1 * sweep:
            return "end", f"header stamp at {called} end (times are negative)"
        return "inside", f"header stamp {-low:.3f} s into the {called} (times of both signs)"
    return stamp_end(samples, sweep, config, called)


def _possible(samples: Sequence[TimeSample]) -> list[TimeSample]:
    """Return the samples whose ticks are possible in the shortest unit; if there are none all, bounded."""
    possible = [one for one in samples if max(abs(one.low), abs(one.high)) < FARTHEST_NS]
    return possible or [replace(one, low=_bounded(one.low), high=_bounded(one.high)) for one in samples]


def _bounded(ticks: float | int) -> float | int:
    return max(-_MOST_TICKS, min(ticks, _MOST_TICKS))


def _header(sample: TimeSample) -> int:
    return sample.header_ns


def ticks_to_ns(ticks: float | int, tick_ns: int) -> int:
    """Convert exactly: seconds since the epoch times 1e9 would lose 100 ns in a double."""
    whole = math.floor(ticks)
    return whole * tick_ns + round((ticks - whole) * tick_ns)
