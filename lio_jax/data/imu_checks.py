"""Checks of the units and the plausibility of inertial samples, and the rules for dropping samples."""

from bisect import bisect_left
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.config import DataConfig
from lio_jax.data.imu_faults import unmeasured
from lio_jax.data.sequence import ImuData

GAP_FACTOR = 5.0
"""An interval longer than this multiple of the median interval is a gap."""
LARGEST = 1e5
"""A reading above this is a fault of the recording in any unit: 10,000 g in m/s^2."""
_NAMED_AT_MOST = 3
_LATE_S = 0.1
_NONE_LEFT = "no IMU sample is left."
_STEADY = 0.1
"""An interval within this share of the median one is regular."""
_MISSING = 0.02
"""Smaller shares of missing samples are not named."""


def cleaned(
    imu: ImuData, source: str, T_imu_lidar: NDArray[np.float64] | None = None
) -> tuple[ImuData, tuple[str, ...]]:
    """Drop samples that cannot be used, convert units, and report the changes and the suspicions.

    Samples are dropped if they are not finite or impossibly large, if they repeat a stamp, or if they step
    back in time. If time steps back, the longest subsequence with ascending time is kept; of several the
    earliest one. Samples that do not measure the motion are dropped too
    (:func:`lio_jax.data.imu_faults.unmeasured`): spikes, a stuck axis, blocks that are sent again. An
    accelerometer in g is converted. Gaps, missing samples, saturation, a gyroscope in deg/s and a specific
    force that points down at rest are reported only. Sentences state times in s from the recording's first
    sample.

    Args:
        imu: samples in recorded order.
        source: file or topic, with which the sentences begin.
        T_imu_lidar: (4, 4) pose of the lidar in the IMU frame, whose z axis is taken as up; None: the IMU's.
    """

    origin = int(imu.stamp_ns[0]) if len(imu.stamp_ns) else 0
    messages: list[str] = []
    imu = _only(imu, _finite(imu, messages))
    imu = _only(imu, _ascending(imu.stamp_ns, origin, messages))
    if len(imu.stamp_ns) == 0:
        return imu, tuple(f"{source}: {sentence}" for sentence in [*messages, _NONE_LEFT])
    scale, note = accel_scale(imu.accel, DataConfig())
    imu = replace(imu, accel=imu.accel * scale)
    messages += [f"{note}." if note else "", missing(imu.stamp_ns), gaps(imu.stamp_ns, origin)]
    bad, sentences = unmeasured(imu, np.asarray((imu.stamp_ns - origin) * 1e-9, np.float64))
    messages += sentences
    imu = _only(imu, ~bad)
    if len(imu.stamp_ns) == 0:
        return imu, tuple(f"{source}: {sentence}" for sentence in [*messages, _NONE_LEFT] if sentence)
    seconds = np.asarray((imu.stamp_ns - origin) * 1e-9, np.float64)
    messages += [
        *saturation(imu, seconds),
        degrees_suspected(imu, seconds),
        gravity_sign(imu, seconds, T_imu_lidar),
    ]
    return imu, tuple(f"{source}: {sentence}" for sentence in messages if sentence)


STANDARD_GRAVITY = 9.80665
"""Standard gravity, m/s^2."""


def accel_scale(accel: NDArray[np.float64], config: DataConfig) -> tuple[float, str]:
    """Return the factor that converts the samples to m/s^2, and a note ("" where nothing was converted).

    Over a recording the median specific force is near one gravity for any motion of a vehicle, so it is near
    1 for an accelerometer in g and near 9.8 for one in m/s^2.

    Args:
        accel: (m, 3) specific force as recorded.
        config: its ``accel_unit`` overrides the recognition.
    """
    if config.accel_unit != "auto":
        return (STANDARD_GRAVITY if config.accel_unit == "g" else 1.0), ""
    if len(accel) == 0:
        return 1.0, ""
    # one damaged sample may be beyond any number's square
    with np.errstate(over="ignore", invalid="ignore"):
        median = float(np.median(np.linalg.norm(accel, axis=1)))
    if 0.8 <= median <= 1.25:
        return STANDARD_GRAVITY, f"accelerometer in g (median {median:.3f}): converted to m/s^2"
    if not 7.0 <= median <= 13.0:
        return 1.0, (
            f"the accelerometer's median strength {median:.3g} is neither 1 g nor 9.8 m/s^2: taken as m/s^2, "
            "set config.data.accel_unit if it is not"
        )
    return 1.0, ""


_WINDOW_S = 0.5
_FASTEST = 8.0
"""Largest plausible mean angular rate of a vehicle or a hand over half a second, rad/s."""
_CLEAR_TURN = 0.2
_SEEN_SHARE = 0.15
_STILL_GYRO = 0.05
_STILL_ACCEL = 0.3
_PILE = 5
_RUN = 3
_LOWEST_GYRO_LIMIT = 0.5
_LOWEST_ACCEL_LIMIT = 12.0


