"""``lio-jax calibrate-imu``: noise densities of an inertial sensor from a recording at rest."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray

from lio_jax.commands.runtime import say
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import atomic_path, read_arrays
from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.data.imu_checks import GAP_FACTOR, STANDARD_GRAVITY, cleaned, first_motion
from lio_jax.data.sequence import ImuData
from lio_jax.imu.allan import NoiseFit, allan_deviation, averaging_factors, fit_noise
from lio_jax.settings.settings import settings_from_yaml

MIN_SECONDS = 30.0
"""Shortest usable recording, s: a shorter one does not determine white noise at an averaging time of 1 s."""

_SENSORS = (("gyroscope", "gyro", "rad/s"), ("accelerometer", "accel", "m/s^2"))


@dataclass(frozen=True)
class SensorNoise:
    """The Allan deviation of one sensor's three axes, and the noise that follows from it."""

    tau: NDArray[np.float64]
    """Averaging times, (k,) s."""
    deviation: NDArray[np.float64]
    """Allan deviation of each axis, (k, 3), in the unit of the signal."""
    axes: tuple[NoiseFit, ...]
    combined: NoiseFit
    """Fit to the mean variance of the axes."""


def calibrate_imu(data: Path, out: Path, plot: Path | None, skip: float) -> None:
    """Print the densities, write them as a settings file, and draw the Allan deviation.

    Raises:
        UsageError: a negative ``skip``, or file names of the wrong kind.
        LioJaxError: no samples, too few of them, or the sensor moves.
    """
    if skip < 0:
        raise UsageError(f"--skip must be 0 or more seconds, not {skip:g}.")
    if out.suffix not in (".yaml", ".yml"):
        raise UsageError(f"--out {out}: give a file that ends in .yaml, as --recipe wants it.")
    if plot is not None and plot.suffix != ".png":
        raise UsageError(f"--plot {plot}: give a file that ends in .png.")
    imu, messages = cleaned(imu_of(data), str(data))
    for sentence in messages:
        say(f"warning: {sentence}")
    imu, seconds = _at_rest(imu, data, skip)
    noises = {key: sensor_noise(getattr(imu, key), seconds) for _, key, _ in _SENSORS}
    for name, key, _ in _SENSORS:
        if noises[key].combined.white == 0:
            raise LioJaxError(
                f"{data}: the {name} shows no white noise (it is constant, or its steps are coarser); "
                "give the sensor's unfiltered samples."
            )
    print(_table(noises, seconds))
    for parent in {out.parent, *([plot.parent] if plot else [])}:
        parent.mkdir(parents=True, exist_ok=True)
    text = _fragment(noises, data, seconds)
    settings_from_yaml(text, str(out))
    with atomic_path(out) as aside:
        aside.write_text(text)
    for name, key, _ in _SENSORS:
        if noises[key].combined.walk is None:
            say(
                f"warning: {data}: {seconds[-1] - seconds[0]:.0f} s at rest are too short to see the bias "
                f"random walk of the {name}; only its white noise was written (hours may show the walk)."
            )
    print(f"{out}: written; use it with --recipe {out}")
    if plot is not None:
        from lio_jax.viz.plot import plot_allan

        plot_allan(plot, {f"{name} [{unit}]": noises[key] for name, key, unit in _SENSORS}, str(data))
        print(f"{plot}: drawn")


def imu_of(data: Path) -> ImuData:
    """Return the inertial samples of a recording, or of a single native imu.npz.

    Raises:
        LioJaxError: there are no samples, or the file cannot be read.
    """
    if data.suffix == ".npz" and data.is_file():
        return _from_npz(data)
    sequence = open_sequence(data, DataConfig())
    imu = sequence.imu()
    if imu is None or len(imu.stamp_ns) == 0:
        raise LioJaxError(f"{data}: holds no IMU samples; give a recording of the IMU at rest.")
    return imu


def _from_npz(path: Path) -> ImuData:
    """Read stamp_ns, gyro and accel; or rate_hz in place of stamps, gyro_dps in deg/s, accel_g in g."""
    try:
        arrays = read_arrays(path)
    except (OSError, ValueError):
        raise LioJaxError(f"{path}: cannot be read as an .npz file; give a native imu.npz.") from None
    if strange := [key for key in arrays if arrays[key].dtype.kind not in "fiu"]:
        raise LioJaxError(
            f"{path}: {strange[0]} holds {arrays[strange[0]].dtype}, no numbers; give a native imu.npz."
        )
    if "gyro_dps" in arrays:
        arrays["gyro"] = np.radians(arrays["gyro_dps"].astype(np.float64))
    if "accel_g" in arrays:
        arrays["accel"] = arrays["accel_g"].astype(np.float64) * STANDARD_GRAVITY
    if "rate_hz" in arrays and "accel" in arrays:
        count = len(arrays["accel"])
        arrays.setdefault("stamp_ns", np.round(np.arange(count) * (1e9 / float(arrays["rate_hz"]))))
    if missing := [key for key in ("stamp_ns", "gyro", "accel") if key not in arrays]:
        raise LioJaxError(f"{path}: holds no {', '.join(missing)}; give a native imu.npz.")
    stamps = np.asarray(arrays["stamp_ns"])
    if not (np.isfinite(stamps) & (np.abs(stamps.astype(np.float64)) < 2.0**63)).all():
        raise LioJaxError(f"{path}: stamp_ns holds times beyond 64 bits of ns; give a native imu.npz.")
    stamps = arrays["stamp_ns"].astype(np.int64)
    gyro, accel = (np.asarray(arrays[key], np.float64) for key in ("gyro", "accel"))
    if stamps.ndim != 1 or gyro.shape != (len(stamps), 3) or accel.shape != (len(stamps), 3):
        raise LioJaxError(
            f"{path}: gyro {gyro.shape} and accel {accel.shape} must be ({stamps.size}, 3) like stamp_ns."
        )
    return ImuData(stamps, gyro, accel)


