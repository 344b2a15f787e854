"""Odometry for callers that hold the loop: scans and inertial samples are pushed, results come back."""

from collections import deque
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lio_jax.data.imu_checks import LARGEST
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, SequenceInfo
from lio_jax.data.trajectory import Trajectory
from lio_jax.run.localise import check_no_known_map
from lio_jax.run.run import settings_for
from lio_jax.run.scan_inputs import ImuFeed, InputsInTurn, feed_of
from lio_jax.run.track import CompiledStep, ResultBuilder, ScanResult, StepsInTurn, on_host
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


class _FirstScan:
    """A recording of a single scan, from which settings are taken."""

    def __init__(self, scan: LidarScan, T_imu_lidar: NDArray[np.float64] | None) -> None:
        self.info = SequenceInfo("pushed", "pushed", "pushed data", 1, T_imu_lidar)
        self.warnings_so_far: tuple[str, ...] = ()
        self._scan = scan

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        yield from [self._scan][start : None if count is None else start + count]

    def imu(self) -> ImuData | None:
        return None

    def gps(self) -> GpsData | None:
        return None

    def truth(self) -> Trajectory | None:
        return None


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
