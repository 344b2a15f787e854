"""Turn scans and inertial samples into the padded arrays of a step."""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.types import ImuBatch, Scan, state_dtype
from lio_jax.data.imu_checks import coverage
from lio_jax.data.sequence import ImuData, LidarScan
from lio_jax.imu.params import OrientedImuConfig
from lio_jax.lidar.params import ScanConfig
from lio_jax.recipes import recipe_named
from lio_jax.recipes.params import InertialConfig
from lio_jax.run.shown_motion import first_velocity
from lio_jax.settings.settings import Settings


def bucket_for(count: int, config: ScanConfig) -> int:
    """Return the smallest padded size that holds ``count`` points, or the largest there is."""
    return next((size for size in config.buckets if size >= count), config.buckets[-1])


def padded(scan: LidarScan, last_end_ns: int | None, config: ScanConfig, size: int | None = None) -> Scan:
    """Copy a scan into zero-padded arrays of its bucket's size.

    A scan larger than the largest bucket is thinned to it by an even stride. Points that are not finite stay
    in; the range check of the step drops them.

    Args:
        scan: the scan as recorded.
        last_end_ns: end of the previous scan, ns; None for the first scan.
        config: bucket sizes.
        size: padded size; None: the smallest bucket that fits.
    """
    count = len(scan.points)
    size = size or bucket_for(count, config)
    keep = slice(None) if count <= size else np.linspace(0, count - 1, size).astype(np.intp)
    interval = 0 if last_end_ns is None else scan.end_ns - last_end_ns
    # host arrays: jit takes them as they are, which saves one copy compared with jnp
    arrays: dict[str, Any] = {
        "points": _extended(scan.points[keep], size, np.float32),
        "time": _extended(scan.time[keep], size, np.float32),
        "ring": _extended(scan.ring[keep], size, np.int32),
        "intensity": _extended(scan.intensity[keep], size, np.float32),
        "mask": np.arange(size) < count,
        "duration": np.float32(scan.duration),
        "interval": np.float32(interval * 1e-9),
    }
    return Scan(**arrays)


def _extended(values: np.ndarray, size: int, dtype: type) -> np.ndarray:
    """Return ``values`` followed by zeros; only the padding is cleared, to save time."""
    extended = np.empty((size, *values.shape[1:]), dtype)
    extended[: len(values)] = values
    extended[len(values) :] = 0
    return extended


OFFSET_MARGIN_S = 0.05
"""Largest change of an estimated time offset from its first value for which samples are available, s."""

_NEAR_S = 0.2
"""A neighbouring sample farther than this from a scan's interval does not describe the motion in it, s."""


