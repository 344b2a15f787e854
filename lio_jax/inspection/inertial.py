"""Properties of the inertial samples: rate, units, the direction of up, and noise at rest."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.config import DataConfig
from lio_jax.data.imu_checks import LARGEST, accel_scale, cleaned, coverage, still_second
from lio_jax.data.sequence import ImuData

_G_RANGE = (0.8, 1.25)
_SI_RANGE = (8.5, 11.5)
_GAP_FACTOR = 3.0
_SLOW_HZ = 50.0
_TILTED_DEG = 40.0


@dataclass(frozen=True)
class InertialSummary:
    """Properties of all inertial samples that were read."""

    parts: list[ImuData]
    """Consecutive samples in each part, SI units, in time order, without samples that cannot be used."""
    samples: int
    rate: float | None
    """Rate by the median interval, Hz."""
    jitter: float | None
    """Typical deviation of an interval from the median interval, s: 1.48 median absolute deviations."""
    gaps: int
    """Number of intervals that are longer than three median intervals."""
    longest_gap: float | None
    """Length of the longest gap, s."""
    accel_magnitude: float | None
    """Median of |accel| in the units of the recording."""
    in_g: bool
    up: NDArray[np.float64] | None
    """Unit vector of the mean specific force, (3,), IMU frame; at rest if a rest was found."""
    tilt_deg: float | None
    """Angle between ``up`` and the lidar's z axis, deg."""
    still: bool
    """Whether a second at rest was found."""
    gyro_noise: float | None
    """White noise density of the gyroscope at rest, rad/s/sqrt(Hz)."""
    accel_noise: float | None
    """White noise density of the accelerometer at rest, m/s^2/sqrt(Hz)."""
    gyro_bias: NDArray[np.float64] | None
    """Mean angular rate at rest, (3,) rad/s, IMU frame."""
    problems: list[str]


def summarised(parts: list[ImuData], T_imu_lidar: NDArray[np.float64] | None) -> InertialSummary | None:
    """Summarise inertial samples; return None where there are none.

    Args:
        parts: consecutive samples in each part, as recorded.
        T_imu_lidar: (4, 4); None where unknown: the axes are then taken as parallel.
    """
    parts = [part for part in parts if len(part.stamp_ns)]
    if not parts:
        return None
    magnitude = _magnitude(parts)
    in_g = magnitude is not None and _G_RANGE[0] <= magnitude <= _G_RANGE[1]
    clean, problems = [], []
    for part in parts:
        scale, _ = accel_scale(part.accel, DataConfig())
        usable, messages = cleaned(replace(part, accel=part.accel * scale), "IMU", T_imu_lidar)
        clean.append(usable)
        problems += [sentence for sentence in messages if sentence not in problems]
    clean = [part for part in clean if len(part.stamp_ns)]
    rate, jitter, gaps, longest = _rhythm(clean)
    up, rest = _up(clean)
    tilt = _tilt(up, T_imu_lidar)
    problems += _problems(rate, magnitude, in_g, tilt)
    return InertialSummary(
        parts=clean,
        samples=sum(len(part.stamp_ns) for part in parts),
        rate=rate,
        jitter=jitter,
        gaps=gaps,
        longest_gap=longest,
        accel_magnitude=magnitude,
        in_g=in_g,
        up=up,
        tilt_deg=tilt,
        still=rest is not None,
        gyro_noise=None if rest is None else _density(rest.gyro, rate),
        accel_noise=None if rest is None else _density(rest.accel, rate),
        gyro_bias=None if rest is None else rest.gyro.mean(axis=0),
        problems=problems,
    )


def overlap(summary: InertialSummary, whole: bool, starts_ns: list[int], ends_ns: list[int]) -> list[str]:
    """Return sentences on scans without inertial samples, if all samples were read."""
    if not whole or not starts_ns or not summary.parts:
        return []
    return coverage(summary.parts[0], min(starts_ns), max(ends_ns))


def _problems(rate: float | None, magnitude: float | None, in_g: bool, tilt: float | None) -> list[str]:
    messages = []
    if rate is not None and rate < _SLOW_HZ:
        messages.append(f"the IMU runs at {rate:.0f} Hz only: too slow to follow the motion within a sweep.")
    if in_g:
        messages.append(f"|accel| has the median {magnitude:.3f}: the accelerometer is in g.")
    elif magnitude is not None and not _SI_RANGE[0] <= magnitude <= _SI_RANGE[1]:
        messages.append(f"|accel| has the median {magnitude:.2f} m/s^2, at rest it is 9.8: check its unit.")
    # a force that points down is reported, with its remedy, by the checks of the samples
    if tilt is not None and _TILTED_DEG < tilt < 120.0:
        messages.append(
            f"gravity stands {tilt:.0f} deg from the lidar's z axis: the axes of IMU and lidar differ from "
            "what T_imu_lidar says, or the sensor is mounted tilted."
        )
    return messages


def _rhythm(parts: list[ImuData]) -> tuple[float | None, float | None, int, float | None]:
    """Return rate (Hz), jitter (s), number of gaps and longest gap (s)."""
    intervals = np.concatenate([np.diff(part.stamp_ns) for part in parts] or [np.zeros(0)]) * 1e-9
    if not len(intervals):
        return None, None, 0, None
    median = float(np.median(intervals))
    gaps = intervals[intervals > _GAP_FACTOR * median]
    jitter = float(1.4826 * np.median(np.abs(intervals - median)))
    return (1.0 / median if median > 0 else None), jitter, len(gaps), float(gaps.max()) if len(gaps) else None


def _magnitude(parts: list[ImuData]) -> float | None:
    accel = np.concatenate([part.accel for part in parts])
    # squares of what no sensor measures may be beyond all numbers
    strength = np.linalg.norm(accel[(np.abs(accel) < LARGEST).all(axis=1)], axis=1)
    strength = strength[strength < LARGEST]
    return float(np.median(strength)) if len(strength) else None


def _up(parts: list[ImuData]) -> tuple[NDArray[np.float64] | None, ImuData | None]:
    """Return the direction of the mean specific force, and the samples at rest; None where there are none."""
    for part in parts:
        rest = still_second(part, (part.stamp_ns - part.stamp_ns[0]) * 1e-9)
        if rest is not None:
            samples = ImuData(part.stamp_ns[rest], part.gyro[rest], part.accel[rest])
            return _unit(samples.accel.mean(axis=0)), samples
    return (_unit(np.concatenate([part.accel for part in parts]).mean(axis=0)) if parts else None), None


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64] | None:
    length = float(np.linalg.norm(vector))
    return vector / length if length > 0 else None


def _tilt(up: NDArray[np.float64] | None, T_imu_lidar: NDArray[np.float64] | None) -> float | None:
    if up is None:
        return None
    axis = np.array([0.0, 0.0, 1.0]) if T_imu_lidar is None else T_imu_lidar[:3, 2]
    return float(np.degrees(np.arccos(np.clip(up @ axis, -1.0, 1.0))))


def _density(values: NDArray[np.float64], rate: float | None) -> float | None:
    """Return the density of white noise that has the standard deviation of the values about their mean."""
    if not rate:
        return None
    return float(np.sqrt(np.mean(np.var(values, axis=0)) / rate))
