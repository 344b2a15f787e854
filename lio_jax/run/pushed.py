"""Odometry for callers that hold the loop: scans and inertial samples are pushed, results come back.

Messages that hold parts of a sweep are joined to scans before.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lio_jax.data.cloud_fields import RawCloud
from lio_jax.data.config import DataConfig
from lio_jax.data.imu_checks import LARGEST
from lio_jax.data.joined_messages import Grouping, Joining, Part, order_of
from lio_jax.data.part_recognition import LOOKED_AT_NS, narrow, recognise_joining
from lio_jax.data.point_time import TICK_NS, PointTiming
from lio_jax.data.scan_reading import ScanReading
from lio_jax.data.sequence import ImuData, LidarScan, SequenceBase, SequenceInfo, scans_from
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.localise import check_no_known_map
from lio_jax.run.run import settings_for
from lio_jax.run.scan_inputs import ImuFeed, InputsInTurn, feed_of
from lio_jax.run.track import ResultBuilder, ScanResult, StepsInTurn, on_host
from lio_jax.settings.settings import Settings, uses_imu

_PATIENCE_NS = 500_000_000
"""A scan waits for its inertial samples until data arrive whose stamps are later than its end by this."""
_KEPT_NS = 2_000_000_000
"""Inertial samples older than this before the last scan's end are dropped."""


class PushedOdometry:
    """A recipe that takes scans and inertial samples as they arrive.

    The results are those of :func:`lio_jax.run.track.track` with the same settings and data, to the bit. A
    scan is estimated once the inertial samples reach its end; the first one once the second one is there,
    because that shows how fast the vehicle was::

        odometry = PushedOdometry(settings, T_imu_lidar)
        for message in messages:
            if isinstance(message, LidarScan):
                results = odometry.push_scan(message)
            else:
                results = odometry.push_imu(message.stamp_ns, message.gyro, message.accel)
            for result in results:
                print(result.stamp_ns, result.T_world_imu)
        rest = odometry.finish()
    """

    def __init__(self, settings: Settings, T_imu_lidar: NDArray[np.float64] | None = None) -> None:
        """Begin a run; nothing is compiled before the first scan with points.

        Args:
            settings: recipe, config and params. What they leave open follows from the first scan with points,
                as :func:`lio_jax.run.run.settings_for` takes it from a recording.
            T_imu_lidar: (4, 4) pose of the lidar in the IMU frame; None: that of the settings.

        Raises:
            UsageError: the settings name a known map.
        """
        check_no_known_map(settings, "pushed data")
        self.settings = settings
        """Settings of the run; from the first scan with points on, nothing in them is open."""
        self.notes: list[str] = []
        """What was taken from the first scan, in sentences."""
        self._T_imu_lidar = T_imu_lidar
        self._waiting: deque[LidarScan] = deque()
        self._samples: list[tuple[int, NDArray[np.float64], NDArray[np.float64]]] = []
        self._newest_ns = np.iinfo(np.int64).min
        self._feed: ImuFeed | None = None
        self._parts: tuple[InputsInTurn, CompiledStep, StepsInTurn, ResultBuilder] | None = None

    def push_imu(self, stamp_ns: int, gyro: ArrayLike, accel: ArrayLike) -> list[ScanResult]:
        """Take an inertial sample; return the results that it makes possible.

        A sample that is not finite, impossibly large or not later than the last one is dropped.

        Args:
            stamp_ns: absolute time, ns.
            gyro: (3,) angular rate in the IMU frame, rad/s.
            accel: (3,) specific force in the IMU frame, m/s^2.
        """
        rate, force = np.array(gyro, np.float64), np.array(accel, np.float64)
        # a comparison with NaN is False
        possible = bool(np.all(np.abs(rate) < LARGEST) and np.all(np.abs(force) < LARGEST))
        if not possible or stamp_ns <= self._newest_ns:
            return []
        self._newest_ns = stamp_ns
        self._samples.append((stamp_ns, rate, force))
        return self._advanced() if self._waiting else []

    def push_scan(self, scan: LidarScan) -> list[ScanResult]:
        """Take a scan; return the results that it makes possible, in the order of the scans."""
        self._waiting.append(scan)
        return self._advanced()

    def finish(self) -> list[ScanResult]:
        """Return the results of the scans that still wait; no more data come."""
        results = self._advanced(to_the_end=True)
        if self._parts is not None:
            _, step, steps, judged = self._parts
            results += self._read(steps.rest(), step, judged)
        return results

    def _advanced(self, to_the_end: bool = False) -> list[ScanResult]:
        if self._parts is None:
            known = next((scan for scan in self._waiting if len(scan.points)), None)
            if known is None:
                return []
            self._begin(known)
        assert self._parts is not None
        inputs, step, steps, judged = self._parts
        self._hand_on_samples()
        results: list[ScanResult] = []
        while self._waiting and (to_the_end or self._is_covered(self._waiting[0])):
            scan = self._waiting.popleft()
            results += self._read(steps.take(inputs(scan)), step, judged)
            if self._feed is not None:
                self._feed.forget(scan.end_ns - _KEPT_NS)
        return results

    def _begin(self, scan: LidarScan) -> None:
        first = _FirstScan(scan, self._T_imu_lidar)
        self.settings, self.notes = settings_for(first, self.settings)
        self._feed = feed_of(None, self.settings) if uses_imu(self.settings) else None
        step = CompiledStep(self.settings)
        self._parts = (
            InputsInTurn(self.settings, self._feed),
            step,
            StepsInTurn(step, pager=step.pager()),
            ResultBuilder(self.settings),
        )

    def _hand_on_samples(self) -> None:
        if not self._samples:
            return
        if self._feed is not None:
            stamps, rates, forces = zip(*self._samples, strict=True)
            self._feed.append(ImuData(np.array(stamps, np.int64), np.array(rates), np.array(forces)))
        self._samples.clear()

    def _is_covered(self, scan: LidarScan) -> bool:
        if self._feed is None or self._feed.reaches(scan.end_ns):
            return True
        newest = max(self._newest_ns, self._waiting[-1].stamp_ns)
        return newest > scan.end_ns + _PATIENCE_NS

    def _read(self, steps: Iterator, step: CompiledStep, judged: ResultBuilder) -> list[ScanResult]:
        """Return the results of steps; each state is read before the next step consumes it."""
        results = []
        compiled_s = step.compile_s
        for fed, state, output in steps:
            nav, registration, read_at = on_host(state.nav, output.registration)
            compiled_in_step_s, compiled_s = step.compile_s - compiled_s, step.compile_s
            step_ms = (read_at - fed.begun_at - compiled_in_step_s) * 1e3
            results.append(judged(fed, nav, registration, output, step_ms))
        return results


