"""The covariance of a preintegration as a linear function of the noise's variances."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.core.error_state import BIASES
from lio_jax.core.params import ImuParams
from lio_jax.imu.preintegration import preintegrate_parallel
from lio_jax.imu.sampling import Intervals


class NoiseShares(eqx.Module):
    """What each kind of noise adds to a preintegrated covariance: computed once, whatever the densities."""

    fixed: Float[Array, "*b 15 15"]
    """What does not depend on the sensor: motion that no sample tells."""
    per_variance: Float[Array, "*b 4 15 15"]
    """Per squared density of gyroscope, accelerometer, gyroscope's and accelerometer's bias walk."""

    def covariance(self, params: ImuParams) -> Float[Array, "*b 15 15"]:
        """Return the covariance with the sensor's densities."""
        return self.fixed + jnp.einsum("k,...kij->...ij", _densities(params) ** 2, self.per_variance)

    def with_walk_apart(self) -> "NoiseShares":
        """Return the shares as if the biases walked at the span's end only.

        A bias random walk that is a factor of its own, as in LIO-SAM's graph, has no part in the motion.
        """
        walks = jnp.zeros_like(self.per_variance[..., 2:, :, :])
        walks = walks.at[..., BIASES, BIASES].set(self.per_variance[..., 2:, BIASES, BIASES])
        return NoiseShares(self.fixed, self.per_variance.at[..., 2:, :, :].set(walks))


def noise_shares(
    intervals: Intervals, gyro_bias: Float[Array, "3"], accel_bias: Float[Array, "3"], turning: bool = True
) -> NoiseShares:
    """Return the shares of :func:`preintegrate`'s covariance; batches under vmap.

    Args:
        intervals: those of zero duration change nothing.
        gyro_bias: rad/s.
        accel_bias: m/s^2.
        turning: as in :func:`preintegrate`.
    """

    def covariance(densities: Float[Array, "4"]) -> Float[Array, "15 15"]:
        gyro, accel, gyro_walk, accel_walk = densities
        params = ImuParams(gyro, accel, gyro_walk, accel_walk, gravity=jnp.zeros_like(gyro))
        return preintegrate_parallel(intervals, gyro_bias, accel_bias, params, turning).covariance

    # the motion is the same for all five: under vmap only the last product is repeated
    covariances = jax.vmap(covariance)(jnp.eye(5, 4, -1, dtype=gyro_bias.dtype))
    return NoiseShares(covariances[0], covariances[1:] - covariances[0])


def _densities(params: ImuParams) -> Float[Array, "4"]:
    return jnp.stack([params.gyro_noise, params.accel_noise, params.gyro_bias_walk, params.accel_bias_walk])
