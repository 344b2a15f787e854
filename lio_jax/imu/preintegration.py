"""Preintegration of inertial samples between two states (Forster et al., T-RO 2017)."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.error_state import POSITION, ROTATION, VELOCITY
from lio_jax.core.types import NavState
from lio_jax.imu.discretise import discretise, process_noise
from lio_jax.imu.increments import NAV_DOF, accumulate, nav_transition, sensitivity
from lio_jax.imu.params import ImuParams
from lio_jax.imu.sampling import Intervals


class Preintegrated(eqx.Module):
    """The relative motion that samples between two states measure; it does not depend on the first state."""

    duration: Float[Array, ""]
    """Length of the span, s."""
    rotation: jaxlie.SO3
    """Rotation from the IMU frame at the end to that at the start."""
    position: Float[Array, "3"]
    """Position gained without gravity and initial velocity, m, first IMU frame."""
    velocity: Float[Array, "3"]
    """Velocity gained without gravity, m/s, first IMU frame."""
    gyro_bias: Float[Array, "3"]
    """Bias subtracted from the angular rates, rad/s, IMU frame."""
    accel_bias: Float[Array, "3"]
    """Bias subtracted from the specific forces, m/s^2, IMU frame."""
    bias_jacobian: Float[Array, "9 6"]
    """Derivative of rotation (rad), position (m) and velocity (m/s), as a right perturbation in the last IMU
    frame, by the gyroscope's bias (rad/s) and the accelerometer's bias (m/s^2)."""
    covariance: Float[Array, "15 15"]
    """Covariance of the same rotation, position and velocity, and of the change of both biases."""
    measured: Bool[Array, ""]
    """False where there were no samples: the velocity is then constant, and gravity has no effect."""


def preintegrate(
    intervals: Intervals,
    gyro_bias: Float[Array, "3"],
    accel_bias: Float[Array, "3"],
    params: ImuParams,
    turning: bool = True,
) -> Preintegrated:
    """Preintegrate intervals one after the other, by ``jax.lax.scan``.

    With ``turning`` the specific force is constant in the turning IMU frame, which is exact for constant
    inputs. Without it the force is constant in the IMU frame of each interval's start, as in Forster et al.
    Deltas, covariances and bias Jacobians equal those of gtsam's PreintegratedImuMeasurementsG and
    PreintegratedImuMeasurementsManifold, respectively. (gtsam's default formulation, in the tangent space,
    approximates the same integrals to first order.)

    Args:
        intervals: measured motion; intervals of zero duration change nothing.
        gyro_bias: subtracted from the angular rates, rad/s, IMU frame.
        accel_bias: subtracted from the specific forces, m/s^2, IMU frame.
        params: noise densities.
        turning: which frame holds the specific force, see above.
    """

    def single(piece: Intervals) -> Preintegrated:
        return preintegrate_parallel(piece, gyro_bias, accel_bias, params, turning)

    one_each = jax.tree.map(lambda x: x[:, None] if x.ndim else x, intervals)
    axes = jax.tree.map(lambda x: 0 if x.ndim else None, intervals)
    pieces = jax.vmap(single, in_axes=(axes,))(one_each)
    first = jax.tree.map(lambda x: x[0], pieces)
    rest = jax.tree.map(lambda x: x[1:], pieces)
    return jax.lax.scan(lambda done, piece: (compose(done, piece), None), first, rest)[0]


def preintegrate_parallel(
    intervals: Intervals,
    gyro_bias: Float[Array, "3"],
    accel_bias: Float[Array, "3"],
    params: ImuParams,
    turning: bool = True,
) -> Preintegrated:
    """Return the result of :func:`preintegrate`, by prefix sums and an associative scan over the rotations.

    One span of 20, 100 and 400 intervals takes 0.2, 0.3 and 1.0 ms on two CPU cores in float64;
    :func:`preintegrate` takes 0.3, 0.8 and 3.1 ms. The times on a GPU were not measured.
    """
    measured = intervals.measured
    rate = jnp.where(measured, intervals.gyro - gyro_bias, 0.0)
    accel = jnp.where(measured, intervals.accel - accel_bias, 0.0)
    increments = accumulate(intervals.duration, rate, accel, turning, parallel=True)
    effect = sensitivity(increments, intervals.duration, rate, accel, turning)
    noise = discretise(params, intervals.duration, intervals.gap, intervals.known)
    jacobian = -jnp.sum(effect.inputs, axis=0)
    return Preintegrated(
        duration=increments.time[-1],
        rotation=jaxlie.SO3(increments.rotation.wxyz[-1]),
        position=increments.position[-1],
        velocity=increments.velocity[-1],
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
        bias_jacobian=jnp.where(measured, jacobian, 0.0),
        covariance=process_noise(effect.inputs, noise, measured),
        measured=measured,
    )


def compose(first: Preintegrated, second: Preintegrated) -> Preintegrated:
    """Return the preintegration over two spans, the second of which begins where the first ends.

    Both must have been made with the same biases. The operation is associative.
    """
    carry = nav_transition(second.rotation, second.velocity, second.position, second.duration)
    jacobian = carry @ first.bias_jacobian + second.bias_jacobian
    rows = jnp.concatenate([carry, second.bias_jacobian], axis=1) @ first.covariance
    top = rows[:, :NAV_DOF] @ carry.T + rows[:, NAV_DOF:] @ second.bias_jacobian.T
    corner = first.covariance[NAV_DOF:, NAV_DOF:]
    carried = jnp.block([[top, rows[:, NAV_DOF:]], [rows[:, NAV_DOF:].T, corner]])
    return Preintegrated(
        duration=first.duration + second.duration,
        rotation=(first.rotation @ second.rotation).normalize(),
        position=first.position + first.velocity * second.duration + first.rotation @ second.position,
        velocity=first.velocity + first.rotation @ second.velocity,
        gyro_bias=first.gyro_bias,
        accel_bias=first.accel_bias,
        bias_jacobian=jacobian,
        covariance=carried + second.covariance,
        measured=first.measured & second.measured,
    )


def correct_bias(
    preintegrated: Preintegrated, gyro_bias: Float[Array, "3"], accel_bias: Float[Array, "3"]
) -> Preintegrated:
    """Return the increments for other biases, to first order; the Jacobian and the covariance do not change.

    Args:
        preintegrated: increments with their own biases.
        gyro_bias: rad/s, IMU frame.
        accel_bias: m/s^2, IMU frame.
    """
    change = jnp.concatenate([gyro_bias - preintegrated.gyro_bias, accel_bias - preintegrated.accel_bias])
    error = preintegrated.bias_jacobian @ change
    rotation = preintegrated.rotation
    return Preintegrated(
        duration=preintegrated.duration,
        rotation=(rotation @ jaxlie.SO3.exp(error[ROTATION])).normalize(),
        position=preintegrated.position + rotation @ error[POSITION],
        velocity=preintegrated.velocity + rotation @ error[VELOCITY],
        gyro_bias=gyro_bias,
        accel_bias=accel_bias,
        bias_jacobian=preintegrated.bias_jacobian,
        covariance=preintegrated.covariance,
        measured=preintegrated.measured,
    )


def predict(preintegrated: Preintegrated, nav: NavState) -> NavState:
    """Return the state at the end of a span that began in ``nav``, with ``nav``'s biases and gravity."""
    gained = correct_bias(preintegrated, nav.gyro_bias, nav.accel_bias)
    elapsed = gained.duration
    gravity = jnp.where(gained.measured, nav.gravity, 0.0)
    rotation = nav.T_world_imu.rotation()
    fall = elapsed * (nav.velocity + elapsed / 2 * gravity)
    position = nav.T_world_imu.translation() + fall + rotation @ gained.position
    return eqx.tree_at(
        lambda n: (n.T_world_imu, n.velocity),
        nav,
        (
            jaxlie.SE3.from_rotation_and_translation((rotation @ gained.rotation).normalize(), position),
            nav.velocity + elapsed * gravity + rotation @ gained.velocity,
        ),
    )
