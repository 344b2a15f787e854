"""Inertial samples made safe to integrate: finite, ascending in time, in SI units; and what was wrong."""

from bisect import bisect_left
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.config import DataConfig
from lio_jax.data.imu_plausibility import degrees_suspected, gravity_sign, saturation
from lio_jax.data.imu_units import accel_scale
from lio_jax.data.sequence import ImuData

GAP_FACTOR = 5.0
"""An interval longer than this many median ones is a gap."""
LARGEST = 1e5
"""A reading beyond this is a fault of the recording in any unit: 10,000 g in m/s^2."""
_NAMED_AT_MOST = 3
_LATE_S = 0.1


def cleaned(
    imu: ImuData, source: str, T_imu_lidar: NDArray[np.float64] | None = None
) -> tuple[ImuData, tuple[str, ...]]:
    """Drop samples that cannot be used, convert units, and say what was done and what looks wrong.

    Dropped are samples that are not finite or impossibly large, repeat a stamp, or step back in time: of the
    order they were recorded in, the longest part whose time ascends is kept, of several the one recorded
    first. An accelerometer in g is converted. Gaps, saturation, a gyroscope in deg/s and a specific force
    that points down at rest are only reported. Times are named in s from the recording's first sample.

    Args:
        imu: in recorded order.
        source: what the sentences begin with: file or topic.
        T_imu_lidar: (4, 4); says which way is up, without it the IMU's z axis is.
    """
    origin = int(imu.stamp_ns[0]) if len(imu.stamp_ns) else 0
    said: list[str] = []
    imu = _only(imu, _finite(imu, said))
    imu = _only(imu, _ascending(imu.stamp_ns, origin, said))
    if len(imu.stamp_ns) == 0:
        return imu, tuple(f"{source}: {sentence}" for sentence in [*said, "no IMU sample is left."])
    scale, note = accel_scale(imu.accel, DataConfig())
    imu = replace(imu, accel=imu.accel * scale)
    seconds = np.asarray((imu.stamp_ns - origin) * 1e-9, np.float64)
    said += [
        f"{note}." if note else "",
        gaps(imu.stamp_ns, origin),
        *saturation(imu, seconds),
        degrees_suspected(imu, seconds),
        gravity_sign(imu, seconds, T_imu_lidar),
    ]
    return imu, tuple(f"{source}: {sentence}" for sentence in said if sentence)


def gaps(stamp_ns: NDArray[np.int64], origin_ns: int) -> str:
    """Return a sentence that names the intervals longer than ``GAP_FACTOR`` median ones, "" without any."""
    if len(stamp_ns) < 3:
        return ""
    intervals = np.diff(stamp_ns)
    median = float(np.median(intervals))
    at = np.flatnonzero(intervals > GAP_FACTOR * median)
    if len(at) == 0:
        return ""
    seconds = (stamp_ns - origin_ns) * 1e-9
    named = [f"{intervals[i] * 1e-9:.3f} s at {seconds[i]:.3f} s" for i in at[:_NAMED_AT_MOST]]
    more = ""
    if len(at) > _NAMED_AT_MOST:
        more = f" and {len(at) - _NAMED_AT_MOST} more, the longest {intervals.max() * 1e-9:.3f} s"
    return (
        f"{len(at)} gap(s) without IMU samples (usually one every {median * 1e-6:.1f} ms): "
        f"{', '.join(named)}{more}; scans in there are predicted with little or no inertial data."
    )


def coverage(imu: ImuData, start_ns: int, end_ns: int, time_offset: float = 0.0) -> list[str]:
    """Return a sentence for each end at which the samples leave scans uncovered.

    Args:
        imu: stamps ascending.
        start_ns: first scan's start, ns.
        end_ns: last scan's end, ns.
        time_offset: a scan stamped t was taken at IMU time t + time_offset, s.
    """
    if len(imu.stamp_ns) == 0:
        return []
    first, last = (stamp - round(time_offset * 1e9) for stamp in imu.stamp_ns[[0, -1]].tolist())
    late, early = (first - start_ns) * 1e-9, (end_ns - last) * 1e-9
    if last < start_ns or first > end_ns:
        side = "after" if late > 0 else "before"
        apart = (
            f"IMU samples and scans do not overlap in time, the first sample is {abs(late):.3f} s {side} the "
            "first scan; if they were recorded together their clocks differ, then set "
            f"params.extrinsics.time_offset={time_offset + late:.3f}."
        )
        return [apart]
    sentences = []
    if late > _LATE_S:
        sentences.append(
            f"the IMU starts {late:.3f} s after the first scan: until then constant velocity is assumed."
        )
    if early > _LATE_S:
        sentences.append(
            f"the IMU ends {early:.3f} s before the last scan: from then on constant velocity is assumed."
        )
    return sentences