def saturation(imu: ImuData, seconds: NDArray[np.float64]) -> list[str]:
    """Return a sentence for each axis whose extreme value is held repeatedly."""
    sentences = []
    for values, name, unit, lowest in (
        (imu.gyro, "gyroscope", "rad/s", _LOWEST_GYRO_LIMIT),
        (imu.accel, "accelerometer", "m/s^2", _LOWEST_ACCEL_LIMIT),
    ):
        for axis in range(3):
            column = values[:, axis]
            clipped = [
                at for limit in (column.min(), column.max()) if len(at := _held(column, limit, lowest))
            ]
            if not clipped:
                continue
            at = np.sort(np.concatenate(clipped))
            limits = " and ".join(f"{column[part[0]]:.4g}" for part in clipped)
            sentences.append(
                f"the {name}'s {'xyz'[axis]} axis stays at {limits} {unit} for {len(at)} samples, the first "
                f"at {seconds[at[0]]:.3f} s: it is saturated there, use a larger measuring range."
            )
    return sentences


def degrees_suspected(imu: ImuData, seconds: NDArray[np.float64]) -> str:
    """Return a sentence if the angular rates are too high for rad/s, as such or compared with gravity."""
    sums = _windowed(np.concatenate([imu.gyro, imu.accel], axis=1), seconds, _WINDOW_S)
    if len(sums) < 4:
        return ""
    rate = np.linalg.norm(sums[:, :3], axis=1)
    advice = (
        "it is suspected that the gyroscope is in deg/s: multiply the recorded rates by pi/180 = 0.0174533."
    )
    if rate.max() > _FASTEST:
        at = int(np.argmax(rate)) * _WINDOW_S
        return (
            f"the angular rate averages {rate.max():.1f} rad/s over half a second at {at:.1f} s, more than "
            f"vehicles and hands turn; {advice}"
        )
    # gravity is fixed in the world: in the frame of a body that rolls or pitches it turns by the same angle
    strength = np.linalg.norm(sums[:, 3:], axis=1, keepdims=True)
    down = sums[:, 3:] / np.where(strength > 0, strength, 1.0)
    turn = (sums[1:, :3] + sums[:-1, :3]) / 2 * _WINDOW_S
    expected = np.linalg.norm(np.cross(turn, (down[1:] + down[:-1]) / 2), axis=1)
    seen = np.linalg.norm(down[1:] - down[:-1], axis=1)
    expected_rms, seen_rms = np.sqrt(np.mean(expected**2)), np.sqrt(np.mean(seen**2))
    if expected_rms > _CLEAR_TURN and seen_rms < _SEEN_SHARE * expected_rms:
        return (
            f"the angular rates say that roll and pitch turn by {expected_rms:.2f} rad in half a second, but "
            f"gravity turns by {seen_rms:.3f} rad only; {advice}"
        )
    return ""


def gravity_sign(imu: ImuData, seconds: NDArray[np.float64], T_imu_lidar: NDArray[np.float64] | None) -> str:
    """Return a sentence if the specific force points down, at rest or, without a rest, on average."""
    still = still_second(imu, seconds)
    when = "on average" if still is None else f"at rest ({seconds[still.start]:.1f} s)"
    force = imu.accel[still or slice(None)].mean(axis=0)
    up = np.array([0.0, 0.0, 1.0]) if T_imu_lidar is None else T_imu_lidar[:3, 2]
    along = float(force @ up)
    if along > -STANDARD_GRAVITY / 2:
        return ""
    axis = "the IMU's z axis" if T_imu_lidar is None else "the lidar's z axis"
    return (
        f"the specific force points down {when}: {along:.2f} m/s^2 along {axis}, upright it is +9.8; if the "
        "sensor is mounted upside down give its mounting in params.extrinsics.rotation, else the "
        "accelerometer has the opposite sign and the recorded values must be negated."
    )


def still_second(imu: ImuData, seconds: NDArray[np.float64], length_s: float = 1.0) -> slice | None:
    """Return the first ``length_s`` seconds of samples in which rates and forces hardly change, or None."""
    start = 0
    while start < len(seconds) and seconds[start] + length_s <= seconds[-1] + 1e-6:
        end = int(np.searchsorted(seconds, seconds[start] + length_s))
        part = slice(start, max(end, start + 1))
        if (
            end - start >= 5
            and np.sqrt(np.mean(np.var(imu.gyro[part], axis=0))) < _STILL_GYRO
            and np.sqrt(np.mean(np.var(imu.accel[part], axis=0))) < _STILL_ACCEL
            and np.linalg.norm(imu.gyro[part].mean(axis=0)) < 2 * _STILL_GYRO
        ):
            return part
        start = part.stop
    return None


def first_motion(imu: ImuData, seconds: NDArray[np.float64]) -> float | None:
    """Return when (s) a second's mean rate or force first leaves the recording's median, or None."""
    means = _windowed(np.concatenate([imu.gyro, imu.accel], axis=1), seconds, 1.0)
    off = np.abs(means - np.median(means, axis=0))
    moves = (off[:, :3].max(axis=1) > _STILL_GYRO) | (off[:, 3:].max(axis=1) > _STILL_ACCEL)
    return float(seconds[0] + np.argmax(moves)) if moves.any() else None