def _at_rest(imu: ImuData, data: Path, skip: float) -> tuple[ImuData, NDArray[np.float64]]:
    """Return the longest part without gaps, checked to be at rest, and its times from the first sample, s."""
    stamps = imu.stamp_ns
    seconds = np.asarray((stamps - stamps[:1]) * 1e-9, np.float64)
    part = slice(int(np.searchsorted(seconds, skip)), len(seconds))
    intervals = np.diff(seconds[part])
    if len(intervals):
        breaks = np.flatnonzero(intervals > GAP_FACTOR * np.median(intervals)) + 1
        edges = np.concatenate([[0], breaks, [len(intervals) + 1]])
        longest = int(np.argmax(np.diff(edges)))
        part = slice(part.start + int(edges[longest]), part.start + int(edges[longest + 1]))
    duration = float(seconds[part][-1] - seconds[part][0]) if part.stop > part.start else 0.0
    if duration < MIN_SECONDS:
        after = f" after the first {skip:g} s" if skip else ""
        raise LioJaxError(
            f"{data}: {duration:.1f} s of IMU samples without a gap{after} are too short, at least "
            f"{MIN_SECONDS:.0f} s at rest are needed (hours for the bias random walk)."
        )
    imu = ImuData(stamps[part], imu.gyro[part], imu.accel[part])
    at = first_motion(imu, seconds[part])
    if at is not None:
        raise LioJaxError(
            f"{data}: the IMU moves at {at:.0f} s from its first sample; give a recording at rest, or leave "
            "out a restless start with --skip SECONDS."
        )
    return imu, seconds[part]


def sensor_noise(samples: NDArray[np.float64], seconds: NDArray[np.float64]) -> SensorNoise:
    """Return Allan deviation and fits of a sensor at rest.

    Args:
        samples: (m, 3) samples of the three axes, in the sensor's unit.
        seconds: (m,) s, times without gaps.
    """
    duration = float(seconds[-1] - seconds[0])
    interval = duration / (len(seconds) - 1)
    factors = averaging_factors(len(samples))
    tau = np.asarray(factors * interval, np.float64)
    deviation = allan_deviation(samples, interval, factors)
    axes = tuple(fit_noise(tau, deviation[:, axis], duration) for axis in range(3))
    combined = fit_noise(tau, np.sqrt(np.mean(deviation**2, axis=1)), duration)
    return SensorNoise(tau, deviation, axes, combined)


def _table(noises: dict[str, SensorNoise], seconds: NDArray[np.float64]) -> str:
    duration = seconds[-1] - seconds[0]
    lines = [
        f"{len(seconds)} samples at {(len(seconds) - 1) / duration:.1f} Hz, {duration:.0f} s at rest",
        "",
    ]
    lines.append(f"{'':26}{'combined':>11}{'x':>11}{'y':>11}{'z':>11}   unit")
    for _, key, unit in _SENSORS:
        noise = noises[key]
        fits = (noise.combined, *noise.axes)
        rows = (
            (f"{key}_noise", [fit.white for fit in fits], f"{unit}/sqrt(Hz)"),
            (f"{key}_bias_walk", [fit.walk for fit in fits], f"{_per_second(unit)}/sqrt(Hz)"),
            (f"{key} bias instability", [fit.flicker for fit in fits], unit),
        )
        for name, values, of in rows:
            cells = "".join(f"{'-' if value is None else f'{value:.3e}':>11}" for value in values)
            lines.append(f"{name:26}{cells}   {of}")
    return "\n".join(lines)


def _per_second(unit: str) -> str:
    return {"rad/s": "rad/s^2", "m/s^2": "m/s^3"}[unit]


def _fragment(noises: dict[str, SensorNoise], data: Path, seconds: NDArray[np.float64]) -> str:
    values: dict[str, float] = {}
    for _, key, _ in _SENSORS:
        combined = noises[key].combined
        values[f"{key}_noise"] = float(f"{combined.white:.4e}")
        if combined.walk is not None:
            values[f"{key}_bias_walk"] = float(f"{combined.walk:.4e}")
    head = (
        f"# Allan deviation of {data.name}, {seconds[-1] - seconds[0]:.0f} s at rest; mean of the axes.\n"
        "# A vehicle's engine and road add vibration: for driving these are lower bounds.\n"
    )
    return head + yaml.safe_dump({"params": {"imu": values}}, sort_keys=False)
