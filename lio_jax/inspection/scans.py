"""Properties of the sampled scans: points, ranges, rings, times, and the time between scans."""

import math
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.sequence import LidarScan
from lio_jax.inspection.sampling import ScanWindow

FEW_POINTS = 1000
GAP_FACTOR = 1.8
"""A step between stamps that is longer than this many median steps is a gap: a scan is missing."""
RANGE_EDGES_M = (0.0, 0.5, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, math.inf)


@dataclass
class ScanSummary:
    """A few numbers of each sampled scan, so that no scan stays in memory."""

    starts_ns: list[int] = field(default_factory=list)
    ends_ns: list[int] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    dropped: list[int] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    steps_ns: list[int] = field(default_factory=list)
    """Time between the starts of consecutive scans, ns."""
    time_spreads: list[float] = field(default_factory=list)
    time_values: list[int] = field(default_factory=list)
    ranges: list[tuple[float, float]] = field(default_factory=list)
    histogram: NDArray[np.int64] = field(default_factory=lambda: np.zeros(len(RANGE_EDGES_M) - 1, np.int64))
    """Number of points in each interval of range."""
    rings: set[int] = field(default_factory=set)

    def add(self, window: ScanWindow) -> None:
        """Add the consecutive scans of a window."""
        stamps = [scan.stamp_ns for scan in window.scans]
        self.steps_ns += np.diff(stamps).tolist()
        for place, scan in enumerate(window.scans):
            since = (scan.stamp_ns - (self.starts_ns or stamps)[0]) * 1e-9
            name = f"scan {window.first + place}" if window.numbered else f"the scan at {since:.1f} s"
            self._add(name, scan)

    def _add(self, name: str, scan: LidarScan) -> None:
        self.names.append(name)
        self.starts_ns.append(scan.stamp_ns)
        self.ends_ns.append(scan.end_ns)
        self.counts.append(len(scan.points))
        self.dropped.append(scan.dropped)
        self.durations.append(scan.duration)
        if len(scan.points) == 0:
            return
        self.rings.update(np.unique(scan.ring[scan.ring >= 0]).tolist())
        self.time_spreads.append(float(scan.time.max() - scan.time.min()))
        self.time_values.append(int(np.unique(scan.time).size))
        ranges = np.linalg.norm(scan.points, axis=1)
        self.ranges.append((float(ranges.min()), float(ranges.max())))
        self.histogram += np.histogram(ranges, RANGE_EDGES_M)[0]

    @property
    def rate(self) -> float | None:
        """Rate of the scans by the median step, Hz."""
        forward = [step for step in self.steps_ns if step > 0]
        return 1e9 / float(np.median(forward)) if forward else None

    @property
    def jitter(self) -> float | None:
        """Typical deviation of a step from the median step, s: 1.48 median absolute deviations."""
        if len(self.steps_ns) < 2:
            return None
        steps = np.array(self.steps_ns) * 1e-9
        return float(1.4826 * np.median(np.abs(steps - np.median(steps))))

    @property
    def gaps(self) -> list[float]:
        """Steps that are longer than ``GAP_FACTOR`` median steps, s."""
        if not self.steps_ns:
            return []
        median = float(np.median(self.steps_ns))
        return [step * 1e-9 for step in self.steps_ns if step > GAP_FACTOR * median > 0]

    @property
    def sweep(self) -> float | None:
        """Median duration of a scan, s; 0: already compensated."""
        return float(np.median(self.durations)) if self.durations else None

    @property
    def dropped_share(self) -> float | None:
        """Share of the recorded points without a return: NaN, infinite or zero."""
        recorded = sum(self.counts) + sum(self.dropped)
        return sum(self.dropped) / recorded if recorded else None

    @property
    def range_shares(self) -> dict[str, float]:
        """Share of the points in each interval of range, for example "2 to 5 m"."""
        total = int(self.histogram.sum())
        names = [
            f"{low:g} to {high:g} m" if math.isfinite(high) else f"over {low:g} m"
            for low, high in pairwise(RANGE_EDGES_M)
        ]
        return {
            name: round(count / total, 4)
            for name, count in zip(names, self.histogram.tolist(), strict=True)
            if count
        }

    @property
    def spread(self) -> dict[str, float]:
        """Smallest, median and largest number of points of a scan."""
        if not self.counts:
            return {"min": 0, "median": 0.0, "max": 0}
        return {"min": min(self.counts), "median": float(np.median(self.counts)), "max": max(self.counts)}

    @property
    def point_time(self) -> str:
        """Sentence on how the times of the points are distributed in a scan."""
        if not self.time_spreads:
            return "none"
        spread = float(np.median(self.time_spreads))
        if spread == 0.0:
            return "all points at one time"
        values = math.floor(float(np.median(self.time_values)))
        return f"{values} different times over {spread * 1e3:.1f} ms"

    def problems(self, count: int) -> list[str]:
        """Return one sentence for each fault; ``count`` is the recording's number of scans."""
        messages = []
        if not self.counts:
            messages.append(f"none of the {count} scan(s) could be decoded.")
        elif min(self.counts) < FEW_POINTS:
            few = [name for name, points in zip(self.names, self.counts, strict=True) if points < FEW_POINTS]
            messages.append(
                f"{len(few)} of {len(self.counts)} sampled scans hold fewer than {FEW_POINTS} points "
                f"(first: {few[0]})."
            )
        if any(step <= 0 for step in self.steps_ns):
            messages.append("scan stamps do not ascend over the recording.")
        if self.gaps:
            messages.append(
                f"{len(self.gaps)} step(s) between consecutive scans are too long, the longest "
                f"{max(self.gaps):.3f} s: scans are missing there."
            )
        if len(self.rings) == 1:
            messages.append("all points carry the same ring: scan lines cannot be separated.")
        if self.sweep and self.time_spreads and float(np.median(self.time_spreads)) == 0.0:
            messages.append(
                f"all points of a scan carry one time although a sweep takes {self.sweep:.3f} s: its motion "
                "cannot be compensated."
            )
        period = 1.0 / self.rate if self.rate else None
        if self.sweep and period and self.sweep > 1.5 * period:
            messages.append(
                f"a scan lasts {self.sweep:.3g} s but one comes every {period:.3g} s: the unit of the point "
                "times is wrong, set config.data.time_unit."
            )
        return messages
