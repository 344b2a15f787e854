"""A recording whose decoded scans stay in memory for the next run over it."""

from collections.abc import Iterator

import numpy as np

from lio_jax.data.sequence import GpsData, ImuData, LidarScan, Sequence, SequenceInfo
from lio_jax.data.trajectory import Trajectory

KEPT_BYTES = 1 << 30
"""Most that is kept; a recording that needs more is decoded anew each time."""


class KeptSequence:
    """Replays another sequence, from memory where it was read before."""

    def __init__(self, sequence: Sequence, most_bytes: int = KEPT_BYTES) -> None:
        self._sequence = sequence
        self._room = most_bytes
        self._kept: dict[tuple[int, int | None], list[LidarScan]] = {}

    @property
    def info(self) -> SequenceInfo:
        """Return what is known without decoding scans."""
        return self._sequence.info

    @property
    def warnings_so_far(self) -> tuple[str, ...]:
        """Return one sentence for each problem met so far."""
        return self._sequence.warnings_so_far

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans ``start`` to ``start + count``."""
        part = (start, count)
        if part in self._kept:
            yield from self._kept[part]
            return
        read: list[LidarScan] = []
        size = 0
        for scan in self._sequence.scans(start, count):
            size += _bytes(scan)
            if size <= self._room:
                read.append(scan)
            else:
                read.clear()
            yield scan
        if size <= self._room:
            self._room -= size
            self._kept[part] = read

    def imu(self) -> ImuData | None:
        """Return all inertial samples, or None where there are none."""
        return self._sequence.imu()

    def gps(self) -> GpsData | None:
        """Return all GPS fixes, or None where there are none."""
        return self._sequence.gps()

    def truth(self) -> Trajectory | None:
        """Return the ground-truth T_world_imu, or None where there is none."""
        return self._sequence.truth()


def _bytes(scan: LidarScan) -> int:
    arrays: list[np.ndarray] = [scan.points, scan.time, scan.ring, scan.intensity]
    return sum(array.nbytes for array in arrays)
