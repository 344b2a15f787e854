"""Look a recording over: what is in it, what is wrong with it, which configuration fits."""

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.config import LidarConfig
from lio_jax.data.sequence import ImuData, LidarScan, Sequence

_SAMPLED_SCANS = 20
_G_RANGE = (0.8, 1.25)
_SI_RANGE = (8.5, 11.5)
_GAP_FACTOR = 3.0
_SLOW_IMU_HZ = 50.0
_FEW_POINTS = 1000


@dataclass(frozen=True)
class Inspection:
    """What :func:`inspect_sequence` found; lengths in m, times in s."""

    name: str
    format: str
    path: str
    sensor: str
    scans: int
    duration: float | None
    """From the first scan's start to the last one's end; None where no scan could be decoded."""
    scan_rate: float | None
    """Hz, by the sampled stamps."""
    points_per_scan: dict[str, float]
    """min, median and max over the sampled scans."""
    rings: int
    """Number of different beam indices; 0 where there are none."""
    point_time: str
    """How the times of the points in a scan are spread."""
    scan_duration: float | None
    """Median over the sampled scans; 0: already compensated."""
    range_min: float | None
    range_max: float | None
    imu_samples: int
    imu_rate: float | None
    """Hz, by the median interval."""
    imu_gaps: int
    """Number of intervals longer than three median ones."""
    imu_longest_gap: float | None
    accel_magnitude: float | None
    """Median of |accel| as the reader gives it, m/s^2."""
    gps_fixes: int
    truth_poses: int
    calibration: bool
    """Whether the recording holds T_imu_lidar."""
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    suggested_config: list[str] = field(default_factory=list)
    """Options of ``lio-jax run`` that fit, each with its reason after '#'."""

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists for JSON."""
        return asdict(self)


@dataclass
class _ScanSummary:
    """The few numbers kept of each sampled scan, so that no scan stays in memory."""

    stamps: list[int] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    durations: list[float] = field(default_factory=list)
    time_spreads: list[float] = field(default_factory=list)
    time_values: list[int] = field(default_factory=list)
    ranges: list[tuple[float, float]] = field(default_factory=list)
    rings: set[int] = field(default_factory=set)

    def add(self, number: int, scan: LidarScan) -> None:
        self.numbers.append(number)
        self.stamps.append(scan.stamp_ns)
        self.ends.append(scan.end_ns)
        self.counts.append(len(scan.points))
        self.durations.append(scan.duration)
        if len(scan.points) == 0:
            return
        self.rings.update(np.unique(scan.ring[scan.ring >= 0]).tolist())
        self.time_spreads.append(float(scan.time.max() - scan.time.min()))
        self.time_values.append(int(np.unique(scan.time).size))
        ranges = np.linalg.norm(scan.points, axis=1)
        self.ranges.append((float(ranges.min()), float(ranges.max())))


def inspect_sequence(sequence: Sequence) -> Inspection:
    """Look over a recording by its calibration, its samples and about 20 scans spread over it."""
    summary = _ScanSummary()
    for number, scan in _sampled(sequence):
        summary.add(number, scan)
    imu, gps, truth = sequence.imu(), sequence.gps(), sequence.truth()
    info = sequence.info
    problems = list(sequence.warnings_so_far)
    problems += _scan_problems(info.scan_count, summary)
    imu_rate, imu_gaps, longest = _imu_timing(imu)
    accel = _median_accel(imu)
    problems += _imu_problems(imu, imu_rate, imu_gaps, longest, accel, summary)
    calibrated = info.T_imu_lidar is not None
    if imu is not None and not calibrated:
        problems.append(
            "there is an IMU but no calibration to the lidar: identity is used unless one is set."
        )
    return Inspection(
        name=info.name,
        format=info.format,
        path=info.path,
        sensor=info.sensor,
        scans=info.scan_count,
        duration=(summary.ends[-1] - summary.stamps[0]) * 1e-9 if summary.stamps else None,
        scan_rate=_scan_rate(summary),
        points_per_scan=_spread(summary.counts),
        rings=len(summary.rings),
        point_time=_point_time(summary),
        scan_duration=float(np.median(summary.durations)) if summary.durations else None,
        range_min=min((low for low, _ in summary.ranges), default=None),
        range_max=max((high for _, high in summary.ranges), default=None),
        imu_samples=0 if imu is None else len(imu.stamp_ns),
        imu_rate=imu_rate,
        imu_gaps=imu_gaps,
        imu_longest_gap=longest,
        accel_magnitude=accel,
        gps_fixes=0 if gps is None else len(gps.stamp_ns),
        truth_poses=0 if truth is None else len(truth),
        calibration=calibrated,
        notes=list(info.notes),
        problems=problems,
        suggested_config=_suggestions(imu, accel, calibrated, summary),
    )


def _sampled(sequence: Sequence) -> Iterator[tuple[int, LidarScan]]:
    count = sequence.info.scan_count
    numbers = np.unique(np.linspace(0, max(count - 1, 0), min(count, _SAMPLED_SCANS)).astype(int)).tolist()
    if sequence.info.format == "rosbag":
        # A bag is read from its start to reach any scan: one pass instead of twenty.
        wanted = set(numbers)
        yield from ((number, scan) for number, scan in enumerate(sequence.scans()) if number in wanted)
        return
    for number in numbers:
        for scan in sequence.scans(number, 1):
            yield number, scan


def _scan_problems(count: int, summary: _ScanSummary) -> list[str]:
    problems = []
    if not summary.counts:
        problems.append(f"none of the {count} scan(s) could be decoded.")
    elif min(summary.counts) < _FEW_POINTS:
        few = [
            number
            for number, points in zip(summary.numbers, summary.counts, strict=True)
            if points < _FEW_POINTS
        ]
        problems.append(
            f"{len(few)} of {len(summary.counts)} sampled scans hold fewer than {_FEW_POINTS} points "
            f"(first: scan {few[0]})."
        )
    if any(later <= earlier for earlier, later in zip(summary.stamps, summary.stamps[1:], strict=False)):
        problems.append("scan stamps do not ascend over the recording.")
    if len(summary.rings) == 1:
        problems.append("all points carry the same ring: scan lines cannot be told apart.")
    return problems


def _imu_problems(
    imu: ImuData | None,
    rate: float | None,
    gaps: int,
    longest: float | None,
    accel: float | None,
    summary: _ScanSummary,
) -> list[str]:
    if imu is None:
        return []
    problems = []
    if rate is not None and rate < _SLOW_IMU_HZ:
        problems.append(f"the IMU runs at {rate:.0f} Hz only: too slow to follow the motion within a sweep.")
    if gaps and longest is not None:
        problems.append(f"the IMU has {gaps} gap(s), the longest {longest:.3f} s.")
    if accel is not None and _G_RANGE[0] <= accel <= _G_RANGE[1]:
        problems.append(f"|accel| has the median {accel:.3f}: the accelerometer is in g.")
    elif accel is not None and not _SI_RANGE[0] <= accel <= _SI_RANGE[1]:
        problems.append(f"|accel| has the median {accel:.2f} m/s^2, at rest it is 9.8: check its unit.")
    if summary.stamps and len(imu.stamp_ns):
        start, end = int(imu.stamp_ns[0]), int(imu.stamp_ns[-1])
        if end < summary.stamps[0] or start > summary.ends[-1]:
            apart = max(summary.stamps[0] - end, start - summary.ends[-1]) * 1e-9
            problems.append(
                f"IMU and scans do not overlap in time ({apart:.1f} s apart): their clocks differ."
            )
    return problems


def _imu_timing(imu: ImuData | None) -> tuple[float | None, int, float | None]:
    """Return rate in Hz, number of gaps, longest gap in s."""
    if imu is None or len(imu.stamp_ns) < 2:
        return None, 0, None
    intervals: NDArray[np.float64] = np.diff(imu.stamp_ns) * 1e-9
    median = float(np.median(intervals))
    gaps = intervals[intervals > _GAP_FACTOR * median]
    return (1.0 / median if median > 0 else None), int(gaps.size), float(gaps.max()) if gaps.size else None


def _median_accel(imu: ImuData | None) -> float | None:
    if imu is None or len(imu.accel) == 0:
        return None
    return float(np.median(np.linalg.norm(imu.accel, axis=1)))


def _scan_rate(summary: _ScanSummary) -> float | None:
    if len(summary.stamps) < 2 or summary.stamps[-1] <= summary.stamps[0]:
        return None
    return (summary.numbers[-1] - summary.numbers[0]) / ((summary.stamps[-1] - summary.stamps[0]) * 1e-9)


def _spread(counts: list[int]) -> dict[str, float]:
    if not counts:
        return {"min": 0, "median": 0.0, "max": 0}
    return {"min": min(counts), "median": float(np.median(counts)), "max": max(counts)}


def _point_time(summary: _ScanSummary) -> str:
    if not summary.time_spreads:
        return "none"
    spread = float(np.median(summary.time_spreads))
    if spread == 0.0:
        return "all points at one time"
    values = math.floor(float(np.median(summary.time_values)))
    return f"{values} different times over {spread * 1e3:.1f} ms"


def _suggestions(
    imu: ImuData | None, accel: float | None, calibrated: bool, summary: _ScanSummary
) -> list[str]:
    suggested = ["--recipe default"]
    if imu is not None and not calibrated:
        suggested += [
            "--set params.extrinsics.translation=[X,Y,Z]  # T_imu_lidar, m: from its manual",
            "--set params.extrinsics.rotation=[X,Y,Z,W]  # T_imu_lidar, quaternion",
        ]
    if accel is not None and _G_RANGE[0] <= accel <= _G_RANGE[1]:
        suggested.append("--set config.data.accel_unit=g  # |accel| is near 1 at rest")
    buckets = LidarConfig().buckets
    if (largest := max(summary.counts, default=0)) > buckets[-1]:
        capacity = -(-largest // 65536) * 65536
        sizes = ",".join(str(size) for size in (*buckets, capacity))
        suggested.append(
            f"--set config.lidar.buckets=[{sizes}]  # or scans are thinned to {buckets[-1]} points"
        )
    return suggested
