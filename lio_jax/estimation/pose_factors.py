"""Measurements of poses and positions: by scan matching, between neighbours, by satellites.

Rows that are masked must be finite; their values don't matter. A pose's perturbation is a right one, rotation
(rad) before translation (m).
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
    """The pose of a state, such as a scan match tells it."""

    T_world_imu: jaxlie.SE3
    information: Float[Array, "*b 6 6"]
    """Inverse covariance of its right perturbation; directions without information are allowed."""
    kernel: Float[Array, "*b"]
    """Of :func:`robust_quadratic`, sigmas."""
    mask: Bool[Array, "*b"]
    """False where there is none."""

    def quadratic(self, state: MotionState) -> Quadratic:
        """Return the cost over the pose's error of one measurement: log(measured^-1 T_world_imu)."""
        residual, jacobian = log_and_jacobian(self.T_world_imu.inverse() @ state.T_world_imu)
        return robust_quadratic(residual, jacobian, self.information, self.kernel, self.mask)


class RelativePose(eqx.Module):
    """The pose of the next state in the frame of this one, such as scan-to-scan odometry tells it."""

    T_imu_next: jaxlie.SE3
    information: Float[Array, "*b 6 6"]
    """As that of :class:`PoseMeasurement`."""
    kernel: Float[Array, "*b"]
    mask: Bool[Array, "*b"]

    def quadratic(self, state: MotionState, following: MotionState) -> Quadratic:
        """Return the cost over both poses' errors of one measurement: log(measured^-1 T_imu_next)."""
        between = state.T_world_imu.inverse() @ following.T_world_imu
        residual, by_next = log_and_jacobian(self.T_imu_next.inverse() @ between)
        jacobian = jnp.concatenate([-by_next @ adjoint(between.inverse()), by_next], axis=1)
        return robust_quadratic(residual, jacobian, self.information, self.kernel, self.mask)


class PositionMeasurement(eqx.Module):
    """The position of an antenna, in world."""

    position: Float[Array, "*b 3"]
    """m."""
    sigma: Float[Array, "*b 3"]
    """Per axis of the world, m."""
    lever_arm: Float[Array, "*b 3"]
    """Of the antenna in the IMU frame, m."""
    kernel: Float[Array, "*b"]
    mask: Bool[Array, "*b"]

    def quadratic(self, state: MotionState) -> Quadratic:
        """Return the cost over the pose's error of one measurement."""
        matrix = rotation_matrix(state.T_world_imu.rotation())
        antenna = state.T_world_imu.translation() + matrix @ self.lever_arm
        jacobian = jnp.concatenate([-matrix @ skew(self.lever_arm), matrix], axis=1)
        return robust_quadratic(
            antenna - self.position, jacobian, jnp.diag(self.sigma**-2), self.kernel, self.mask
        )


def fixed_information(
    rotation_sigma: Float[Array, "*b"], translation_sigma: Float[Array, "*b"]
) -> Float[Array, "*b 6 6"]:
    """Return the information of a pose with one sigma for its rotation, rad, and one for its position, m.

    LIO-SAM weighs every scan match alike: 0.05 rad and 0.1 m, or 1 and 1 where it was degenerate.
    """
    sigmas = jnp.repeat(jnp.stack([rotation_sigma, translation_sigma], axis=-1), 3, axis=-1)
    return sigmas[..., None] ** -2 * jnp.eye(POSE_DOF, dtype=sigmas.dtype)
