"""Turn clouds into LidarScans, after recognising from the first clouds how they state times and rings."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.timestamps import FARTHEST_NS, ns_to_seconds
from lio_jax.data.cloud_fields import RawCloud
from lio_jax.data.config import DataConfig
from lio_jax.data.point_time import PointTiming, TimeSample, recognise_point_time, scan_period, stamp_end
from lio_jax.data.reconstruct import azimuth_time, check_beams, guess_beams, ring_from_elevation
from lio_jax.data.sequence import LidarScan

SCANS_LOOKED_AT = 8
"""Number of clouds with points from which their reading is recognised."""


@dataclass(frozen=True)
class ScanReading:
    """How a recording's clouds become scans; all scans share it."""

    timing: PointTiming | None
    """Meaning of the point times; None where they are reconstructed or the points are motion compensated."""
    stamp_at: Literal["start", "end"]
    """Which end of the scan the header stamp marks if ``timing`` is None."""
    sweep: float
    """Usual duration of a scan, s; 0 where points are motion compensated."""
    beams: int
    """Number of beams for the reconstruction of rings; 0 where messages hold the ring."""
    notes: tuple[str, ...]

    def scan(self, cloud: RawCloud, name: str, warn: Callable[[str], None]) -> LidarScan:
        """Place a decoded cloud in time and fill in what it lacks.

        Args:
            cloud: the decoded message.
            name: the scan's name in warnings.
            warn: called with one sentence for each problem.
        """
        start_ns, time, duration, keep = self._times(cloud, name, warn)
        points, intensity, ring = cloud.points, cloud.intensity, cloud.ring
        if ring is None:
            ring = ring_from_elevation(points, self.beams)
        if keep is not None:
            points, intensity, ring = points[keep], intensity[keep], ring[keep]
        if len(points) == 0:
            warn(f"{name} ({ns_to_seconds(start_ns)} s) holds no points.")
        return LidarScan(start_ns, points, time, ring, intensity, duration, cloud.dropped)

    def _times(
        self, cloud: RawCloud, name: str, warn: Callable[[str], None]
    ) -> tuple[int, NDArray[np.float32], float, NDArray[np.bool_] | None]:
        if self.timing is None or cloud.time is None or cloud.time_range is None:
            at_end = self.stamp_at == "end" if self.timing is None else self.timing.anchor == "end"
            start_ns = cloud.stamp_ns - round(self.sweep * 1e9) if at_end else cloud.stamp_ns
            return start_ns, azimuth_time(cloud.points, self.sweep), self.sweep, None
        low, high = cloud.time_range
        time, keep = cloud.time, None
        if not self.timing.can_be_scan(low, high):
            outliers = self.timing.outliers(time)
            if outliers is not None:
                keep = ~outliers
                time = time[keep]
                warn(f"{name}: {np.count_nonzero(outliers)} points with impossible times were dropped.")
            if not time.size:
                return cloud.stamp_ns, time.astype(np.float32), self.sweep, keep
            low, high = time.min().item(), time.max().item()
        start_ns, seconds, duration = self.timing.place(cloud.stamp_ns, time, low, high)
        if not abs(start_ns) < FARTHEST_NS:
            warn(f"{name}: {len(time)} points with impossible times were dropped.")
            nothing = np.zeros(0, np.float32)
            return cloud.stamp_ns, nothing, self.sweep, np.zeros(len(cloud.points), bool)
        return start_ns, seconds, duration, keep


def first_clouds(clouds: Iterable[tuple[RawCloud, int]]) -> list[tuple[RawCloud, int]]:
    """Return the first clouds, up to those with points from which the reading is recognised."""
    taken: list[tuple[RawCloud, int]] = []
    with_points = 0
    for cloud in clouds:
        taken.append(cloud)
        with_points += bool(len(cloud[0].points))
        if with_points == SCANS_LOOKED_AT:
            break
    return taken


def recognise_clouds(
    clouds: Iterable[tuple[RawCloud, int]],
    config: DataConfig,
    where: str,
    stamped: bool = True,
    known_whole: bool = False,
) -> ScanReading | None:
    """Settle from the first clouds with points how clouds are read; None where there are no clouds.

    Args:
        clouds: each cloud with the time of its receipt, ns, in recorded order; only the first are taken.
        config: settings that override what is recognised.
        where: what is read, in errors.
        stamped: whether the clouds' stamps are recorded; false where they are only counted.
        known_whole: whether the clouds are known to be scans, so that no note doubts it.

    Raises:
        UsageError: the settings name a number of beams that the points do not fit.
    """
    taken = first_clouds(clouds)
    if not taken:
        return None
    reading = recognise_times(taken, config, stamped)
    beams, ring_notes = recognise_rings([cloud for cloud, _ in taken], config, where)
    sectors = [] if known_whole else [_sectors(cloud.points) for cloud, _ in taken if len(cloud.points)]
    return replace(reading, beams=beams, notes=(*reading.notes, *ring_notes, *_parts_note(sectors)))


