"""Cut a padded batch of inertial samples into intervals that cover a span of time exactly."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lio_jax.core.types import ImuBatch

LONGEST_GAP = 0.15
"""Longest time between two samples, s, for which the motion between them counts as known. The first and the
last sample are held for at most this long."""


class Intervals(eqx.Module):
    """Consecutive intervals, in each of which the measured rate and specific force are constant."""

    duration: Float[Array, " n"]
    """Length of each interval, s; 0 on padding."""
    gyro: Float[Array, "n 3"]
    """Mean measured angular rate, rad/s, IMU frame."""
    accel: Float[Array, "n 3"]
    """Mean measured specific force, m/s^2, IMU frame."""
    gap: Float[Array, " n"]
    """Time between the two samples around each interval, s."""
    known: Bool[Array, " n"]
    """False where the samples around an interval are too far apart, so that its motion is unknown."""
    measured: Bool[Array, ""]
    """False where no sample is near the span: all rates and forces are then zero."""

    def without_bias(
        self,
        gyro_bias: Float[Array, "3"],
        accel_bias: Float[Array, "3"],
        unmeasured: tuple[Float[Array, "3"], Float[Array, "3"]] | None = None,
    ) -> tuple[Float[Array, "n 3"], Float[Array, "n 3"]]:
        """Return angular rates (rad/s) and specific forces (m/s^2) without biases.

        Args:
            gyro_bias: rad/s, IMU frame.
            accel_bias: m/s^2, IMU frame.
            unmeasured: rate and force where nothing is measured; None: zero.
        """
        rate, force = (0.0, 0.0) if unmeasured is None else unmeasured
        rates = jnp.where(self.measured, self.gyro - gyro_bias, rate)
        return rates, jnp.where(self.measured, self.accel - accel_bias, force)


def sample_intervals(
    imu: ImuBatch, time_offset: Float[Array, ""], start: Float[Array, ""], end: Float[Array, ""]
) -> Intervals:
    """Cut the span from ``start`` to ``end`` at the samples; an interval has the mean of its two ends.

    A span in which there is no sample is cut evenly. The signal is linear between samples and is interpolated
    at the span's ends. Before the first sample and after the last one it is constant. A sample stamped t by
    the IMU was taken at t - time_offset on the lidar's clock. Samples may be in any order. Those that are
    masked or not finite are left out. Without any sample all rates and forces are zero and not measured.

    Args:
        imu: m samples.
        time_offset: lag of the lidar's clock, s.
        start: on the lidar's clock, s, from the same origin as the samples' times.
        end: on the lidar's clock, s, not before ``start``.

    Returns:
        m + 1 intervals; those of samples outside the span have zero duration.
    """
    dtype = time_offset.dtype
    samples = jnp.concatenate([imu.time[:, None], imu.gyro, imu.accel], axis=1).astype(dtype)
    valid = imu.mask & jnp.all(jnp.isfinite(samples), axis=1)
    order = jnp.argsort(jnp.where(valid, imu.time, jnp.inf))
    valid, samples = valid[order], samples[order]
    count = jnp.sum(valid)
    time = jnp.where(valid, samples[:, 0] - time_offset, end + 1)
    signal = jnp.where(valid[:, None], samples[:, 1:], 0.0)
    last = jnp.maximum(count - 1, 0)

    ends = jnp.stack([start, end])
    # selections, not minimum and maximum: at ties their derivative would be a mixture of both branches
    early, late = time <= start, time >= end
    before = jnp.stack([jnp.sum(valid & early), count - jnp.sum(valid & late)]) - 1
    left, right = jnp.clip(before, 0, last), jnp.clip(before + 1, 0, last)
    width = time[right] - time[left]
    # the last sample is held: left and right are the same there
    share = jnp.where(width > 0, (ends - time[left]) / jnp.where(width > 0, width, 1.0), 0.0)
    at_start, at_end = signal[left] + share[:, None] * (signal[right] - signal[left])

    knots = jnp.where(early, start, jnp.where(late, end, time))
    values = jnp.where(early[:, None], at_start, jnp.where(late[:, None], at_end, signal))
    knots = jnp.concatenate([start[None], knots, end[None]])
    values = jnp.concatenate([at_start[None], values, at_end[None]])
    between = jnp.concatenate([jnp.zeros(1, bool), valid[1:] & valid[:-1], jnp.zeros(1, bool)])
    gap = jnp.where(between, jnp.diff(time, prepend=start, append=end), jnp.diff(knots))
    # A span between two samples is cut into many intervals: an error that is constant over all of it would
    # tie the last pose to the mean of the sweep, and errors of the poses would swing forever.
    empty = ~jnp.any(valid & ~early & ~late)
    share = jnp.linspace(0, 1, len(knots), dtype=dtype)[:, None]
    knots = jnp.where(empty, start + share[:, 0] * (end - start), knots)
    values = jnp.where(empty, at_start + share * (at_end - at_start), values)
    gap = jnp.where(empty, jnp.max(jnp.where(knots[1:] > knots[:-1], gap, 0.0)), gap)
    duration = jnp.diff(knots)
    near = (time > start - LONGEST_GAP) | (time[last] >= end)
    near &= (time < end + LONGEST_GAP) | (time[0] <= start)
    any_near = jnp.any(valid & near)
    mean = jnp.where(any_near, (values[1:] + values[:-1]) / 2, 0.0)
    return Intervals(duration, mean[:, :3], mean[:, 3:], gap, (gap <= LONGEST_GAP) & any_near, any_near)
