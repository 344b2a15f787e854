"""Turn scans and inertial samples into the padded arrays of a step."""

from typing import Any

import numpy as np

from lio_jax.core.types import ImuBatch, Scan, state_dtype
from lio_jax.data.imu_checks import coverage
from lio_jax.data.sequence import ImuData, LidarScan
from lio_jax.lidar.params import ScanConfig


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

_BRIDGE_S = 0.5
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
    ) -> None:
        """Store the recording's samples.

        Args:
            imu: samples with strictly ascending stamps; None where the recording has none.
            buckets: padded sizes, ascending.
            time_offset: a scan stamped t was taken at IMU time t + time_offset, s.
            margin_s: largest change of an estimated offset from ``time_offset``, s; 0 if the offset is
                frozen.
            orientation: whether to pass on the IMU's own orientations, where it reports them.
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

    def warnings(self) -> list[str]:
        """Return one sentence for each way in which the samples failed to cover the scans so far."""
        if self._imu is None:
            return ["the recording holds no IMU samples: constant velocity predicts the motion."]
        sentences = []
        if self._span is not None:
            sentences += coverage(self._imu, *self._span, self._offset_ns * 1e-9)
        if self._without:
            sentences.append(
                f"{self._without} of {self._scans} scans have no IMU sample within {_BRIDGE_S} s: there the "
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
        # except where it is beyond a gap
        reach = self._margin_ns + round(_BRIDGE_S * 1e9)
        first += int(first < count and self._stamps[first] < start - reach)
        last -= int(last >= 0 and self._stamps[last] > end + reach)
        return first, max(last + 1, first)

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
