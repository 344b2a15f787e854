"""A part of a recording: some consecutive scans, and what was measured while they were taken."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.sequence import GpsData, ImuData, LidarScan, Sequence, SequenceInfo
from lio_jax.data.trajectory import Trajectory

MARGIN_S = 1.0
"""Inertial samples, fixes and truth are kept this long before the first scan and behind the last one: a start
at rest reads the second before a scan's end, and interpolation needs a neighbour on both sides."""


class Span:
    """Consecutive scans of a recording as a recording of their own."""

    def __init__(self, sequence: Sequence, start: int, count: int | None) -> None:
        """Find the instants of the first and of the last scan.

        Args:
            sequence: the whole recording.
            start: first scan.
            count: number of scans; None: to the end.
        """
        self._sequence, self._start = sequence, start
        left = max(sequence.info.scan_count - start, 0)
        self._count = left if count is None else min(count, left)
        margin = round(MARGIN_S * 1e9)
        numbers = range(start, start + self._count)
        first = _first_readable(sequence, numbers) if start else None
        last = _first_readable(sequence, reversed(numbers)) if self._count < left else None
        self._begin_ns = None if first is None else first.stamp_ns - margin
        self._end_ns = None if last is None else last.end_ns + margin

    @property
    def info(self) -> SequenceInfo:
        """Return what is known of the whole recording, with the number of scans of the part."""
        return replace(self._sequence.info, scan_count=self._count)

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans, numbered from the first one of the part."""
        left = max(self._count - start, 0)
        return self._sequence.scans(self._start + start, left if count is None else min(count, left))

    def imu(self) -> ImuData | None:
        """Return the inertial samples of the part, None where there are none."""
        imu = self._sequence.imu()
        kept = None if imu is None else self._kept(imu.stamp_ns)
        if imu is None or kept is None:
            return None
        orientation = None if imu.orientation is None else imu.orientation[kept]
        return ImuData(imu.stamp_ns[kept], imu.gyro[kept], imu.accel[kept], orientation)

    def gps(self) -> GpsData | None:
        """Return the fixes of the part, None where there are none."""
        gps = self._sequence.gps()
        kept = None if gps is None else self._kept(gps.stamp_ns)
        if gps is None or kept is None:
            return None
        return GpsData(gps.stamp_ns[kept], gps.position[kept], gps.covariance[kept], gps.origin)

    def truth(self) -> Trajectory | None:
        """Return the ground truth of the part, None where there is none."""
        truth = self._sequence.truth()
        kept = None if truth is None else self._kept(truth.stamp_ns)
        if truth is None or kept is None:
            return None
        return Trajectory(truth.stamp_ns[kept], truth.poses[kept])

    @property
    def warnings_so_far(self) -> tuple[str, ...]:
        """Return the problems that the recording's reader met so far."""
        return self._sequence.warnings_so_far

    def _kept(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.bool_] | None:
        """Return which stamps lie in the part; None where none does."""
        kept = np.ones(len(stamp_ns), bool)
        if self._begin_ns is not None:
            kept &= stamp_ns >= self._begin_ns
        if self._end_ns is not None:
            kept &= stamp_ns <= self._end_ns
        return kept if kept.any() else None


def _first_readable(sequence: Sequence, numbers: Iterator[int] | range) -> LidarScan | None:
    for number in numbers:
        for scan in sequence.scans(number, 1):
            return scan
    return None
