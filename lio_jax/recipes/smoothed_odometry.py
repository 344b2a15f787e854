"""LIO-SAM's IMU odometry: a window of states with preintegrated samples between them, and limits of matched
poses."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.error_state import (
    ACCEL_BIAS,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    VELOCITY,
    NavEstimate,
    sphere_basis,
)
from lio_jax.core.error_state import DOF as NAV_DOF
from lio_jax.core.geometry import adjoint, from_blocks, rotation_matrix
from lio_jax.core.types import ImuBatch, NavState
from lio_jax.estimation.factors import PoseMeasurement, fixed_information
from lio_jax.estimation.marginal_prior import gaussian_prior
from lio_jax.estimation.motion_state import DOF, POSE_DOF, MotionState
from lio_jax.estimation.pose_logarithm import right_jacobian
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


_UNKNOWNS = GRAVITY.stop
"""Number of unknowns of the latest state: its own, and the direction of gravity."""
_LEAST_SIGMA = 1e-6
"""Standard deviation of a frozen part of the state, in its own unit: it hardly moves."""


def opened(config: LioSamConfig, params: LioSamParams, start: NavEstimate) -> Window:
    """Return the window with one state, and with the direction of gravity as an unknown.

    Args:
        config: ``config.lio_sam.window``.
        params: ``params.smoother``.
        start: the state and its covariance; its gravity is that without a tilt.
    """
    nav, smoother = start.nav, params.smoother
    prior = gaussian_prior(MotionState.of(nav), unknowns_covariance(start))
    unmatched = PoseMeasurement(
        nav.T_world_imu,
        fixed_information(smoother.rotation_sigma, smoother.translation_sigma),
        smoother.kernel,
        jnp.array(False),
    )
    first = Added(still_link(nav.velocity.dtype), unmatched)
    return open_window(config.lio_sam.window, prior, nav.gravity, first)


def unknowns_covariance(start: NavEstimate) -> Float[Array, "17 17"]:
    """Return the covariance of the window's unknowns: the first state, and the tilt of gravity."""
    least = _LEAST_SIGMA**2 * jnp.eye(_UNKNOWNS, dtype=start.covariance.dtype)
    return start.covariance[:_UNKNOWNS, :_UNKNOWNS] + least


def opened_anew(config: LioSamConfig, params: LioSamParams, nav: NavState, window: Window) -> Window:
    """Return the window with one state after a failure, around which the truth may lie anywhere near.

    Args:
        config: ``config.lio_sam.window``.
        params: ``params.initial`` and ``params.smoother``.
        nav: the state.
        window: before the failure: the tilt of gravity that it found is where the search begins.
    """
    initial, smoother = params.initial, params.smoother
    sigmas = (
        (ROTATION, smoother.rotation_sigma),
        (POSITION, smoother.degenerate_sigma),
        (VELOCITY, initial.velocity_sigma),
        (GYRO_BIAS, initial.gyro_bias_sigma),
        (ACCEL_BIAS, initial.accel_bias_sigma),
        (GRAVITY, initial.gravity_sigma),
    )
    dtype = nav.velocity.dtype
    blocks = ((part, part, sigma**2 * jnp.eye(part.stop - part.start, dtype=dtype)) for part, sigma in sigmas)
    vertical = dataclasses.replace(nav, gravity=window.chain.gravity)
    fresh = opened(config, params, NavEstimate(vertical, from_blocks((NAV_DOF, NAV_DOF), *blocks)))
    places = lambda some: (some.tilt, some.chain.prior.tilt)  # noqa: E731
    return eqx.tree_at(places, fresh, (window.tilt, window.tilt))


def nav_covariance(error: Float[Array, "p p"], window: Window) -> Float[Array, "24 24"]:
    """Return the covariance of a window's latest state at its place in the navigation state's error.

    Args:
        error: covariance of the errors of the latest state and of the tilt.
        window: the window.
    """
    vertical, tilt = window.chain.gravity, window.tilt
    basis = sphere_basis(vertical)
    # the error of the direction is about axes normal to gravity as it is found
    turned = sphere_basis(window.gravity()).T @ right_jacobian(-basis @ tilt)[0] @ basis
    placed = from_blocks(
        (NAV_DOF, _UNKNOWNS),
        (slice(0, DOF), slice(0, DOF), jnp.eye(DOF, dtype=turned.dtype)),
        (GRAVITY, GRAVITY, turned),
    )
    return placed @ error @ placed.T


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
