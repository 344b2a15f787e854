"""Discrete noise of continuous-time densities, and the covariance that it adds over many samples."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lio_jax.core.prefix_sum import prefix_sum
from lio_jax.imu.params import ImuParams

UNKNOWN_RATE = 0.3
"""Angular rate where no sample tells it, as white noise, rad/s/sqrt(Hz): 0.1 rad after 0.1 s."""
UNKNOWN_ACCEL = 3.0
"""Acceleration where no sample tells it, as white noise, m/s^2/sqrt(Hz): 1 m/s after 0.1 s."""

DENSE = 0.03
"""Samples no farther apart than this, s, leave nothing untold between them."""
UNTOLD_RATE = 0.3
"""How far the angular rate strays between sparser samples, rad/s per s between them."""
UNTOLD_ACCEL = 6.0
"""How far the acceleration strays between sparser samples, m/s^2 per s between them."""


class IntervalNoise(eqx.Module):
    """Variances per axis of what disturbs each interval."""

    gyro: Float[Array, " n"]
    """Of the mean angular rate, (rad/s)^2."""
    accel: Float[Array, " n"]
    """Of the mean specific force, (m/s^2)^2."""
    gyro_bias: Float[Array, " n"]
    """Of the gyroscope's bias at the end against that at the start, (rad/s)^2."""
    accel_bias: Float[Array, " n"]
    """Of the accelerometer's bias at the end against that at the start, (m/s^2)^2."""


def discretise(
    params: ImuParams, duration: Float[Array, " n"], gap: Float[Array, " n"], known: Bool[Array, " n"]
) -> IntervalNoise:
    """Return the variances of what is constant in an interval of h seconds.

    White noise: density^2 / h; a random walk from start to end: density^2 h. Linear
    in the squares of the densities. An interval of no duration has no noise.

    Args:
        params: the sensor's densities.
        duration: h, s.
        gap: between the samples around the interval, s: far apart, they leave motion untold.
        known: False where no sample tells the motion: it is then white noise of the densities above.
    """
    real = duration > 0
    per_second = jnp.where(real, 1 / jnp.where(real, duration, 1.0), 0.0)
    # an error of sigma = untold * gap that lasts for a gap, as a density: sigma^2 gap
    sparse = jnp.where(gap > DENSE, gap**3, 0.0)

    def white(density: Float[Array, ""], untold: float, unknown: float) -> Float[Array, " n"]:
        return per_second * (density**2 + jnp.where(known, untold**2 * sparse, unknown**2))

    return IntervalNoise(
        gyro=white(params.gyro_noise, UNTOLD_RATE, UNKNOWN_RATE),
        accel=white(params.accel_noise, UNTOLD_ACCEL, UNKNOWN_ACCEL),
        gyro_bias=params.gyro_bias_walk**2 * duration,
        accel_bias=params.accel_bias_walk**2 * duration,
    )


def process_noise(
    inputs: Float[Array, "n r 6"], noise: IntervalNoise, measured: Bool[Array, ""] | bool = True
) -> Float[Array, "r+6 r+6"]:
    """Return the covariance of r results and the biases' drift; linear in the noise's variances.

    A bias steps at the end of each interval, so it acts from the next one on.

    Args:
        inputs: how each interval's inputs act on the results, such as ``Sensitivity.inputs``.
        noise: of each interval.
        measured: False if the biases have no effect, because there are no samples they would be taken from.

    Returns:
        Order: the results, gyro bias, accelerometer bias.
    """
    later = jnp.where(measured, prefix_sum(inputs) - jnp.sum(inputs, axis=0), 0.0)
    unit = jnp.broadcast_to(jnp.eye(6, dtype=inputs.dtype), (len(inputs), 6, 6))
    none = jnp.zeros_like(unit)
    columns = jnp.concatenate(
        [jnp.concatenate([inputs, none], axis=1), jnp.concatenate([later, unit], axis=1)], axis=2
    )
    variances = jnp.stack([noise.gyro, noise.accel, noise.gyro_bias, noise.accel_bias], axis=1)
    weighted = columns * jnp.repeat(variances, 3, axis=1)[:, None]
    flat = (-1, inputs.shape[1] + 6)
    return jnp.swapaxes(weighted, 1, 2).reshape(flat).T @ jnp.swapaxes(columns, 1, 2).reshape(flat)
