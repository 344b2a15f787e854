"""LIO-SAM's IMU odometry: a window of states with preintegrated samples between them, and limits of matched
poses."""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.error_state import ACCEL_BIAS, GYRO_BIAS, POSITION, ROTATION, VELOCITY
from lio_jax.core.geometry import adjoint, from_blocks, rotation_matrix
from lio_jax.core.types import ImuBatch, NavState
from lio_jax.estimation.factors import PoseMeasurement, fixed_information
from lio_jax.estimation.marginal_prior import gaussian_prior
from lio_jax.estimation.motion_state import DOF, POSE_DOF, MotionState
from lio_jax.estimation.pose_measurement import keep_observed
from lio_jax.estimation.sliding_window import Added, Window, open_window, still_link
from lio_jax.recipes.lio_sam_params import LioSamConfig, LioSamParams, SmootherParams
from lio_jax.registration.gauss_newton import Registration


def drawn_to_tilt(T_world_imu: jaxlie.SE3, R_world_imu: jaxlie.SO3, weight: Float[Array, ""]) -> jaxlie.SE3:
    """Return a pose with roll and pitch turned towards those of another attitude by a share of the way.

    Args:
        T_world_imu: the pose.
        R_world_imu: the other attitude, whose heading does not count.
        weight: the share.
    """
    up = rotation_matrix(T_world_imu.rotation())[2]
    other = rotation_matrix(R_world_imu)[2]
    # the shortest turn in the body's frame that takes the other's vertical to the pose's own
    axis, cosine = jnp.cross(other, up), jnp.dot(other, up)
    sine_squared = jnp.sum(axis**2)
    some = sine_squared > 1e-20
    sine = jnp.sqrt(jnp.where(some, sine_squared, 1.0))
    turn = jnp.where(some, axis * jnp.arctan2(sine, cosine) / sine, axis)
    rotation = (T_world_imu.rotation() @ jaxlie.SO3.exp(weight * turn)).normalize()
    return jaxlie.SE3.from_rotation_and_translation(rotation, T_world_imu.translation())


def within_limits(T_world_lidar: jaxlie.SE3, params: SmootherParams) -> jaxlie.SE3:
    """Return a pose with roll, pitch and height cut off at their limits: the lidar's, as in LIO-SAM."""
    angles = T_world_lidar.rotation().as_rpy_radians()
    roll, pitch = (
        jnp.clip(angle, -params.tilt_limit, params.tilt_limit) for angle in (angles.roll, angles.pitch)
    )
    position = T_world_lidar.translation()
    height = jnp.clip(position[2], -params.height_limit, params.height_limit)
    level = jaxlie.SO3.from_rpy_radians(roll, pitch, angles.yaw).wxyz
    # untouched to the last bit where nothing is cut off, and where straight up leaves no angles
    cut = (jnp.abs(angles.roll) > params.tilt_limit) | (jnp.abs(angles.pitch) > params.tilt_limit)
    rotation = jaxlie.SO3(jnp.where(cut, level, T_world_lidar.rotation().wxyz))
    return jaxlie.SE3.from_rotation_and_translation(rotation, position.at[2].set(height))


def measured_attitude(
    imu: ImuBatch, time: Float[Array, ""], predicted: jaxlie.SO3
) -> tuple[jaxlie.SO3, Bool[Array, ""]]:
    """Return the attitude that the IMU itself reports nearest an instant, and whether it reports any.

    Args:
        imu: samples, with or without orientations.
        time: s from the scan's start, on the IMU's clock.
        predicted: taken where there is none.
    """
    if imu.orientation is None:
        return predicted, jnp.array(False)
    usable = imu.mask & (jnp.abs(jnp.sum(imu.orientation**2, axis=1) - 1) < 1e-2)
    nearest = jnp.argmin(jnp.where(usable, jnp.abs(imu.time - time), jnp.inf))
    there = usable[nearest]
    x, y, z, w = imu.orientation[nearest]
    wxyz = jnp.where(there, jnp.stack([w, x, y, z]), predicted.wxyz)
    return jaxlie.SO3(wxyz).normalize(), there