def recognise_times(
    clouds: Sequence[tuple[RawCloud, int]],
    config: DataConfig,
    stamped: bool = True,
    called: str = "scan",
) -> ScanReading:
    """Settle how clouds state their times; the number of beams is left open.

    Args:
        clouds: at least one cloud with the time of its receipt, ns, in recorded order.
        config: settings that override what is recognised.
        stamped: whether the clouds' stamps are recorded.
        called: word for a cloud in the note: scan, or message where several are joined to a scan.
    """
    if config.compensated == "yes":
        note = "points are taken as motion compensated to the header stamp (config.data.compensated)"
        return ScanReading(None, "start", 0.0, 0, (note,))
    with_points = [(cloud, received_ns) for cloud, received_ns in clouds if len(cloud.points)]
    samples = [
        TimeSample(cloud.stamp_ns, received_ns, *(cloud.time_range or (0, 0)))
        for cloud, received_ns in with_points
    ]
    kind = next((c.time.dtype.name for c, _ in reversed(with_points) if c.time is not None), "")
    field = _first_with_points([cloud for cloud, _ in clouds]).time_field
    timing = recognise_point_time(samples, field, kind, config, stamped, called) if kind else None
    if timing is not None:
        return ScanReading(timing, "start", timing.sweep, 0, (timing.note,))
    period = scan_period([sample.header_ns for sample in samples], config.scan_period)
    stamp_at, note = (
        stamp_end(samples, period, config, called) if samples else ("start", "no points in any cloud")
    )
    missing = f"field {field!r} holds a single value" if field else "not recorded"
    time_note = (
        f"per-point time: {missing}, reconstructed from azimuth over {period:.4g} s a {called}, {note}"
    )
    return ScanReading(None, stamp_at, period, 0, (time_note,))


def recognise_rings(
    clouds: Sequence[RawCloud], config: DataConfig, where: str
) -> tuple[int, tuple[str, ...]]:
    """Return the number of beams for the reconstruction of rings, and a note where rings are missing.

    Args:
        clouds: at least one cloud.
        config: the number of beams where it is given.
        where: what is read, in errors.

    Raises:
        UsageError: the settings name a number of beams that the points do not fit.
    """
    bare = [cloud for cloud in clouds if len(cloud.points) and cloud.ring is None]
    beams = [config.beams or guess_beams(cloud.points) for cloud in bare]
    chosen = max(set(beams), key=beams.count) if beams else config.beams or 16
    return chosen, _ring_note(_first_with_points(clouds), chosen, config.beams > 0, where)


def _first_with_points(clouds: Sequence[RawCloud]) -> RawCloud:
    return next((cloud for cloud in clouds if len(cloud.points)), clouds[-1])


_SECTORS = 36


def _sectors(points: NDArray[np.float32]) -> frozenset[int]:
    """Return the sectors of 10 deg of azimuth that hold points."""
    turned = np.arctan2(points[:, 1], points[:, 0])
    return frozenset(np.unique(((turned / (2 * np.pi)) % 1.0 * _SECTORS).astype(int)).tolist())


def _parts_note(sectors: list[frozenset[int]]) -> tuple[str, ...]:
    """Return a sentence if clouds that follow each other see different sectors, as parts of a sweep do."""
    largest = max(map(len, sectors), default=0)
    if len(sectors) < 3 or largest > 0.6 * _SECTORS:
        return ()
    # a sensor with a narrow view sees the same sectors in each cloud
    if len(frozenset().union(*sectors)) < 1.5 * largest:
        return ()
    sentence = (
        f"each cloud holds a part of a sweep only (at most {10 * largest} deg of azimuth) and is read as a "
        "scan of its own; let the driver publish whole sweeps, or join N messages of a bag with "
        "config.data.messages_per_scan=N"
    )
    return (sentence,)


def _ring_note(cloud: RawCloud, beams: int, given: bool, where: str) -> tuple[str, ...]:
    if cloud.ring is None:
        reconstructed = f"ring: not recorded, reconstructed from elevation as of {beams} beams"
        misfit = check_beams(cloud.points, beams, given, where)
        return (f"{reconstructed} (config.data.beams)", *(f"ring: {sentence}" for sentence in misfit))
    if cloud.ring_source == "rows":
        return ("ring: not recorded, taken from the rows of the organised cloud",)
    return ()
