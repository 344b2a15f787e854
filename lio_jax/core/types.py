"""Types that every floor shares: pytrees of scans, samples and states, and the status codes of solves."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

Scalar = Float[Array, ""]
"""An array of one number, the type of most parameters."""


class Scan(eqx.Module):
    """One LiDAR sweep, padded to a bucket size n."""

    points: Float[Array, "n 3"]
    """Coordinates in the lidar frame at the firing time of each point, m."""
    time: Float[Array, " n"]
    """Firing time from the scan's start, s."""
    ring: Int32[Array, " n"]
    """Beam index in the sensor's numbering, from 0."""
    intensity: Float[Array, " n"]
    """Intensity of the return as the sensor reports it, no unit."""
    mask: Bool[Array, " n"]
    """True where a point is real, False on padding."""
    duration: Float[Array, ""]
    """Time from the scan's start to its end, s; 0 for a sweep that is already motion compensated."""
    interval: Float[Array, ""]
    """Time from the previous scan's end to this scan's end, s; 0 for the first scan."""


class ImuBatch(eqx.Module):
    """The inertial samples that cover one scan, padded to m."""

    time: Float[Array, " m"]
    """Sample time from the scan's start, s (may be negative)."""
    gyro: Float[Array, "m 3"]
    """Angular rate in the IMU frame, rad/s."""
    accel: Float[Array, "m 3"]
    """Specific force in the IMU frame, m/s^2: at rest it points up, with magnitude g."""
    mask: Bool[Array, " m"]
    """True where a sample is real, False on padding."""
    orientation: Float[Array, "m 4"] | None = None
    """The IMU's own estimate of its attitude in world, as quaternions xyzw; None where the IMU has none, or
    where the recipe does not use it."""


class NavState(eqx.Module):
    """The estimated state of the vehicle at a scan's end.

    Its error state is that of :mod:`lio_jax.core.error_state`.
    """

    T_world_imu: jaxlie.SE3
    """Pose of the IMU in world, m."""
    velocity: Float[Array, "3"]
    """Velocity of the IMU's origin, m/s, in world."""
    gyro_bias: Float[Array, "3"]
    """Bias of the gyroscope, rad/s, IMU frame."""
    accel_bias: Float[Array, "3"]
    """Bias of the accelerometer, m/s^2, IMU frame."""
    gravity: Float[Array, "3"]
    """Acceleration of gravity, m/s^2, in world; (0, 0, -g) in a level world."""
    T_imu_lidar: jaxlie.SE3
    """Extrinsic pose of the lidar in the IMU frame, m."""
    time_offset: Float[Array, ""]
    """Lag of the lidar's clock, s: a scan stamped t was taken at IMU time t + time_offset."""

    def at_pose(self, T_world_imu: jaxlie.SE3) -> "NavState":
        """Return the state at another pose, m, its velocity turned with it; gravity stays."""
        turn = T_world_imu.rotation() @ self.T_world_imu.rotation().inverse()
        return dataclasses.replace(self, T_world_imu=T_world_imu, velocity=turn @ self.velocity)


def initial_nav_state(T_imu_lidar: jaxlie.SE3, gravity_magnitude: float = 9.80665) -> NavState:
    """Return the state of a level vehicle at rest at the world's origin, with zero biases and time offset.

    Args:
        T_imu_lidar: extrinsic; its dtype is that of the state.
        gravity_magnitude: m/s^2.
    """
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
    """Return the dtype of navigation states and covariances: float64 in JAX's x64 mode, otherwise float32."""
    return jax.dtypes.canonicalize_dtype(jnp.float64)


CONVERGED = 0
"""Status of a solve that converged. Scan matches, the filter and the smoother share these codes."""
ITERATION_LIMIT = 1
"""Status of a solve that did not converge: the last iterate was kept; derivatives there are not to be
trusted."""
LOST = 2
"""Status where the measurement could not be used, for example a scan with too few matches: the result is the
prediction."""
NOT_FINITE = 3
"""Status where numbers overflowed: the result is the prediction, or the last states that were finite."""
