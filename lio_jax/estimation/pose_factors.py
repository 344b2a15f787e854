"""Measurements of poses and positions: by scan matching, between neighbouring states, and by satellites.

Masked rows must be finite; their values have no effect. The perturbation of a pose is a right perturbation,
rotation (rad) before translation (m).
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.geometry import adjoint, rotation_matrix, skew
from lio_jax.estimation.motion_state import POSE_DOF, MotionState
from lio_jax.estimation.pose_logarithm import log_and_jacobian
from lio_jax.estimation.quadratic import Quadratic, robust_quadratic


class PoseMeasurement(eqx.Module):
    """A measured pose of a state, for example by a scan match."""

    T_world_imu: jaxlie.SE3
    """Measured pose of the IMU in world, m."""
    information: Float[Array, "*b 6 6"]
    """Inverse covariance of its right perturbation; directions without information are allowed."""
    kernel: Float[Array, "*b"]
    """Kernel width of :func:`robust_quadratic`, standard deviations."""
    mask: Bool[Array, "*b"]
    """False where there is no measurement."""

    def quadratic(self, state: MotionState) -> Quadratic:
        """Return the cost of one measurement by the pose's error; the residual is log(measured^-1 T)."""
        residual, jacobian = log_and_jacobian(self.T_world_imu.inverse() @ state.T_world_imu)
        return robust_quadratic(residual, jacobian, self.information, self.kernel, self.mask)


class RelativePose(eqx.Module):
    """A measured pose of the next state in the frame of this one, for example by scan-to-scan odometry."""

    T_imu_next: jaxlie.SE3
    """Measured pose of the next IMU frame in this one, m."""
    information: Float[Array, "*b 6 6"]
    """Inverse covariance of its right perturbation; directions without information are allowed."""
    kernel: Float[Array, "*b"]
    """Kernel width of :func:`robust_quadratic`, standard deviations."""
    mask: Bool[Array, "*b"]
    """False where there is no measurement."""

    def quadratic(self, state: MotionState, following: MotionState) -> Quadratic:
        """Return the cost of one measurement by both poses' errors; the residual is log(measured^-1 T)."""
        between = state.T_world_imu.inverse() @ following.T_world_imu
        residual, by_next = log_and_jacobian(self.T_imu_next.inverse() @ between)
        jacobian = jnp.concatenate([-by_next @ adjoint(between.inverse()), by_next], axis=1)
        return robust_quadratic(residual, jacobian, self.information, self.kernel, self.mask)


class PositionMeasurement(eqx.Module):
    """A measured position of an antenna."""

    position: Float[Array, "*b 3"]
    """Measured position, m, in world."""
    sigma: Float[Array, "*b 3"]
    """Standard deviation along each axis of the world, m."""
    lever_arm: Float[Array, "*b 3"]
    """Position of the antenna, m, IMU frame."""
    kernel: Float[Array, "*b"]
    """Kernel width of :func:`robust_quadratic`, standard deviations."""
    mask: Bool[Array, "*b"]
    """False where there is no measurement."""

    def quadratic(self, state: MotionState) -> Quadratic:
        """Return the cost of one measurement by the pose's error."""
        matrix = rotation_matrix(state.T_world_imu.rotation())
        antenna = state.T_world_imu.translation() + matrix @ self.lever_arm
        jacobian = jnp.concatenate([-matrix @ skew(self.lever_arm), matrix], axis=1)
        return robust_quadratic(
            antenna - self.position, jacobian, jnp.diag(self.sigma**-2), self.kernel, self.mask
        )


def fixed_information(
    rotation_sigma: Float[Array, "*b"], translation_sigma: Float[Array, "*b"]
) -> Float[Array, "*b 6 6"]:
    """Return the information of a pose with one standard deviation for rotation and one for position.

    LIO-SAM gives every scan match the same information: 0.05 rad and 0.1 m, or 1 rad and 1 m for a degenerate
    match.

    Args:
        rotation_sigma: rad, per axis.
        translation_sigma: m, per axis.
    """
    sigmas = jnp.repeat(jnp.stack([rotation_sigma, translation_sigma], axis=-1), 3, axis=-1)
    return sigmas[..., None] ** -2 * jnp.eye(POSE_DOF, dtype=sigmas.dtype)