def _only(imu: ImuData, kept: NDArray[np.bool_]) -> ImuData:
    if kept.all():
        return imu
    orientation = None if imu.orientation is None else imu.orientation[kept]
    return ImuData(imu.stamp_ns[kept], imu.gyro[kept], imu.accel[kept], orientation)


def _finite(imu: ImuData, said: list[str]) -> NDArray[np.bool_]:
    values = np.hstack([imu.gyro, imu.accel])
    possible = np.asarray((np.abs(values) < LARGEST).all(axis=1))
    if not possible.all():
        bad = np.flatnonzero(~possible)
        seconds = (imu.stamp_ns[bad[0]] - imu.stamp_ns[0]) * 1e-9
        what = (
            "NaN or infinity" if not np.isfinite(values[bad]).all() else "a value beyond any sensor's range"
        )
        said.append(f"{len(bad)} IMU sample(s) held {what}, the first at {seconds:.3f} s, and were dropped.")
    return possible


def _ascending(stamp_ns: NDArray[np.int64], origin_ns: int, said: list[str]) -> NDArray[np.bool_]:
    steps = np.diff(stamp_ns)
    kept = np.ones(len(stamp_ns), bool)
    if np.all(steps > 0):
        return kept
    # later than all before and earlier than all after: in every longest ascent
    kept[1:] &= stamp_ns[1:] > np.maximum.accumulate(stamp_ns)[:-1]
    kept[:-1] &= stamp_ns[:-1] < np.minimum.accumulate(stamp_ns[::-1])[::-1][1:]
    disputed = np.flatnonzero(~kept)
    kept[disputed[_longest_ascent(stamp_ns[disputed])]] = True
    repeats = ~kept & np.isin(stamp_ns, stamp_ns[kept])
    back = ~kept & ~repeats
    at = int(np.argmax(steps < 0))
    if steps[at] < 0:
        seconds = (stamp_ns[at] - origin_ns) * 1e-9
        said.append(
            f"the time of the IMU samples runs backwards {np.count_nonzero(steps < 0)} time(s), first at "
            f"{seconds:.3f} s by {-steps[at] * 1e-9:.3f} s: {np.count_nonzero(back)} sample(s) out of order "
            "were dropped and the rest is used."
        )
    if repeats.any():
        seconds = (stamp_ns[int(np.argmax(repeats))] - origin_ns) * 1e-9
        said.append(
            f"{np.count_nonzero(repeats)} IMU sample(s) repeat a stamp, the first at {seconds:.3f} s: "
            "the first of each was kept."
        )
    return kept


def _longest_ascent(stamps: NDArray[np.int64]) -> list[int]:
    """Return the indices of the longest strictly ascending subsequence; of several the one that is earliest.

    Patience sorting (Fredman, "On computing the length of longest increasing subsequences", 1975), from the
    back: a later sample gives way to an earlier one that does as well.
    """
    tails: list[int] = []
    tail_index: list[int] = []
    following = np.full(len(stamps), -1, np.int64)
    negated = (-stamps).tolist()
    for index in range(len(negated) - 1, -1, -1):
        length = bisect_left(tails, negated[index])
        if length:
            following[index] = tail_index[length - 1]
        if length == len(tails):
            tails.append(negated[index])
            tail_index.append(index)
        else:
            tails[length] = negated[index]
            tail_index[length] = index
    chain = []
    index = tail_index[-1] if tail_index else -1
    while index >= 0:
        chain.append(index)
        index = int(following[index])
    return chain
