"""Covariance of the increments over a chain of noisy intervals, with walking biases."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lio_jax.core.prefix_sum import prefix_sum
from lio_jax.imu.discretise import IntervalNoise


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
