"""The covariance of a preintegration as a linear function of the noise's variances."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.core.error_state import BIASES
from lio_jax.imu.params import ImuParams
from lio_jax.imu.preintegration import preintegrate_parallel
from lio_jax.imu.sampling import Intervals


class NoiseShares(eqx.Module):
    """What each kind of noise adds to a preintegrated covariance, for any noise densities."""

    fixed: Float[Array, "*b 15 15"]
    """The part of motion that no sample measures; it does not depend on the sensor's noise."""
    per_variance: Float[Array, "*b 4 15 15"]
    """The parts per squared density of the gyroscope's noise, the accelerometer's noise, the gyroscope's bias
    walk and the accelerometer's bias walk."""

    def covariance(self, params: ImuParams) -> Float[Array, "*b 15 15"]:
        """Return the preintegrated covariance for the sensor's noise densities."""
        return self.fixed + jnp.einsum("k,...kij->...ij", _densities(params) ** 2, self.per_variance)

    def with_walk_apart(self) -> "NoiseShares":
        """Return the shares as if the biases changed at the span's end only.

        Use them where the bias random walk is a factor of its own, as in LIO-SAM's graph: it then has no
        effect on the motion.
        """
        walks = jnp.zeros_like(self.per_variance[..., 2:, :, :])
        walks = walks.at[..., BIASES, BIASES].set(self.per_variance[..., 2:, BIASES, BIASES])
        return NoiseShares(self.fixed, self.per_variance.at[..., 2:, :, :].set(walks))


def noise_shares(
    intervals: Intervals, gyro_bias: Float[Array, "3"], accel_bias: Float[Array, "3"], turning: bool = True
) -> NoiseShares:
    """Return the shares of :func:`~lio_jax.imu.preintegration.preintegrate`'s covariance.

    Args:
        intervals: measured motion; intervals of zero duration change nothing.
        gyro_bias: rad/s, IMU frame.
        accel_bias: m/s^2, IMU frame.
        turning: as in :func:`~lio_jax.imu.preintegration.preintegrate`.
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