class ImuFeed:
    """Cut a recording's inertial samples into one padded batch per scan, for scans in ascending order."""

    def __init__(
        self,
        imu: ImuData | None,
        buckets: tuple[int, ...],
        time_offset: float = 0.0,
        margin_s: float = OFFSET_MARGIN_S,
        orientation: bool = False,
        bridge_s: float = 0.0,
    ) -> None:
        """Store the recording's samples.

        Args:
            imu: samples with strictly ascending stamps; None where the recording has none.
            buckets: padded sizes, ascending.
            time_offset: a scan stamped t was taken at IMU time t + time_offset, s.
            margin_s: largest change of an estimated offset from ``time_offset``, s; 0 if the offset is
                frozen.
            orientation: whether to pass on the IMU's own orientations, where it reports them.
            bridge_s: longest gap, s, in which the line between its ends stands for the samples.
        """
        count = 0 if imu is None else len(imu.stamp_ns)
        self._imu = imu if count else None
        self._stamps = np.zeros(0, np.int64) if imu is None else imu.stamp_ns
        values = np.zeros((0, 6)) if imu is None else np.concatenate([imu.gyro, imu.accel], axis=1)
        attitudes = imu.orientation if imu is not None and orientation else None
        self._with_orientation = attitudes is not None
        if attitudes is not None:
            values = np.concatenate([values, attitudes], axis=1)
        self._values = np.ascontiguousarray(values, state_dtype())
        self._buckets = buckets
        self._offset_ns = round(time_offset * 1e9)
        self._margin_ns = round(margin_s * 1e9)
        self._bridge_ns = round(bridge_s * 1e9)
        self._span: tuple[int, int] | None = None
        self._scans = self._without = self._thinned = 0

    @property
    def samples(self) -> ImuData | None:
        """Return the recording's samples; None where it has none."""
        return self._imu

    def batch(self, scan: LidarScan, last_end_ns: int | None) -> ImuBatch:
        """Return the samples from the last scan's end to this scan's end, and the neighbours on both sides.

        Times count from the scan's start on the IMU's clock: the time offset is not subtracted. More samples
        than the largest padded size are thinned to it by an even stride. Padding repeats the last sample.

        Args:
            scan: the scan as recorded.
            last_end_ns: end of the previous scan, ns; None for the first scan, which is covered from its
                start.
        """
        start_ns = scan.stamp_ns if last_end_ns is None else min(last_end_ns, scan.stamp_ns)
        first, last = self._range(start_ns, scan.end_ns)
        self._span = (start_ns if self._span is None else self._span[0], scan.end_ns)
        self._scans += 1
        self._without += last == first
        self._thinned += last - first > self._buckets[-1]
        return self._padded(first, last, scan.stamp_ns)

    def before(self, scan: LidarScan, seconds: float = 1.0) -> ImuBatch:
        """Return the samples of the last ``seconds`` up to the scan's end, for an initialisation at rest."""
        end_ns = scan.end_ns + self._offset_ns
        bounds = (end_ns - round(seconds * 1e9), end_ns)
        first, last = np.searchsorted(self._stamps, bounds).tolist()
        return self._padded(first, last, scan.stamp_ns)

    @property
    def sizes(self) -> tuple[int, ...]:
        """Return the padded sizes, ascending."""
        return self._buckets

    def append(self, later: ImuData) -> None:
        """Add later samples with strictly ascending stamps and without orientations."""
        self._stamps = np.concatenate([self._stamps, later.stamp_ns])
        values = np.concatenate([later.gyro, later.accel], axis=1).astype(self._values.dtype)
        self._values = np.concatenate([self._values, values])

    def forget(self, before_ns: int) -> None:
        """Drop the samples before a time of the lidar's clock."""
        first = int(np.searchsorted(self._stamps, before_ns + self._offset_ns))
        self._stamps, self._values = self._stamps[first:], self._values[first:]

    def reaches(self, end_ns: int) -> bool:
        """Return whether there are samples up to a scan's end, one beyond it included."""
        needed = end_ns + self._offset_ns + self._margin_ns
        return len(self._stamps) > 0 and int(self._stamps[-1]) >= needed

    def warnings(self) -> list[str]:
        """Return one sentence for each way in which the samples failed to cover the scans so far."""
        if self._imu is None:
            return ["the recording holds no IMU samples: constant velocity predicts the motion."]
        sentences = []
        if self._span is not None:
            sentences += coverage(self._imu, *self._span, self._offset_ns * 1e-9)
        if self._without:
            sentences.append(
                f"{self._without} of {self._scans} scans have no IMU sample within {_NEAR_S} s: there the "
                "motion is predicted by constant velocity."
            )
        if self._thinned:
            sentences.append(
                f"{self._thinned} scans are covered by more than {self._buckets[-1]} IMU samples and were "
                "thinned to that many evenly; append a larger size to config.imu.buckets to use them all."
            )
        return sentences

    def _range(self, start_ns: int, end_ns: int) -> tuple[int, int]:
        """Return the first and one past the last sample for the motion between two lidar times."""
        start, end = start_ns + self._offset_ns, end_ns + self._offset_ns
        count = len(self._stamps)
        # one neighbour beyond each end, for the interpolation,
        first = int(np.searchsorted(self._stamps, start - self._margin_ns, "right")) - 1
        last = int(np.searchsorted(self._stamps, end + self._margin_ns, "left"))
        first, last = max(first, 0), min(last, count - 1)
        # except where it is far and beyond a long gap
        reach = self._margin_ns + round(_NEAR_S * 1e9)
        early = first < count and self._stamps[first] < start - reach and not self._bridged(first)
        late = last >= 0 and self._stamps[last] > end + reach and not self._bridged(last - 1)
        first, last = first + early, last - late
        return first, max(last + 1, first)

    def _bridged(self, index: int) -> bool:
        """Return whether the gap between a sample and the next one is short enough for a line."""
        if not 0 <= index < len(self._stamps) - 1:
            return False
        return bool(self._stamps[index + 1] - self._stamps[index] <= self._bridge_ns)

    def _padded(self, first: int, last: int, origin_ns: int) -> ImuBatch:
        count = last - first
        size = next((size for size in self._buckets if size >= count), self._buckets[-1])
        keep: Any = slice(first, last)
        if count > size:
            keep = first + np.linspace(0, count - 1, size).astype(np.intp)
        filled = min(count, size)
        seconds = np.empty(size, self._values.dtype)
        values = np.empty((size, self._values.shape[1]), self._values.dtype)
        seconds[:filled] = (self._stamps[keep] - origin_ns) * 1e-9
        values[:filled] = self._values[keep]
        seconds[filled:] = seconds[filled - 1] if filled else 0
        values[filled:] = values[filled - 1] if filled else 0
        mask = np.zeros(size, bool)
        mask[:filled] = True
        # host arrays, as for the scan: jit takes them as they are
        arrays: dict[str, Any] = {
            "time": seconds,
            "gyro": values[:, :3],
            "accel": values[:, 3:6],
            "mask": mask,
        }
        if self._with_orientation:
            arrays["orientation"] = values[:, 6:]
        return ImuBatch(**arrays)


