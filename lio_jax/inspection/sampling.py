"""Choose the parts of a recording to examine: all of a short one, windows of consecutive scans of others."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.sequence import ImuData, LidarScan, Sequence

WINDOW_SCANS = 12
_ALL_SCANS = 40
"""Recordings with at most this number of scans are examined as a whole."""
_WINDOWS = 4
_LARGE_BYTES = 1_000_000_000
"""Bags larger than this are read in parts only, inertial samples included, bytes."""
_PART_S = 2.0
"""Length of the parts that are read of a large bag, s."""
_CANDIDATES = 40


@dataclass(frozen=True)
class ScanWindow:
    """A window of consecutive scans."""

    first: int
    """Number of the first scan; counted from the window's start if ``numbered`` is false."""
    numbered: bool
    scans: list[LidarScan]


@dataclass(frozen=True)
class Sampled:
    """The parts of a recording that are examined."""

    sequence: Sequence
    imu_parts: list[ImuData]
    """Inertial samples of each part; a single part if all samples were read."""
    whole: bool
    """Whether all inertial samples were read."""
    summary: str
    """Sentence on the parts that were left out; "" if none was."""
    _places: list[tuple[int, int]]
    """First and last time of receipt (ns) of each window in a bag; else first scan and number of scans."""
    _parts: list[RosbagSequence]

    def windows(self) -> Iterator[ScanWindow]:
        """Yield the windows; each one is decoded when it is asked for."""
        for part in self._parts[:-1]:
            yield ScanWindow(0, False, list(part.scans(0, WINDOW_SCANS)))
        for part in self._parts[-1:]:
            # the last scan shows how long the recording is
            yield ScanWindow(0, False, list(deque(part.scans(), WINDOW_SCANS)))
        for first, count in self._places:
            yield ScanWindow(first, True, list(self.sequence.scans(first, count)))


def sampled(sequence: Sequence) -> Sampled:
    """Choose windows at the recording's two ends and where the angular rate is largest."""
    count = sequence.info.scan_count
    if isinstance(sequence, RosbagSequence):
        return _sampled_bag(sequence, count)
    imu = sequence.imu()
    parts = [imu] if imu is not None else []
    if count <= _ALL_SCANS:
        return Sampled(sequence, parts, True, "", [(0, count)], [])
    places = [(round(at * (count - WINDOW_SCANS)), WINDOW_SCANS) for at in _shares(imu)]
    summary = f"{len(places)} windows of {WINDOW_SCANS} scans were looked at, of {count} scans."
    return Sampled(sequence, parts, True, summary, places, [])


def _sampled_bag(bag: RosbagSequence, count: int) -> Sampled:
    contents = bag.contents()
    if contents.size_bytes <= _LARGE_BYTES:
        imu = bag.imu()
        samples = [imu] if imu is not None else []
        if count <= _ALL_SCANS:
            return Sampled(bag, samples, True, "", [(0, count)], [])
        shares, length_s = _shares(imu), _window_s(contents.end_ns - contents.start_ns, count)
        summary = f"{len(shares)} windows of {WINDOW_SCANS} scans were looked at, of {count} scans."
        return Sampled(bag, samples, True, summary, [], _parts(bag, shares, length_s))
    parts = _parts(bag, np.linspace(0.0, 1.0, 2 * _WINDOWS).tolist(), _PART_S)
    read = [part.imu() for part in parts]
    summary = (
        f"of {contents.size_bytes / 1e9:.1f} GB {len(parts)} parts of {_PART_S:g} s were looked at: gaps and "
        "jumps elsewhere are not seen."
    )
    return Sampled(bag, [imu for imu in read if imu is not None], False, summary, [], parts)


def _parts(bag: RosbagSequence, shares: list[float], length_s: float) -> list[RosbagSequence]:
    contents = bag.contents()
    last = max(contents.start_ns, contents.end_ns + 1 - round(length_s * 1e9))
    starts = [contents.start_ns + round(share * (last - contents.start_ns)) for share in shares]
    return [bag.within(start, start + round(length_s * 1e9)) for start in starts]


def _window_s(length_ns: int, count: int) -> float:
    """Return a time within which all scans of a window arrive, s."""
    return (WINDOW_SCANS + 2) * length_ns * 1e-9 / max(count, 1)


def _shares(imu: ImuData | None) -> list[float]:
    """Return where windows start, 0 to 1: at both ends, and where the angular rate is largest in between."""
    even = np.linspace(0.0, 1.0, _WINDOWS).tolist()
    if imu is None or len(imu.gyro) < 10 * _CANDIDATES:
        return even
    pieces = np.array_split(np.linalg.norm(imu.gyro, axis=1), _CANDIDATES)
    busy: NDArray[np.float64] = np.array([np.nanpercentile(piece, 75) for piece in pieces[1:-1]])
    chosen = (1 + np.argsort(busy)[::-1][: _WINDOWS - 2]) / _CANDIDATES
    return sorted([0.0, *chosen.tolist(), 1.0])