def opened(
    config: LioSamConfig, params: LioSamParams, nav: NavState, position_sigma: Float[Array, ""] | None = None
) -> Window:
    """Return the window with one state, around which ``params.initial`` says how far the truth may lie.

    Args:
        config: ``config.lio_sam.window``.
        params: ``params.initial`` and ``params.smoother``.
        nav: the state.
        position_sigma: m; None: that of ``params.smoother``, as the first position defines the world.
    """
    initial, smoother = params.initial, params.smoother
    identity = jnp.eye(3, dtype=nav.velocity.dtype)
    sigmas = (
        (ROTATION, initial.rotation_sigma),
        (POSITION, smoother.position_sigma if position_sigma is None else position_sigma),
        (VELOCITY, initial.velocity_sigma),
        (GYRO_BIAS, initial.gyro_bias_sigma),
        (ACCEL_BIAS, initial.accel_bias_sigma),
    )
    # a frozen part of the state is one that hardly moves
    blocks = ((part, part, jnp.maximum(sigma, 1e-6) ** 2 * identity) for part, sigma in sigmas)
    covariance = from_blocks((DOF, DOF), *blocks)
    prior = gaussian_prior(MotionState.of(nav), covariance)
    unmatched = PoseMeasurement(
        nav.T_world_imu,
        fixed_information(smoother.rotation_sigma, smoother.translation_sigma),
        smoother.kernel,
        jnp.array(False),
    )
    first = Added(still_link(nav.velocity.dtype), unmatched)
    return open_window(config.lio_sam.window, prior, nav.gravity, first)


def match_as_measurement(
    config: LioSamConfig,
    params: LioSamParams,
    T_world_imu: jaxlie.SE3,
    match: Registration,
    arm_squared: Float[Array, ""],
    there: Bool[Array, ""],
) -> PoseMeasurement:
    """Return the measurement of the IMU's pose by a scan match.

    Args:
        config: ``config.lio_sam.lidar_noise``.
        params: ``params.smoother``.
        T_world_imu: the pose.
        match: it comes from.
        arm_squared: mean squared distance of the scan's points from the sensor, m^2.
        there: whether there was one.
    """
    if config.lio_sam.lidar_noise == "information":
        by_imu = adjoint(params.extrinsics.T_imu_lidar().inverse())
        # along a degenerate direction the pose is the prediction, which the samples measure already
        ratio = jnp.where(jnp.any(match.degenerate), params.registration.degeneracy_ratio, 0.0)
        observed, _, _ = keep_observed(
            match.information, jnp.zeros(POSE_DOF, arm_squared.dtype), arm_squared, ratio
        )
        information = params.registration.information_scale * (by_imu.T @ observed @ by_imu)
    else:
        smoother = params.smoother
        degenerate = jnp.any(match.degenerate)
        sigmas = (
            jnp.where(degenerate, smoother.degenerate_sigma, sigma)
            for sigma in (smoother.rotation_sigma, smoother.translation_sigma)
        )
        information = fixed_information(*sigmas)
    return PoseMeasurement(T_world_imu, information, params.smoother.kernel, there)


def runs_away(state: MotionState, params: LioSamParams) -> Bool[Array, ""]:
    """Return whether velocity or biases are beyond ``params.limits``, or not finite."""
    limits = params.limits
    sizes = (
        (state.velocity, limits.speed),
        (state.gyro_bias, limits.gyro_bias),
        (state.accel_bias, limits.accel_bias),
    )
    # not "larger than": that would be false of what is not finite
    within = [jnp.linalg.norm(vector) <= limit for vector, limit in sizes]
    return ~jnp.all(jnp.stack([*within, jnp.all(jnp.isfinite(state.T_world_imu.wxyz_xyz))]))
