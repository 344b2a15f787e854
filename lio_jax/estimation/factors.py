"""Factors of the smoother: poses and relative poses with their covariance, and preintegrated inertial
samples."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.error_state import POSITION, ROTATION, VELOCITY, sphere_basis
from lio_jax.core.geometry import adjoint, from_blocks, rotation_matrix, skew
from lio_jax.core.types import NavState
from lio_jax.estimation.marginal_prior import Quadratic, quadratic, robust_quadratic
from lio_jax.estimation.motion_state import POSE_DOF, MotionState
from lio_jax.estimation.pose_logarithm import log_and_jacobian, right_jacobian
from lio_jax.imu.preintegration import Preintegrated, predict


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


FLOOR = (1e-6,) * 9 + (1e-8,) * 3 + (1e-7,) * 3
"""Standard deviations added to the preintegrated covariance, rad, m, m/s, rad/s, m/s^2. Without them the
covariance between two states at one instant, or one sample apart, is singular. They are small against any
sensor's noise and large against float64's rounding."""


def imu_information(covariance: Float[Array, "15 15"]) -> tuple[Float[Array, "15 15"], Float[Array, ""]]:
    """Return the inverse of a preintegrated covariance plus ``FLOOR``, and the inverse's log-determinant."""
    dtype = covariance.dtype
    floored = covariance + jnp.diag(jnp.asarray(FLOOR, dtype) ** 2)
    # scaled to unit variances, because the variances differ by many orders of magnitude
    scale = 1 / jnp.sqrt(jnp.diagonal(floored))
    lower = jnp.linalg.cholesky(scale[:, None] * floored * scale)
    identity = jnp.eye(len(scale), dtype=dtype)
    root = jax.scipy.linalg.solve_triangular(lower, identity, lower=True) * scale
    return root.T @ root, 2 * jnp.sum(jnp.log(jnp.diagonal(root)))


def predicted(measured: Preintegrated, gravity: Float[Array, "3"], start: MotionState) -> MotionState:
    """Return the state at the end of a preintegrated motion; the biases do not change.

    Args:
        measured: preintegrated from ``start``.
        gravity: m/s^2, in world.
        start: state at the first instant.
    """
    still = jaxlie.SE3(jnp.array([1, 0, 0, 0, 0, 0, 0], gravity.dtype))
    nav = NavState(
        T_world_imu=start.T_world_imu,
        velocity=start.velocity,
        gyro_bias=start.gyro_bias,
        accel_bias=start.accel_bias,
        gravity=gravity,
        T_imu_lidar=still,
        time_offset=jnp.zeros((), gravity.dtype),
    )
    return MotionState.of(predict(measured, nav))


def tilted(gravity: Float[Array, "3"], tilt: Float[Array, " q"]) -> Float[Array, "3"]:
    """Return gravity turned by a rotation vector normal to it.

    Args:
        gravity: m/s^2, in world.
        tilt: the rotation about the two axes of :func:`~lio_jax.core.error_state.sphere_basis`, rad; empty
            where gravity's direction is known.
    """
    if not len(tilt):
        return gravity
    return jaxlie.SO3.exp(sphere_basis(gravity) @ tilt) @ gravity


def by_tilt(gravity: Float[Array, "3"], tilt: Float[Array, " q"]) -> Float[Array, "3 q"]:
    """Return the derivative of :func:`tilted` by the tilt."""
    if not len(tilt):
        return jnp.zeros((3, 0), gravity.dtype)
    basis = sphere_basis(gravity)
    # by the left Jacobian of the rotation
    return -skew(tilted(gravity, tilt)) @ right_jacobian(-basis @ tilt)[0] @ basis


def imu_quadratic(
    measured: Preintegrated,
    gravity: Float[Array, "3"],
    tilt: Float[Array, " q"],
    information: Float[Array, "15 15"],
    start: MotionState,
    end: MotionState,
) -> Quadratic:
    """Return the cost of the motion from ``start`` to ``end`` by the errors of both states and of the tilt.

    Args:
        measured: preintegrated from ``start`` to ``end``.
        gravity: m/s^2, in world, without the tilt.
        tilt: of gravity, rad; q is 0 where its direction is known.
        information: from :func:`imu_information`.
        start: state at the first instant.
        end: state at the last instant.
    """
    residual, jacobian = residual_with_tilt(measured, gravity, tilt, start, end)
    return quadratic(residual, jacobian, information, jnp.ones((), residual.dtype))


