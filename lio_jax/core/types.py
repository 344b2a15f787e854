"""Device-side types: padded arrays with a mask, as equinox pytrees.

Frames: ``T_a_b`` maps coordinates from b to a. Absolute time never reaches the device: all times here are
seconds from the start of the scan; the host keeps int64 nanoseconds.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

Scalar = Float[Array, ""]


class Scan(eqx.Module):
    """One LiDAR sweep, padded to a bucket size n."""

    points: Float[Array, "n 3"]
    """Coordinates in the lidar frame at each point's own firing time, m."""
    time: Float[Array, " n"]
    """Firing time from the scan's start, s."""
    ring: Int32[Array, " n"]
    """Beam index, 0 = first beam of the sensor's own numbering."""
    intensity: Float[Array, " n"]
    """Return strength as the sensor reports it (no unit)."""
    mask: Bool[Array, " n"]
    """True where a point is real, False on padding."""
    duration: Float[Array, ""]
    """Time from scan start to scan end, s; 0 for a sweep that is already motion compensated."""
    interval: Float[Array, ""]
    """Time from the last scan's end to this scan's end, s; 0 for the first."""


class ImuBatch(eqx.Module):
    """The inertial samples that cover one scan, padded to m."""

    time: Float[Array, " m"]
    """Sample time from the scan's start, s (may be negative)."""
    gyro: Float[Array, "m 3"]
    """Angular rate in the IMU frame, rad/s."""
    accel: Float[Array, "m 3"]
    """Specific force in the IMU frame, m/s^2: +g upwards at rest."""
    mask: Bool[Array, " m"]
    """True where a sample is real."""
    orientation: Float[Array, "m 4"] | None = None
    """What the IMU itself says of its attitude in world, xyzw; None where it says nothing or nobody asks."""


class NavState(eqx.Module):
    """What the estimator knows about the vehicle at a scan's end.

    Its error state is that of :mod:`lio_jax.core.error_state`.
    """

    T_world_imu: jaxlie.SE3
    velocity: Float[Array, "3"]
    """Of the IMU origin, in world, m/s."""
    gyro_bias: Float[Array, "3"]
    """rad/s, IMU frame."""
    accel_bias: Float[Array, "3"]
    """m/s^2, IMU frame."""
    gravity: Float[Array, "3"]
    """In world, m/s^2; (0, 0, -g) once the world is levelled."""
    T_imu_lidar: jaxlie.SE3
    time_offset: Float[Array, ""]
    """Lag of the lidar's clock, s: a scan stamped t was taken at IMU time t + time_offset."""


def initial_nav_state(T_imu_lidar: jaxlie.SE3, gravity_magnitude: float = 9.80665) -> NavState:
    """Return the state of a vehicle at rest at the world's origin, with zero biases."""
    dtype = T_imu_lidar.wxyz_xyz.dtype
    return NavState(
        T_world_imu=jaxlie.SE3(jnp.array([1, 0, 0, 0, 0, 0, 0], dtype)),
        velocity=jnp.zeros(3, dtype),
        gyro_bias=jnp.zeros(3, dtype),
        accel_bias=jnp.zeros(3, dtype),
        gravity=jnp.array([0.0, 0.0, -gravity_magnitude], dtype),
        T_imu_lidar=T_imu_lidar,
        time_offset=jnp.zeros((), dtype),
    )


def state_dtype() -> jnp.dtype:
    """Return the dtype of navigation states and covariances: float64 where JAX's x64 mode is on."""
    return jax.dtypes.canonicalize_dtype(jnp.float64)
