"""Discrete noise from continuous-time densities, and the covariance that it adds over many intervals."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lio_jax.core.prefix_sum import prefix_sum
from lio_jax.imu.params import ImuParams

UNKNOWN_RATE = 0.3
"""White noise in place of an unmeasured angular rate, rad/s/sqrt(Hz): 0.1 rad after 0.1 s."""
UNKNOWN_ACCEL = 3.0
"""White noise in place of an unmeasured acceleration, m/s^2/sqrt(Hz): 1 m/s after 0.1 s."""

DENSE = 0.03
"""Longest time between two samples, s, for which interpolation between them adds no noise."""
UNTOLD_RATE = 0.3
"""Error of the interpolated angular rate between sparser samples, rad/s per second between them."""
UNTOLD_ACCEL = 6.0
"""Error of the interpolated specific force between sparser samples, m/s^2 per second between them."""


class IntervalNoise(eqx.Module):
    """Variances per axis of the noise in each of n intervals."""

    gyro: Float[Array, " n"]
    """Variance of the mean angular rate, (rad/s)^2."""
    accel: Float[Array, " n"]
    """Variance of the mean specific force, (m/s^2)^2."""
    gyro_bias: Float[Array, " n"]
    """Variance of the change of the gyroscope's bias over the interval, (rad/s)^2."""
    accel_bias: Float[Array, " n"]
    """Variance of the change of the accelerometer's bias over the interval, (m/s^2)^2."""


def discretise(
    params: ImuParams, duration: Float[Array, " n"], gap: Float[Array, " n"], known: Bool[Array, " n"]
) -> IntervalNoise:
    """Return the variances of the mean inputs, and of the change of the biases, in intervals of h seconds.

    White noise has the variance density^2 / h, the change of a random walk density^2 h. The variances are
    linear in the squares of the densities. An interval of zero duration has no noise.

    Args:
        params: the sensor's noise densities.
        duration: h of each interval, s.
        gap: time between the two samples around each interval, s. Above ``DENSE`` the error of the
            interpolation is added.
        known: False where no sample is near. The motion is then white noise of the densities
            ``UNKNOWN_RATE`` and ``UNKNOWN_ACCEL``.
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
    """Return the covariance of r results and of the biases' drift, which is linear in the noise's variances.

    The biases change at the end of each interval, so a change acts on the later intervals only.

    Args:
        inputs: derivative of the results with respect to each interval's angular rate (rad/s) and specific
            force (m/s^2), such as ``Sensitivity.inputs``.
        noise: variances of each interval.
        measured: False where there are no samples. The biases then have no effect on the results.

    Returns:
        The covariance of the results, the gyroscope's bias and the accelerometer's bias, in this order.
    """
    columns, weights = _columns(inputs, measured), _weights(noise)
    return _flat(columns * weights) @ _flat(columns).T


def process_noise_slopes(
    inputs: Float[Array, "n r 6"],
    inputs_slopes: Float[Array, "d n r 6"],
    noise: IntervalNoise,
    noise_slopes: IntervalNoise,
    measured: Bool[Array, ""] | bool = True,
) -> tuple[Float[Array, "d r+6 r+6"], Float[Array, "p r+6 r+6"]]:
    """Return the derivatives of :func:`process_noise` along directions of the inputs, and of the variances.

    Args:
        inputs: as in :func:`process_noise`.
        inputs_slopes: derivative of the inputs along each of d directions.
        noise: as in :func:`process_noise`.
        noise_slopes: derivative of the variances along each of p directions, as leaves of (p, n).
        measured: as in :func:`process_noise`.
    """
    columns, weights = _columns(inputs, measured), _weights(noise)

    def along(inputs_slope: Array) -> Array:
        moved = jax.jvp(lambda inputs: _columns(inputs, measured), (inputs,), (inputs_slope,))[1]
        half = _flat(moved) @ _flat(columns * weights).T
        return half + half.T

    by_noise = jax.vmap(lambda slope: _flat(columns * _weights(slope)) @ _flat(columns).T)
    return jax.vmap(along)(inputs_slopes), by_noise(noise_slopes)


def _columns(inputs: Float[Array, "n r 6"], measured: Bool[Array, ""] | bool) -> Float[Array, "r+6 n 12"]:
    """Return the derivative of results and biases with respect to each interval's twelve errors."""
    later = jnp.where(measured, prefix_sum(inputs) - jnp.sum(inputs, axis=0), 0.0)
    results = jnp.swapaxes(jnp.concatenate([inputs, later], axis=2), 0, 1)
    unit = jnp.eye(6, 12, k=6, dtype=inputs.dtype)
    return jnp.concatenate([results, jnp.broadcast_to(unit[:, None], (6, len(inputs), 12))])


def _weights(noise: IntervalNoise) -> Float[Array, "n 12"]:
    variances = jnp.stack([noise.gyro, noise.accel, noise.gyro_bias, noise.accel_bias], axis=1)
    return jnp.repeat(variances, 3, axis=1)


def _flat(columns: Float[Array, "r n 12"]) -> Float[Array, "r n*12"]:
    return columns.reshape(len(columns), -1)
