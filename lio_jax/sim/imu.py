"""An inertial measurement unit at the body's origin: exact motion, then sensor errors that are all known."""

import math
from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray
from numpy.typing import ArrayLike, NDArray

from lio_jax.core.errors import UsageError
from lio_jax.data.sequence import ImuData
from lio_jax.sim.trajectory import Kinematics, Motion, kinematics_at

GRAVITY = np.array([0.0, 0.0, -9.80665])
"""Gravity in the world frame, m/s^2."""

_CHUNK = 4096
"""Number of samples computed at once, to bound memory; the draws do not depend on the recording's length."""

_SPREADS = (
    "gyro_noise",
    "accel_noise",
    "gyro_bias_walk",
    "accel_bias_walk",
    "gyro_bias_sigma",
    "accel_bias_sigma",
)


@dataclass(frozen=True)
class ImuModel:
    """Rate, noise densities and faults of a unit; the default is a good MEMS unit."""

    rate: float = 200.0
    """Samples per second."""
    gyro_noise: float = 0.003 / math.sqrt(200)
    """White noise density of the gyroscope, rad/s/sqrt(Hz)."""
    accel_noise: float = 0.03 / math.sqrt(200)
    """White noise density of the accelerometer, m/s^2/sqrt(Hz)."""
    gyro_bias_walk: float = 2e-5
    """Random-walk density of the gyroscope's bias, rad/s^2/sqrt(Hz)."""
    accel_bias_walk: float = 2e-4
    """Random-walk density of the accelerometer's bias, m/s^3/sqrt(Hz)."""
    gyro_bias: ArrayLike = 0.0
    """Mean of the gyroscope's initial bias, rad/s: one number or three."""
    accel_bias: ArrayLike = 0.0
    """Mean of the accelerometer's initial bias, m/s^2: one number or three."""
    gyro_bias_sigma: float = 0.002
    """Standard deviation of the gyroscope's initial bias, rad/s."""
    accel_bias_sigma: float = 0.02
    """Standard deviation of the accelerometer's initial bias, m/s^2."""
    gyro_gain: ArrayLike = 1.0
    """Factor of the true angular rate: a number, or 3x3 with scale on and misalignment off the diagonal."""
    accel_gain: ArrayLike = 1.0
    """Factor of the true specific force: a number, or 3x3 with scale on and misalignment off the diagonal."""
    time_offset: float = 0.0
    """A sample's stamp minus its true time, s."""
    gyro_range: float = math.radians(2000)
    """Angular rate at which a reading saturates, rad/s."""
    accel_range: float = 16 * 9.80665
    """Specific force at which a reading saturates, m/s^2."""


