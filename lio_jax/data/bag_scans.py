"""Turn point-cloud messages into LidarScans, after recognising the layout from a topic's first messages."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.timestamps import ns_to_seconds
from lio_jax.data import pointcloud2
from lio_jax.data.bag_files import Topic, until_damage, why
from lio_jax.data.config import DataConfig
from lio_jax.data.point_time import PointTiming, TimeSample, recognise_point_time, scan_period, stamp_end
from lio_jax.data.pointcloud2 import RawCloud, decode_pointcloud2
from lio_jax.data.reconstruct import azimuth_time, check_beams, guess_beams, ring_from_elevation
from lio_jax.data.sequence import LidarScan

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_SCANS_LOOKED_AT = 8


def decode_cloud(reader: "AnyReader", topic: Topic, raw: bytes, time_field: str, where: str) -> RawCloud:
    """Decode one serialised message of ``topic``.

    Raises:
        LioJaxError: the topic's layout cannot be used.
        ValueError: this one message is damaged.
    """
    if topic.type in pointcloud2.LIVOX_TYPES:
        return pointcloud2.decode_custom_msg(raw, reader.is2)
    try:
        message: Any = reader.deserialize(raw, topic.type)
    # The generated decoders raise struct, index, unicode or their own errors on damaged bytes.
    except Exception as error:
        raise ValueError(f"the message cannot be decoded: {why(error)}") from error
    return decode_pointcloud2(message, time_field=time_field, where=where)


@dataclass(frozen=True)
class ScanReading:
    """How a topic's clouds become scans; all scans of the topic share it."""

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
        if (high - low) * self.timing.tick_ns * 1e-9 > 2.0 * self.sweep:
            outliers = self.timing.outliers(time)
            if outliers is not None:
                keep = ~outliers
                time = time[keep]
                warn(f"{name}: {np.count_nonzero(outliers)} points with impossible times were dropped.")
            if time.size:
                low, high = time.min().item(), time.max().item()
        return *self.timing.place(cloud.stamp_ns, time, low, high), keep


def recognise_scans(
    reader: "AnyReader",
    topic: Topic,
    messages: Iterator[tuple[Any, int, bytes]],
    config: DataConfig,
    where: str,
) -> ScanReading:
    """Settle from the topic's first scans with points how its clouds are read.

    Args:
        reader: the open bag.
        topic: the topic of the point clouds.
        messages: (connection, receipt time in ns, bytes) of each message of the topic, in order; they may end
            in damage.
        config: settings that override what is recognised.
        where: name of bag and topic in errors.

    Raises:
        LioJaxError: the layout cannot be used, or no message can be decoded.
    """
    first: RawCloud | None = None
    headers: list[int] = []
    samples: list[TimeSample] = []
    beams: list[int] = []
    kind = reason = ""
    damage: list[str] = []
    for _, received_ns, raw in until_damage(messages, damage.append):
        try:
            cloud = decode_cloud(reader, topic, raw, config.time_field, where)
        except ValueError as error:
            reason = f" ({error})"
            continue
        if first is None or not len(first.points):
            first = cloud
        if not len(cloud.points):
            continue
        headers.append(cloud.stamp_ns)
        if cloud.ring is None:
            beams.append(config.beams or guess_beams(cloud.points))
        low, high = cloud.time_range or (0, 0)
        if cloud.time is not None:
            kind = cloud.time.dtype.name
        samples.append(TimeSample(cloud.stamp_ns, received_ns, low, high))
        if len(headers) == _SCANS_LOOKED_AT:
            break
    if first is None:
        reason = reason or "".join(f" ({cause})" for cause in damage)
        raise LioJaxError(
            f"{where}: no point cloud can be read{reason}; the recording is empty or damaged there."
        )
    chosen_beams = max(set(beams), key=beams.count) if beams else config.beams or 16
    ring_note = _ring_note(first, chosen_beams, config.beams > 0, where)
    if config.compensated == "yes":
        time_note = "points are taken as motion compensated to the header stamp (config.data.compensated)"
        return ScanReading(None, "start", 0.0, chosen_beams, (time_note, *ring_note))
    timing = recognise_point_time(samples, first.time_field, kind, config) if kind else None
    if timing is not None:
        return ScanReading(timing, "start", timing.sweep, chosen_beams, (timing.note, *ring_note))
    period = scan_period(headers, config.scan_period)
    stamp_at, note = stamp_end(samples, period, config) if samples else ("start", "no points in any message")
    missing = f"field {first.time_field!r} holds a single value" if first.time_field else "not recorded"
    time_note = f"per-point time: {missing}, reconstructed from azimuth over {period:.4g} s a scan, {note}"
    return ScanReading(None, stamp_at, period, chosen_beams, (time_note, *ring_note))


def _ring_note(cloud: RawCloud, beams: int, given: bool, where: str) -> tuple[str, ...]:
    if cloud.ring is None:
        reconstructed = f"ring: not recorded, reconstructed from elevation as of {beams} beams"
        misfit = check_beams(cloud.points, beams, given, where)
        return (f"{reconstructed} (config.data.beams)", *(f"ring: {sentence}" for sentence in misfit))
    if cloud.ring_source == "rows":
        return ("ring: not recorded, taken from the rows of the organised cloud",)
    return ()
