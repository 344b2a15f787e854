"""A GPS receiver at the body's origin: white noise, slow unreported multipath errors, outages."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.data.sequence import GpsData
from lio_jax.sim.trajectory import Motion, pose_at


@dataclass(frozen=True)
class GpsModel:
    """Rate, noise and faults of a receiver."""

    rate: float = 5.0
    """Fixes per second."""
    noise: tuple[float, float, float] = (0.3, 0.3, 0.6)
    """Standard deviation of a fix to the east, to the north and up, m; the reported covariance states it."""
    multipath: float = 0.5
    """Standard deviation of the slow error to the east and to the north, m; up it is twice as large.

    The reported covariance does not include it.
    """
    multipath_time: float = 30.0
    """Correlation time of the slow error, s."""
    outage_every: float = math.inf
    """Mean time between outages, s."""
    outage_length: float = 20.0
    """Mean length of an outage, s."""
    origin: tuple[float, float, float] = (48.1, 11.6, 520.0)
    """Latitude (deg), longitude (deg) and altitude (m) of the world's origin."""


def simulate_gps(motion: Motion, model: GpsModel, duration_s: float, seed: int, start_ns: int = 0) -> GpsData:
    """Return the fixes of a motion from time 0 to ``duration_s``; world x is east, y north, z up.

    The slow error is a first-order Gauss-Markov process in its steady state; outages begin as a Poisson
    process and last exponentially distributed times.

    Args:
        motion: motion of the IMU frame; the antenna is at its origin.
        model: the receiver.
        duration_s: length of the recording, s.
        seed: seed of all errors; a longer recording begins with the same numbers.
        start_ns: absolute time of the motion's time 0, ns.

    Raises:
        UsageError: a duration, rate or standard deviation that is impossible.
    """
    _check(model, duration_s)
    count = math.floor(duration_s * model.rate + 1e-6) + 1
    offset_ns = np.round(np.arange(count) * (1e9 / model.rate)).astype(np.int64)
    times = np.asarray(offset_ns * 1e-9, np.float64)
    noise_key, outage_key = jax.random.split(jax.random.fold_in(jax.random.key(seed), 3))
    with jax.enable_x64(True):
        true = np.asarray(_positions(motion, jnp.asarray(times)))
        # each fix has its own key, so that the draws do not depend on the number of fixes
        keys = jax.vmap(lambda number: jax.random.fold_in(noise_key, number))(jnp.arange(count))
        draws = np.asarray(jax.vmap(lambda key: jax.random.normal(key, (2, 3), jnp.float64))(keys))
    kept = ~_in_outage(times, model, outage_key)
    noise = np.array(model.noise)
    slow = (
        model.multipath
        * np.array([1.0, 1.0, 2.0])
        * _gauss_markov(draws[:, 1], 1.0 / (model.rate * model.multipath_time))
    )
    position = true + noise * draws[:, 0] + slow
    return GpsData(
        stamp_ns=start_ns + offset_ns[kept],
        position=position[kept],
        covariance=np.tile(np.diag(noise**2), (int(kept.sum()), 1, 1)),
        origin=model.origin,
    )


@jax.jit
def _positions(motion: Motion, times: Float[Array, " n"]) -> Float[Array, "n 3"]:
    return jax.vmap(lambda time: pose_at(motion, time).translation())(times)


def _gauss_markov(white: NDArray[np.float64], decay: float) -> NDArray[np.float64]:
    """Return a process of unit variance whose correlation falls by exp(-decay) from row to row."""
    kept = math.exp(-decay)
    fresh = math.sqrt(1 - kept**2)
    values = np.empty_like(white)
    value = white[0]
    values[0] = value
    for row in range(1, len(white)):
        value = kept * value + fresh * white[row]
        values[row] = value
    return values


def _in_outage(times: NDArray[np.float64], model: GpsModel, key: jax.Array) -> NDArray[np.bool_]:
    lost = np.zeros(len(times), bool)
    if math.isinf(model.outage_every):
        return lost
    end, number = 0.0, 0
    while True:
        wait, length = np.asarray(
            jax.random.exponential(jax.random.fold_in(key, number), (2,), jnp.float32), float
        )
        start = end + wait * model.outage_every
        if start > times[-1]:
            return lost
        end = start + length * model.outage_length
        lost |= (times >= start) & (times < end)
        number += 1


def _check(model: GpsModel, duration_s: float) -> None:
    if not (0 < duration_s < math.inf):
        raise UsageError(f"gps: a duration of {duration_s} s holds no fixes; give more than 0 s.")
    for name in ("rate", "multipath_time", "outage_every", "outage_length"):
        if not (value := getattr(model, name)) > 0:
            raise UsageError(f"gps.{name}: {value} is impossible; give a number greater than zero.")
    if not (model.multipath >= 0 and min(model.noise) > 0):
        raise UsageError(
            f"gps: noise {model.noise} m and multipath {model.multipath} m; the first must be greater than "
            "zero, the second not negative."
        )