@dataclass(frozen=True)
class ImuTruth:
    """The true quantities behind the samples."""

    stamp_ns: NDArray[np.int64]
    """True time of each sample, (m,) ns; ImuData holds the stamps of the unit's own clock."""
    gyro_bias: NDArray[np.float64]
    """True bias of the gyroscope at each sample, (m, 3) rad/s."""
    accel_bias: NDArray[np.float64]
    """True bias of the accelerometer at each sample, (m, 3) m/s^2."""
    model: ImuModel

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all quantities by name, as a recording stores them."""
        return {
            "imu_stamp_ns": self.stamp_ns,
            "gyro_bias": self.gyro_bias,
            "accel_bias": self.accel_bias,
            "gyro_noise": np.array(self.model.gyro_noise),
            "accel_noise": np.array(self.model.accel_noise),
            "gyro_bias_walk": np.array(self.model.gyro_bias_walk),
            "accel_bias_walk": np.array(self.model.accel_bias_walk),
            "gyro_gain": _matrix(self.model.gyro_gain),
            "accel_gain": _matrix(self.model.accel_gain),
            "time_offset": np.array(self.model.time_offset),
        }


def specific_force(kinematics: Kinematics) -> Float[Array, "3"]:
    """Return what an ideal accelerometer at the IMU's origin measures, IMU frame, m/s^2: R' (a - g)."""
    felt = kinematics.acceleration - jnp.asarray(GRAVITY, kinematics.acceleration.dtype)
    return kinematics.T_world_imu.rotation().inverse() @ felt


def simulate_imu(
    motion: Motion, model: ImuModel, duration_s: float, seed: int, start_ns: int = 0
) -> tuple[ImuData, ImuTruth]:
    """Sample a motion as the unit would do, from time 0 to ``duration_s``, both ends included.

    White noise of density N has the standard deviation N sqrt(rate) in a sample; a bias of walk density K
    takes steps of K / sqrt(rate) from sample to sample.

    Args:
        motion: motion of the IMU frame.
        model: the unit.
        duration_s: length of the recording, s.
        seed: seed of biases and noise; a longer recording begins with the same numbers.
        start_ns: absolute time of the motion's time 0, ns.

    Raises:
        UsageError: a duration, rate, density or range that is impossible.
    """
    _check(model, duration_s)
    count = math.floor(duration_s * model.rate + 1e-6) + 1
    # times are rounded to nanoseconds first, so that a sample is exact at its stamp
    offset_ns = np.round(np.arange(count) * (1e9 / model.rate)).astype(np.int64)
    readings = np.empty((4, count, 3))
    start_key, noise_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), 2))
    with jax.enable_x64(True):
        unit = _Unit(
            white=jnp.array([model.gyro_noise, model.accel_noise]) * math.sqrt(model.rate),
            step=jnp.array([model.gyro_bias_walk, model.accel_bias_walk]) / math.sqrt(model.rate),
            gain=jnp.stack([jnp.asarray(_matrix(gain)) for gain in (model.gyro_gain, model.accel_gain)]),
            limit=jnp.array([model.gyro_range, model.accel_range]),
        )
        mean = np.stack([np.broadcast_to(bias, 3) for bias in (model.gyro_bias, model.accel_bias)])
        sigma = np.array([[model.gyro_bias_sigma], [model.accel_bias_sigma]])
        bias = jnp.asarray(mean + sigma * np.asarray(jax.random.normal(start_key, (2, 3), jnp.float64)))
        for number, first in enumerate(range(0, count, _CHUNK)):
            part = offset_ns[first : first + _CHUNK]
            times = jnp.asarray(np.pad(part, (0, _CHUNK - len(part)), mode="edge") * 1e-9)
            key = jax.random.fold_in(noise_key, number)
            measured, biases, bias = _samples(motion, unit, times, bias, key)
            readings[:2, first : first + len(part)] = measured[:, : len(part)]
            readings[2:, first : first + len(part)] = biases[:, : len(part)]
    true_ns = start_ns + offset_ns
    data = ImuData(true_ns + round(model.time_offset * 1e9), readings[0], readings[1])
    return data, ImuTruth(true_ns, readings[2], readings[3], model)


class _Unit(eqx.Module):
    """The model's numbers for one sample; the gyroscope comes first, the accelerometer second."""

    white: Float[Array, "2"]
    step: Float[Array, "2"]
    gain: Float[Array, "2 3 3"]
    limit: Float[Array, "2"]


@eqx.filter_jit
def _samples(
    motion: Motion,
    unit: _Unit,
    times: Float[Array, " n"],
    bias: Float[Array, "2 3"],
    key: PRNGKeyArray,
) -> tuple[Float[Array, "2 n 3"], Float[Array, "2 n 3"], Float[Array, "2 3"]]:
    """Return readings and biases of a chunk, and the bias with which the next chunk starts."""

    def ideal(time: Float[Array, ""]) -> Float[Array, "2 3"]:
        kinematics = kinematics_at(motion, time)
        return jnp.stack([kinematics.angular_velocity, specific_force(kinematics)])

    white, steps = jax.random.normal(key, (2, 2, times.shape[0], 3), jnp.float64)
    walked = bias[:, None] + jnp.cumsum(unit.step[:, None, None] * steps, axis=1)
    biases = jnp.concatenate([bias[:, None], walked[:, :-1]], axis=1)
    true = jnp.einsum("kij,nkj->kni", unit.gain, jax.vmap(ideal)(times))
    limit = unit.limit[:, None, None]
    measured = jnp.clip(true + biases + unit.white[:, None, None] * white, -limit, limit)
    return measured, biases, walked[:, -1]


def _matrix(gain: ArrayLike) -> NDArray[np.float64]:
    value = np.asarray(gain, np.float64)
    return value * np.eye(3) if value.ndim == 0 else value


def _check(model: ImuModel, duration_s: float) -> None:
    if not (0 < duration_s < math.inf):
        raise UsageError(f"imu: a duration of {duration_s} s holds no samples; give more than 0 s.")
    for name in ("rate", "gyro_range", "accel_range"):
        if not (value := getattr(model, name)) > 0:
            raise UsageError(f"imu.{name}: {value} is impossible; give a number greater than zero.")
    for name in _SPREADS:
        if not (value := getattr(model, name)) >= 0:
            raise UsageError(f"imu.{name}: {value} is impossible; give zero or more.")
    for name in ("gyro_gain", "accel_gain"):
        if (value := np.asarray(getattr(model, name))).shape not in ((), (3, 3)):
            raise UsageError(f"imu.{name}: shape {value.shape}; give one number or 3x3.")
