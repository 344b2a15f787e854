"""Join messages that hold parts of a sweep where they are pushed instead of read."""

from lio_jax.data.cloud_fields import RawCloud
from lio_jax.data.config import DataConfig
from lio_jax.data.joined_messages import Grouping, Joining, Part, order_of
from lio_jax.data.part_recognition import LOOKED_AT_NS, narrow, recognise_joining
from lio_jax.data.point_time import TICK_NS, PointTiming
from lio_jax.data.scan_reading import ScanReading
from lio_jax.data.sequence import LidarScan

_FEW = 3
"""Number of messages that are enough to see that they are wider than parts of a sweep."""


class ScanJoiner:
    """Whole scans of messages that arrive in turn, as a bag with the same messages is read.

    The messages of the first second are kept until they show how many of them hold a sweep. From then on a
    scan comes once the first message of the next one is there. If the first messages are whole scans, all
    are handed on as they are::

        joiner = ScanJoiner()
        for message in messages:
            for scan in joiner.push(message):
                results += odometry.push_scan(scan)
        for scan in joiner.finish():
            results += odometry.push_scan(scan)
    """

    def __init__(self, messages_per_scan: int = 0) -> None:
        """Begin before the first message.

        Args:
            messages_per_scan: number of messages that are joined; 0: as many as hold a turn of a spinning
                LiDAR whose messages hold parts of it, else 1.
        """
        self._config = DataConfig(messages_per_scan=messages_per_scan)
        self._settled = messages_per_scan == 1
        self._kept: list[LidarScan] = []
        self._joined: tuple[ScanReading, Joining, Grouping] | None = None
        self._number = 0
        self._latest_ns: int | None = None
        self.notes: tuple[str, ...] = ()
        """What was recognised, in sentences."""

    def push(self, message: LidarScan) -> list[LidarScan]:
        """Take a message; return the scans that are complete.

        A message that is not later than the one before is left out where messages are joined.

        Args:
            message: points of a part of a sweep, timed from the message's own stamp.
        """
        if self._settled:
            return self._handed_on(message)
        self._kept.append(message)
        wide = False
        if not self._config.messages_per_scan and len(self._kept) <= _FEW:
            clouds = [_cloud(scan) for scan in self._kept if len(scan.points)]
            wide = len(clouds) == _FEW and not narrow(clouds)
        if wide or message.stamp_ns - self._kept[0].stamp_ns > LOOKED_AT_NS:
            return self._settle()
        return []

    def finish(self) -> list[LidarScan]:
        """Return the scans that are left; no more messages come."""
        scans = [] if self._settled else self._settle()
        if self._joined is not None:
            reading, joining, grouping = self._joined
            scans += self._read(reading, joining, grouping.rest())
        return scans

    def _settle(self) -> list[LidarScan]:
        self._settled = True
        kept, self._kept = self._kept, []
        if not kept:
            return []
        clouds = [_cloud(scan) for scan in kept]
        found = recognise_joining(clouds, _reading(kept), self._config, "pushed data")
        if found is not None:
            reading, joining = found
            self.notes = reading.notes
            self._joined = reading, joining, Grouping(order_of(joining))
        return [scan for message in kept for scan in self._handed_on(message)]

    def _handed_on(self, message: LidarScan) -> list[LidarScan]:
        if self._joined is None:
            return [message]
        if self._latest_ns is not None and message.stamp_ns <= self._latest_ns:
            return []
        self._latest_ns = message.stamp_ns
        reading, joining, grouping = self._joined
        cloud = _cloud(message)
        self._number += 1
        return self._read(
            reading, joining, grouping.take(Part(self._number - 1, joining.start_ns(cloud), cloud))
        )

    def _read(self, reading: ScanReading, joining: Joining, parts: list[Part]) -> list[LidarScan]:
        if not parts:
            return []
        whole = joining.whole([part.cloud for part in parts])
        return [reading.scan(whole, "pushed data", lambda sentence: None)]


def _cloud(scan: LidarScan) -> RawCloud:
    limits = (0.0, float(scan.duration))
    return RawCloud(
        scan.stamp_ns, scan.points, scan.intensity, scan.ring, "ring", scan.time, "time", limits, scan.dropped
    )


def _reading(messages: list[LidarScan]) -> ScanReading:
    """Return how a message's times are read; they are reconstructed where no message has a duration."""
    longest = max(message.duration for message in messages)
    timing = PointTiming(TICK_NS["s"], False, "start", longest, "") if longest > 0 else None
    return ScanReading(timing, "start", longest, 0, ())
