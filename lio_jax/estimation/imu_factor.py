"""Inertial samples between two states, as a factor between them (Forster et al., T-RO 2017)."""

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.error_state import POSITION, ROTATION, VELOCITY
from lio_jax.core.rotation import rotation_matrix, skew
from lio_jax.core.types import NavState
from lio_jax.estimation.motion_state import MotionState
from lio_jax.estimation.pose_logarithm import inverse_right_jacobian
from lio_jax.estimation.quadratic import Quadratic, quadratic
from lio_jax.imu.preintegration import Preintegrated, correct_bias, predict
from lio_jax.imu.rotation_integrals import rotation_integrals

FLOOR = (1e-6,) * 9 + (1e-8,) * 3 + (1e-7,) * 3
"""Sigmas added to the preintegrated covariance, rad, m, m/s, rad/s, m/s^2: between two states of one instant,
or one sample apart, it is singular. Small against any sensor's noise, large against float64's rounding."""


def imu_information(covariance: Float[Array, "15 15"]) -> tuple[Float[Array, "15 15"], Float[Array, ""]]:
    """Return the inverse of a preintegrated covariance, and the inverse's log-determinant."""
    dtype = covariance.dtype
    floored = covariance + jnp.diag(jnp.asarray(FLOOR, dtype) ** 2)
    # scaled to unit variances: the units' sizes differ by orders of magnitude
    scale = 1 / jnp.sqrt(jnp.diagonal(floored))
    lower = jnp.linalg.cholesky(scale[:, None] * floored * scale)
    identity = jnp.eye(len(scale), dtype=dtype)
    root = jax.scipy.linalg.solve_triangular(lower, identity, lower=True) * scale
    return root.T @ root, 2 * jnp.sum(jnp.log(jnp.diagonal(root)))


def predicted(measured: Preintegrated, gravity: Float[Array, "3"], start: MotionState) -> MotionState:
    """Return the end of a motion from its start; the biases stay."""
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


def imu_quadratic(
    measured: Preintegrated,
    gravity: Float[Array, "3"],
    information: Float[Array, "15 15"],
    start: MotionState,
    end: MotionState,
) -> Quadratic:
    """Return the cost of the motion from ``start`` to ``end``, over both states' errors."""
    residual, jacobian = imu_residual(measured, gravity, start, end)
    return quadratic(residual, jacobian, information, jnp.ones((), residual.dtype))


def imu_residual(
    measured: Preintegrated, gravity: Float[Array, "3"], start: MotionState, end: MotionState
) -> tuple[Float[Array, "15"], Float[Array, "15 30"]]:
    """Return the predicted end against ``end``, and how that depends on the errors of both states.

    ``end.local(predicted)`` of rotation, position and velocity, as gtsam's ImuFactor has it, and the biases
    at the start minus those at the end (Forster et al. 2017, eqs. 45 and 40; their right Jacobians, appendix
    C, with all residuals in the end's frame). The biases change the increments to first order.

    Args:
        measured: preintegrated from ``start`` to ``end``. Without samples it says that the velocity stays.
        gravity: in world, m/s^2.
        start: state at the first instant.
        end: state at the last one.
    """
    gained = correct_bias(measured, start.gyro_bias, start.accel_bias)
    elapsed, fall = gained.duration, jnp.where(gained.measured, gravity, 0.0)
    first, last = start.T_world_imu, end.T_world_imu
    R_end_start = rotation_matrix(last.rotation().inverse() @ first.rotation())
    to_end = rotation_matrix(last.rotation()).T
    way = first.translation() + elapsed * (start.velocity + elapsed / 2 * fall) - last.translation()
    missed = last.rotation().inverse() @ first.rotation() @ gained.rotation
    turn = missed.log()
    residual = jnp.concatenate(
        [
            turn,
            to_end @ way + R_end_start @ gained.position,
            to_end @ (start.velocity + elapsed * fall - end.velocity) + R_end_start @ gained.velocity,
            start.gyro_bias - end.gyro_bias,
            start.accel_bias - end.accel_bias,
        ]
    )
    change = jnp.concatenate([start.gyro_bias - measured.gyro_bias, start.accel_bias - measured.accel_bias])
    by_bias = measured.bias_jacobian
    R_end_before = R_end_start @ rotation_matrix(measured.rotation)
    right = inverse_right_jacobian(turn)
    # Exp(c + dc) = Exp(c) Exp(J dc) with the right Jacobian J at c
    bias_turn = rotation_integrals(-by_bias[ROTATION] @ change)[0] @ by_bias[ROTATION]
    zero, identity = jnp.zeros_like(right), jnp.eye(3, dtype=right.dtype)
    by_start = jnp.block(
        [
            [right @ rotation_matrix(gained.rotation).T, zero, zero, right @ bias_turn],
            [
                -R_end_start @ skew(gained.position),
                R_end_start,
                elapsed * R_end_start,
                R_end_before @ by_bias[POSITION],
            ],
            [-R_end_start @ skew(gained.velocity), zero, R_end_start, R_end_before @ by_bias[VELOCITY]],
        ]
    )
    by_end = jnp.block(
        [
            [-right.T, zero, zero, zero, zero],
            [skew(residual[POSITION]), -identity, zero, zero, zero],
            [skew(residual[VELOCITY]), zero, -identity, zero, zero],
        ]
    )
    six = jnp.eye(6, dtype=right.dtype)
    biases = jnp.concatenate([jnp.zeros((6, 9), six.dtype), six], axis=1)
    return residual, jnp.block([[by_start, by_end], [biases, -biases]])
