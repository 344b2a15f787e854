"""What inertial samples look like when a unit, a sign or a range is wrong: suspicions, told not repaired."""

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.imu_units import STANDARD_GRAVITY
from lio_jax.data.sequence import ImuData

_WINDOW_S = 0.5
_FASTEST = 8.0
"""No vehicle and no hand turns on average faster than this for half a second, rad/s."""
_CLEAR_TURN = 0.2
_SEEN_SHARE = 0.15
_STILL_GYRO = 0.05
_STILL_ACCEL = 0.3
_PILE = 5
_RUN = 3
_LOWEST_GYRO_LIMIT = 0.5
_LOWEST_ACCEL_LIMIT = 12.0


def saturation(imu: ImuData, seconds: NDArray[np.float64]) -> list[str]:
    """Return a sentence for each axis whose extreme value is held again and again."""
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
    """Return a sentence if the angular rates are too high for rad/s, by themselves or beside gravity."""
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
    # gravity stays put: a body that rolls or pitches sees it turn by as much
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
    """Return a sentence if the specific force points down, at rest or, where there is none, on average."""
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
    """Return the first ``length_s`` of samples whose rates and forces hardly change, or None."""
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
    """Return when, s, the mean rate or force of a second first leaves the recording's median, or None."""
    means = _windowed(np.concatenate([imu.gyro, imu.accel], axis=1), seconds, 1.0)
    off = np.abs(means - np.median(means, axis=0))
    moves = (off[:, :3].max(axis=1) > _STILL_GYRO) | (off[:, 3:].max(axis=1) > _STILL_ACCEL)
    return float(seconds[0] + np.argmax(moves)) if moves.any() else None


def _held(column: NDArray[np.float64], limit: float, lowest: float) -> NDArray[np.intp]:
    """Return where the extreme value is held, if values pile up there as they do at the end of a range."""
    if abs(limit) < lowest:
        return np.zeros(0, np.intp)
    at = np.flatnonzero(column == limit)
    if not _PILE <= len(at) <= len(column) // 2:
        return np.zeros(0, np.intp)
    others = column[column != limit]
    next_value = others.max() if limit > others.max() else others.min()
    beside = np.count_nonzero(column == next_value)
    breaks = np.flatnonzero(np.diff(at) > 1)
    longest = np.diff(np.concatenate([[-1], breaks, [len(at) - 1]])).max()
    return at if len(at) >= 3 * beside and longest >= _RUN else np.zeros(0, np.intp)


def _windowed(
    values: NDArray[np.float64], seconds: NDArray[np.float64], length_s: float
) -> NDArray[np.float64]:
    """Return the means of consecutive windows that hold samples, (windows, columns)."""
    index = ((seconds - seconds[0]) / length_s).astype(np.int64)
    starts = np.flatnonzero(np.diff(index, prepend=-1))
    counts = np.diff(np.append(starts, len(index)))
    return np.add.reduceat(values, starts, axis=0) / counts[:, None]