def residual_with_tilt(
    measured: Preintegrated,
    gravity: Float[Array, "3"],
    tilt: Float[Array, " q"],
    start: MotionState,
    end: MotionState,
) -> tuple[Float[Array, "15"], Float[Array, "15 p"]]:
    """Return :func:`imu_residual`, and its Jacobian by the errors of both states and of the tilt, p = 30 + q.

    Args:
        measured: preintegrated from ``start`` to ``end``.
        gravity: m/s^2, in world, without the tilt.
        tilt: of gravity, rad; q is 0 where its direction is known.
        start: state at the first instant.
        end: state at the last instant.
    """
    residual, jacobian = imu_residual(measured, tilted(gravity, tilt), start, end)
    fall = rotation_matrix(end.T_world_imu.rotation()).T @ by_tilt(gravity, tilt)
    elapsed = jnp.where(measured.measured, measured.duration, 0.0)
    by_fall = from_blocks(
        (15, len(tilt)),
        (POSITION, slice(0, len(tilt)), elapsed**2 / 2 * fall),
        (VELOCITY, slice(0, len(tilt)), elapsed * fall),
    )
    return residual, jnp.concatenate([jacobian, by_fall], axis=1)


def imu_residual(
    measured: Preintegrated, gravity: Float[Array, "3"], start: MotionState, end: MotionState
) -> tuple[Float[Array, "15"], Float[Array, "15 30"]]:
    """Return the difference between the predicted end and ``end``, and its Jacobian by both states' errors.

    The residual is ``end.local(predicted)`` for rotation, position and velocity, as in gtsam's ImuFactor, and
    the biases at the start minus those at the end (Forster et al. 2017, eqs. 45 and 40; right Jacobians from
    appendix C, with all residuals in the end's frame). The biases change the increments to first order.

    Args:
        measured: preintegrated from ``start`` to ``end``. Without samples the velocity is constant.
        gravity: m/s^2, in world.
        start: state at the first instant.
        end: state at the last instant.
    """
    biases = jnp.concatenate([start.gyro_bias, start.accel_bias])
    by_bias = measured.bias_jacobian
    gained = by_bias @ (biases - jnp.concatenate([measured.gyro_bias, measured.accel_bias]))
    elapsed, fall = measured.duration, jnp.where(measured.measured, gravity, 0.0)
    first, last = start.T_world_imu, end.T_world_imu
    back = last.rotation().inverse()
    turned = measured.rotation @ jaxlie.SO3.exp(gained[ROTATION])
    turn = (back @ first.rotation() @ turned).log()
    quaternions = jnp.stack([first.rotation().wxyz, back.wxyz, measured.rotation.wxyz, turned.wxyz])
    R_world_start, R_end_world, R_start_before, R_start_predicted = rotation_matrix(jaxlie.SO3(quaternions))
    R_end_start = R_end_world @ R_world_start
    R_end_before = R_end_start @ R_start_before
    (bias_turn, _), (_, right) = zip(*right_jacobian(jnp.stack([gained[ROTATION], turn])), strict=True)

    # position and velocity stacked
    way = first.translation() + elapsed * (start.velocity + elapsed / 2 * fall) - last.translation()
    speed = start.velocity + elapsed * fall - end.velocity
    increments = jnp.stack([measured.position, measured.velocity])
    increments += jnp.stack([gained[POSITION], gained[VELOCITY]]) @ R_start_before.T
    missed = jnp.stack([way, speed]) @ R_end_world.T + increments @ R_end_start.T
    drift = biases - jnp.concatenate([end.gyro_bias, end.accel_bias])
    residual = jnp.concatenate([turn, missed.ravel(), drift])

    dtype = residual.dtype
    by_gained = jnp.stack([right @ bias_turn, R_end_before, R_end_before])
    by_start_turn = jnp.stack([right @ R_start_predicted.T, *(-R_end_start @ skew(increments))])
    by_end_turn = jnp.stack([-right.T, *skew(missed)])
    # derivatives of position by position and velocity, and of velocity by velocity
    shares = jnp.stack([jnp.ones_like(elapsed), elapsed, jnp.zeros_like(elapsed), jnp.ones_like(elapsed)])
    by_start = shares.reshape(2, 1, 2, 1) * R_end_start[None, :, None]
    motion = jnp.concatenate(
        [
            by_start_turn.reshape(9, 3),
            jnp.concatenate([jnp.zeros((3, 6), dtype), by_start.reshape(6, 6)]),
            (by_gained @ by_bias.reshape(3, 3, 6)).reshape(9, 6),
            by_end_turn.reshape(9, 3),
            -jnp.eye(9, 12, -3, dtype=dtype),
        ],
        axis=1,
    )
    return residual, jnp.concatenate(
        [motion, jnp.eye(6, 30, 9, dtype=dtype) - jnp.eye(6, 30, 24, dtype=dtype)]
    )