def feed_of(imu: ImuData | None, settings: Settings) -> ImuFeed:
    """Return a feed of checked samples as the settings of a recipe that uses them want it.

    Args:
        imu: all samples; None: there are none yet.
        settings: of the run.
    """
    config = settings.config
    assert isinstance(config, InertialConfig)
    estimated = settings.values["initial"]["time_offset_sigma"] > 0
    margin = OFFSET_MARGIN_S if estimated else 0.0
    offset = settings.values["extrinsics"]["time_offset"]
    own = isinstance(config.imu, OrientedImuConfig) and config.imu.orientation
    bridge = recipe_named(settings.recipe).longest_bridged_gap
    return ImuFeed(imu, config.imu.buckets, offset, margin, own, bridge)


@dataclass(frozen=True)
class ScanInput:
    """One scan as a step takes it."""

    index: int
    end_ns: int
    count: int
    """Points of the scan as it was recorded."""
    covered: bool
    """Whether something covers the sensor; the points are then masked."""
    usable: bool
    """Whether the scan can begin a map, or a map has begun before it."""
    scan: Scan
    imu: ImuBatch | None
    before: ImuBatch | None
    """Samples up to this scan's end, for a start here; None after the first usable scan."""
    first_velocity: NDArray[np.float64] | None
    """(3,) velocity at the first scan's end that this second scan shows, m/s along the IMU's axes; None for
    the other scans, and where the vehicle is slow or ``params.initial.velocity`` is not zero."""
    pad_ms: float
    begun_at: float = 0.0
    """Host time at which its step began, s."""


class InputsInTurn:
    """Turns scans into the inputs of steps, one scan at a time."""

    def __init__(self, settings: Settings, imu: ImuFeed | None) -> None:
        """Begin a run.

        Args:
            settings: padded sizes, ranges, and whether the first velocity is searched.
            imu: inertial samples that cover the scans; None: the recipe does without.
        """
        self._settings, self._imu = settings, imu
        self._to_search = not any(settings.values["initial"]["velocity"])
        self._R_imu_lidar = Rotation.from_quat(settings.values["extrinsics"]["rotation"])
        self._last_end_ns: int | None = None
        self._last_count = self._size = self._index = 0
        self._first: ScanInput | None = None
        self._opened = False

    def __call__(self, scan: LidarScan) -> ScanInput:
        """Return the next scan in padded arrays, with the inertial samples that cover it."""
        start = time.perf_counter()
        settings, imu, first = self._settings, self._imu, self._first
        count = len(scan.points)
        covered = is_covered(scan)
        # an empty or torn scan among whole ones is not worth compiling a program of its own size
        if count >= _STRAGGLER * self._last_count:
            self._size = bucket_for(count, settings.config.lidar)
        arrays = padded(scan, self._last_end_ns, settings.config.lidar, self._size)
        samples = imu.batch(scan, self._last_end_ns) if imu else None
        before = imu.before(scan) if imu and first is None else None
        if covered:
            nothing: Any = np.zeros(len(arrays.mask), np.bool_)
            arrays = replace(arrays, mask=nothing)
        usable = self._opened or sees_enough(arrays, settings)
        velocity = None
        if first is not None and not self._opened and usable and self._to_search:
            interval = (scan.end_ns - first.end_ns) * 1e-9
            velocity = first_velocity(first.scan, arrays, interval, first.before, samples, self._R_imu_lidar)
        pad_ms = (time.perf_counter() - start) * 1e3
        fed = ScanInput(
            self._index, scan.end_ns, count, covered, usable, arrays, samples, before, velocity, pad_ms
        )
        self._opened = first is not None
        self._first = first or (fed if usable else None)
        self._last_end_ns, self._last_count = scan.end_ns, count
        self._index += 1
        return fed


_COVERED_M, _COVERED_SHARE = 1.0, 0.95
"""A scan shows nothing but a cover if this share of its points is nearer than this distance, m."""
_STRAGGLER = 0.25
"""A scan with less than this share of the points of the scan before keeps that one's padded size."""


def is_covered(scan: LidarScan) -> bool:
    """Return whether nearly all points are so near that something covers the sensor."""
    some = scan.points[:: max(1, len(scan.points) // 1000)]
    return len(some) > 0 and bool(np.mean(np.linalg.norm(some, axis=1) < _COVERED_M) > _COVERED_SHARE)


def sees_enough(scan: Scan, settings: Settings) -> bool:
    """Return whether a scan has the points in range that a match needs; a blocked sensor has none."""
    lidar, needed = settings.values["lidar"], settings.values["registration"]["min_matches"]
    squared = np.einsum("ij,ij->i", scan.points, scan.points)
    in_range = (squared > lidar["min_range"] ** 2) & (squared < lidar["max_range"] ** 2) & scan.mask
    return int(np.count_nonzero(in_range)) >= needed