def _held(column: NDArray[np.float64], limit: float, lowest: float) -> NDArray[np.intp]:
    """Return where the extreme value is held, if values accumulate there as at the end of a range."""
    if abs(limit) < lowest:
        return np.zeros(0, np.intp)
    at = np.flatnonzero(column == limit)
    if not _PILE <= len(at) <= len(column) // 2:
        return np.zeros(0, np.intp)
    others = column[column != limit]
    next_value = others.max() if limit > others.max() else others.min()
    next_to_it = np.count_nonzero(column == next_value)
    breaks = np.flatnonzero(np.diff(at) > 1)
    longest = np.diff(np.concatenate([[-1], breaks, [len(at) - 1]])).max()
    return at if len(at) >= 3 * next_to_it and longest >= _RUN else np.zeros(0, np.intp)


def _windowed(
    values: NDArray[np.float64], seconds: NDArray[np.float64], length_s: float
) -> NDArray[np.float64]:
    """Return the means of consecutive windows that hold samples, (windows, columns)."""
    index = ((seconds - seconds[0]) / length_s).astype(np.int64)
    starts = np.flatnonzero(np.diff(index, prepend=-1))
    counts = np.diff(np.append(starts, len(index)))
    return np.add.reduceat(values, starts, axis=0) / counts[:, None]


def missing(stamp_ns: NDArray[np.int64]) -> str:
    """Return a sentence on samples that are missing one by one from a regular stream, "" without any."""
    if len(stamp_ns) < 3:
        return ""
    intervals = np.diff(stamp_ns) / np.median(np.diff(stamp_ns))
    short = intervals[intervals <= GAP_FACTOR]
    lost = np.rint(short) - 1
    regular = np.abs(short - np.rint(short)) < _STEADY
    share = float(lost.sum() / (lost.sum() + len(stamp_ns)))
    # stamps that jitter say nothing about what lies between them
    if share < _MISSING or regular.mean() < 1 - _STEADY:
        return ""
    return f"{share:.0%} of the IMU samples are missing, up to {int(lost.max())} in a row.".replace("%", " %")


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
        f"{', '.join(named)}{more}; scans in there are predicted with little or no inertial data. If no "
        "sample is missing, the IMU's clock jumped by that much."
    )


def coverage(imu: ImuData, start_ns: int, end_ns: int, time_offset: float = 0.0) -> list[str]:
    """Return a sentence for each end of the recording at which scans have no inertial samples.

    Args:
        imu: samples with ascending stamps.
        start_ns: start of the first scan, ns.
        end_ns: end of the last scan, ns.
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


def _finite(imu: ImuData, messages: list[str]) -> NDArray[np.bool_]:
    values = np.hstack([imu.gyro, imu.accel])
    possible = np.asarray((np.abs(values) < LARGEST).all(axis=1))
    if not possible.all():
        bad = np.flatnonzero(~possible)
        seconds = (imu.stamp_ns[bad[0]] - imu.stamp_ns[0]) * 1e-9
        what = (
            "NaN or infinity" if not np.isfinite(values[bad]).all() else "a value beyond any sensor's range"
        )
        messages.append(
            f"{len(bad)} IMU sample(s) held {what}, the first at {seconds:.3f} s, and were dropped."
        )
    return possible


def _ascending(stamp_ns: NDArray[np.int64], origin_ns: int, messages: list[str]) -> NDArray[np.bool_]:
    steps = np.diff(stamp_ns)
    kept = np.ones(len(stamp_ns), bool)
    if np.all(steps > 0):
        return kept
    # a sample later than all before and earlier than all after is in every longest ascending subsequence
    kept[1:] &= stamp_ns[1:] > np.maximum.accumulate(stamp_ns)[:-1]
    kept[:-1] &= stamp_ns[:-1] < np.minimum.accumulate(stamp_ns[::-1])[::-1][1:]
    disputed = np.flatnonzero(~kept)
    kept[disputed[_longest_ascent(stamp_ns[disputed])]] = True
    repeats = ~kept & np.isin(stamp_ns, stamp_ns[kept])
    back = ~kept & ~repeats
    at = int(np.argmax(steps < 0))
    if steps[at] < 0:
        seconds = (stamp_ns[at] - origin_ns) * 1e-9
        messages.append(
            f"the time of the IMU samples runs backwards {np.count_nonzero(steps < 0)} time(s), first at "
            f"{seconds:.3f} s by {-steps[at] * 1e-9:.3f} s: {np.count_nonzero(back)} sample(s) out of order "
            "were dropped and the rest is used."
        )
    if repeats.any():
        seconds = (stamp_ns[int(np.argmax(repeats))] - origin_ns) * 1e-9
        messages.append(
            f"{np.count_nonzero(repeats)} IMU sample(s) repeat a stamp, the first at {seconds:.3f} s: "
            "the first of each was kept."
        )
    return kept


def _longest_ascent(stamps: NDArray[np.int64]) -> list[int]:
    """Return the indices of the longest strictly ascending subsequence; of several the earliest one.

    Patience sorting (Fredman, "On computing the length of longest increasing subsequences", 1975), started
    at the end: a later sample is replaced by an earlier one that serves as well.
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
