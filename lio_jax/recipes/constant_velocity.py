"""Constant velocity in the terms of an error-state filter, for recordings without inertial samples."""

import dataclasses

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.error_state import DOF, GRAVITY, VELOCITY, NavEstimate, SweptState
from lio_jax.core.types import ImuBatch, NavState, Scan, initial_nav_state
from lio_jax.estimation.map_drift import MapDrift
from lio_jax.imu.discretise import UNKNOWN_ACCEL, UNKNOWN_RATE
from lio_jax.imu.initialise import MOVING_SPEED
from lio_jax.imu.path import Path
from lio_jax.recipes.inertial_filter import predicted
from lio_jax.recipes.params import InertialParams

_SAMPLES = 9
"""Imagined between two scans: the unknown acceleration is white over the pieces. Constant over the whole
interval it would tie the last velocity to the last move, and an error of the velocity would swing forever."""
_WEIGHTLESS = 1e-9
"""Share of gravity that is left: none at all would have no direction."""


def unlevelled_start(params: InertialParams) -> NavEstimate:
    """Return the state at the world's origin, with its first pose as the world's axes and any velocity."""
    nav = initial_nav_state(params.extrinsics.T_imu_lidar())
    nav = dataclasses.replace(nav, velocity=params.initial.velocity)
    # biases, gravity and the extrinsic are not observable apart from the motion: they do not change
    sigma = jnp.zeros(DOF, nav.velocity.dtype).at[VELOCITY].set(MOVING_SPEED)
    return NavEstimate(nav, jnp.diag(sigma**2))


def until_its_middle(scan: Scan, to_last_end: Float[Array, ""]) -> Scan:
    """Return the scan as if its middle were its end, and the last scan's too.

    Args:
        scan: padded sweep.
        to_last_end: from the instant to count from to the last scan's end, s.
    """
    middle = scan.duration / 2
    interval = to_last_end.astype(scan.interval.dtype) + scan.interval - middle
    return dataclasses.replace(scan, duration=middle, interval=interval)


def carried_on(nav: NavState, rate: Float[Array, "3"], seconds: Float[Array, ""]) -> NavState:
    """Return the state some time later, its velocity constant in the body's own axes."""
    velocity = nav.T_world_imu.rotation().inverse() @ nav.velocity
    moved = nav.T_world_imu @ jaxlie.SE3.exp(seconds * jnp.concatenate([velocity, rate]))
    return dataclasses.replace(
        nav, T_world_imu=jaxlie.SE3(moved.wxyz_xyz), velocity=moved.rotation() @ velocity
    )


def mean_rate(last: NavState, nav: NavState, scan: Scan) -> Float[Array, "3"]:
    """Return the mean angular rate over a scan's interval, rad/s, IMU frame; 0 where it is empty."""
    interval = scan.interval.astype(nav.velocity.dtype)
    turn = (last.T_world_imu.rotation().inverse() @ nav.T_world_imu.rotation()).log()
    return jnp.where(interval > 0, turn / jnp.where(interval > 0, interval, 1.0), 0.0)


def predicted_without_samples(
    params: InertialParams, last: NavEstimate, rate: Float[Array, "3"], scan: Scan, first: Bool[Array, ""]
) -> tuple[SweptState, Path]:
    """Return the state at the scan's end and the motion since the last one's if the body went on as it moved.

    Args:
        params: traced.
        last: at the last scan's end.
        rate: angular rate, rad/s, IMU frame.
        scan: the scan to predict.
        first: no scan was seen before.
    """
    dtype = rate.dtype
    imu = dataclasses.replace(
        params.imu,
        gyro_noise=jnp.asarray(UNKNOWN_RATE, dtype),
        accel_noise=jnp.asarray(UNKNOWN_ACCEL, dtype),
        gyro_bias_walk=jnp.zeros((), dtype),
        accel_bias_walk=jnp.zeros((), dtype),
    )
    # weightless: an error of the tilt must not look like an acceleration, which nobody measured
    floating = dataclasses.replace(last.nav, gravity=_WEIGHTLESS * last.nav.gravity)
    samples = _imagined_samples(floating, rate, scan)
    prior, path = predicted(
        dataclasses.replace(params, imu=imu),
        NavEstimate(floating, last.covariance),
        scan,
        samples,
        first,
        # at its middle, where the scan is predicted, its pose is the mean
        sweep_start=scan.duration,
    )
    nav = dataclasses.replace(prior.nav, gravity=last.nav.gravity)
    return SweptState(nav, prior.covariance, prior.transition), path


def with_gravity_held(state: NavEstimate, drift: MapDrift) -> tuple[NavEstimate, MapDrift]:
    """Return state and drift without an error of gravity's direction: no scan tells it.

    A map that is turned by its error would share that error with it.
    """
    kept = jnp.ones(DOF, state.covariance.dtype).at[GRAVITY].set(0.0)
    covariance = kept[:, None] * state.covariance * kept
    return NavEstimate(state.nav, covariance), dataclasses.replace(drift, cross=kept[:, None] * drift.cross)


def _imagined_samples(nav: NavState, rate: Float[Array, "3"], scan: Scan) -> ImuBatch:
    """Return what an ideal sensor would measure while the velocity is constant in the body's own axes."""
    dtype = rate.dtype
    velocity = nav.T_world_imu.rotation().inverse() @ nav.velocity
    force = jnp.cross(rate, velocity)
    end = scan.duration.astype(dtype)
    time = end - jnp.linspace(1, 0, _SAMPLES, dtype=dtype) * scan.interval.astype(dtype)
    return ImuBatch(
        time, jnp.tile(rate, (_SAMPLES, 1)), jnp.tile(force, (_SAMPLES, 1)), jnp.ones(_SAMPLES, bool)
    )