class _FirstScan(SequenceBase):
    """A recording of a single scan, from which settings are taken."""

    def __init__(self, scan: LidarScan, T_imu_lidar: NDArray[np.float64] | None) -> None:
        super().__init__()
        self.info = SequenceInfo("pushed", "pushed", "pushed data", 1, T_imu_lidar)
        self._scan = scan

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        yield from [self._scan][scans_from(start, count)]


def rehearse(settings: Settings, scan: LidarScan, imu_rate: float) -> None:
    """Compile what a run of pushed data needs, by estimating a few scans at rest.

    Programs are kept for the life of the process, so a run with the same static settings, whose scans have
    the same padded size and whose samples have the same rate, compiles nothing.

    Args:
        settings: of the run.
        scan: of the size of the run's scans; it is repeated.
        imu_rate: samples per second.
    """
    period_ns, step_ns = max(round(scan.duration * 1e9), 1), max(round(1e9 / imu_rate), 1)
    # samples of up to a second before the first scan have a padded size of their own
    earlier = [0.0, _HISTORY_S]
    if uses_imu(settings):
        earlier += [size / imu_rate - scan.duration for size in feed_of(None, settings).sizes]
    for history_s in sorted(seconds for seconds in earlier if 0 <= seconds <= _HISTORY_S):
        odometry = PushedOdometry(settings)
        count = 1 if history_s else _REHEARSED
        last = scan.stamp_ns + (count + 1) * period_ns
        for stamp_ns in range(scan.stamp_ns - round(history_s * 1e9), last, step_ns):
            odometry.push_imu(stamp_ns, np.zeros(3), [0.0, 0.0, 9.81])
        for number in range(count):
            odometry.push_scan(replace(scan, stamp_ns=scan.stamp_ns + number * period_ns))
        odometry.finish()


_REHEARSED = 4
"""Number of scans of a rehearsal: the second one goes back to the first."""
_HISTORY_S = 1.0
"""Time before the first scan from which samples are used, s."""


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
