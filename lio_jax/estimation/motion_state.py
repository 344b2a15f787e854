"""The states of a chain: pose, velocity and biases."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.error_state import ACCEL_BIAS, BIASES, GYRO_BIAS, POSITION, ROTATION, VELOCITY
from lio_jax.core.geometry import from_blocks, rotation_matrix
from lio_jax.core.types import NavState
from lio_jax.estimation.pose_logarithm import right_jacobian

DOF = 15
"""Size of the error: the first entries of :mod:`lio_jax.core.error_state`, in that order."""
POSE_DOF = 6
"""Size of the pose's error: rotation (rad) before translation (m)."""


class MotionState(eqx.Module):
    """Pose, velocity and biases of the IMU; batches have one row for each state."""

    T_world_imu: jaxlie.SE3
    """Pose of the IMU in world, m."""
    velocity: Float[Array, "*b 3"]
    """Velocity of the IMU's origin, m/s, in world."""
    gyro_bias: Float[Array, "*b 3"]
    """Bias of the gyroscope, rad/s, IMU frame."""
    accel_bias: Float[Array, "*b 3"]
    """Bias of the accelerometer, m/s^2, IMU frame."""

    @staticmethod
    def of(nav: NavState) -> "MotionState":
        """Return the part of a navigation state that a chain estimates."""
        return MotionState(nav.T_world_imu, nav.velocity, nav.gyro_bias, nav.accel_bias)

    def retract(self, error: Float[Array, "*b 15"]) -> "MotionState":
        """Return the state with a right perturbation: R Exp(dtheta), p + R dp, v + R dv, biases added."""
        rotation = self.T_world_imu.rotation()
        matrix = rotation_matrix(rotation)
        turned = (rotation @ jaxlie.SO3.exp(error[..., ROTATION])).normalize()
        moved = self.T_world_imu.translation() + _rotated(matrix, error[..., POSITION])
        return MotionState(
            T_world_imu=jaxlie.SE3.from_rotation_and_translation(turned, moved),
            velocity=self.velocity + _rotated(matrix, error[..., VELOCITY]),
            gyro_bias=self.gyro_bias + error[..., GYRO_BIAS],
            accel_bias=self.accel_bias + error[..., ACCEL_BIAS],
        )

    def moved_by(self, T_new_old: jaxlie.SE3) -> "MotionState":
        """Return the state in another world frame; a batch has one transformation for all rows."""
        return MotionState(
            T_world_imu=T_new_old @ self.T_world_imu,
            velocity=T_new_old.rotation() @ self.velocity,
            gyro_bias=self.gyro_bias,
            accel_bias=self.accel_bias,
        )

    def local(self, other: "MotionState") -> Float[Array, "*b 15"]:
        """Return the error for which ``self.retract(error) == other``."""
        back = jnp.swapaxes(rotation_matrix(self.T_world_imu.rotation()), -1, -2)
        turn = self.T_world_imu.rotation().inverse() @ other.T_world_imu.rotation()
        return jnp.concatenate(
            [
                turn.log(),
                _rotated(back, other.T_world_imu.translation() - self.T_world_imu.translation()),
                _rotated(back, other.velocity - self.velocity),
                other.gyro_bias - self.gyro_bias,
                other.accel_bias - self.accel_bias,
            ],
            axis=-1,
        )


def local_jacobian(origin: MotionState, state: MotionState) -> Float[Array, "15 15"]:
    """Return the derivative of ``origin.local(state)`` by a perturbation of ``state``."""
    turn = origin.T_world_imu.rotation().inverse() @ state.T_world_imu.rotation()
    matrix = rotation_matrix(turn)
    return from_blocks(
        (DOF, DOF),
        (ROTATION, ROTATION, right_jacobian(turn.log())[1]),
        (POSITION, POSITION, matrix),
        (VELOCITY, VELOCITY, matrix),
        (BIASES, BIASES, jnp.eye(6, dtype=matrix.dtype)),
    )


def _rotated(matrix: Float[Array, "*b 3 3"], vector: Float[Array, "*b 3"]) -> Float[Array, "*b 3"]:
    return (matrix @ vector[..., None])[..., 0]
