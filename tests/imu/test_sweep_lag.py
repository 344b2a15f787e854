"""The lag of a sweep's mean pose behind its end, against the mean over perturbed motions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.error_state import DOF, LAG, POSITION, ROTATION, NavEstimate, retract
from lio_jax.imu.path import pose_at
from lio_jax.imu.sample_effects import still_to_show
from lio_jax.imu.strapdown import path_along, propagate_sweep
from tests.imu.motion import ideal_imu, nav_at, quick_jit
from tests.params import default_params

PARAMS = default_params().imu
NOISELESS = jax.tree.map(jnp.zeros_like, PARAMS)
START, END = jnp.asarray(-0.013), jnp.asarray(0.1)
ORIGIN, OFFSET, STEP = 1.0, 0.0021, 0.002
TIMES = -0.02 + STEP * np.arange(66)
IMU = ideal_imu(ORIGIN + TIMES, ORIGIN, OFFSET, size=len(TIMES))
NAV = nav_at(ORIGIN + float(START), OFFSET)
SWEEPS = [START, jnp.asarray(0.0), jnp.asarray(0.06)]


def lag(nav, imu, sweep_start):
    """Return how the pose's deviation from NAV's and IMU's motion at the end differs from its mean."""
    times = jnp.concatenate([jnp.linspace(sweep_start, END, 401)[:-1] + (END - sweep_start) / 800, END[None]])
    foretold = pose_at(path_along(NAV, IMU, START, END), times)
    poses = pose_at(path_along(nav, imu, START, END), times)
    turned = (poses.rotation() @ foretold.rotation().inverse()).log()
    moved = poses.translation() - foretold.translation()
    deviation = jnp.concatenate([turned, moved], axis=1)
    back = jax.tree.map(lambda leaf: leaf[-1], foretold).rotation().inverse().as_matrix()
    ahead = deviation[-1] - jnp.mean(deviation[:-1], axis=0)
    return jnp.concatenate([back @ ahead[:3], back @ ahead[3:]])


@quick_jit
def by_start(sweep_start):
    return jax.jacfwd(lambda error: lag(retract(NAV, error), IMU, sweep_start))(jnp.zeros(DOF))


@quick_jit
def by_samples(sweep_start):
    """Return the derivative by the gyro's and the accelerometer's samples, (6, m, 6)."""

    def disturbed(change):
        gyro, accel = IMU.gyro + change[:, :3], IMU.accel + change[:, 3:]
        return lag(NAV, dataclasses.replace(IMU, gyro=gyro, accel=accel), sweep_start)

    return jax.jacfwd(disturbed)(jnp.zeros((len(TIMES), 6)))


swept = quick_jit(propagate_sweep)


@pytest.mark.parametrize("sweep_start", SWEEPS)
def test_errors_at_the_start_lag_as_they_do_in_the_mean_of_perturbed_motions(sweep_start):
    expected = np.asarray(by_start(sweep_start))
    # the rows of a covariance whose one entry is a single component's are its columns of the transition
    for place in range(DOF):
        begun = NavEstimate(NAV, jnp.zeros((DOF, DOF)).at[place, place].set(1.0))
        covariance = np.asarray(swept(begun, IMU, NOISELESS, START, END, sweep_start)[0].covariance)
        want = np.outer(expected[:, place], expected[:, place])
        np.testing.assert_allclose(covariance[LAG, LAG], want, atol=0.03 * want.max() + 1e-9)


@pytest.mark.parametrize("sweep_start", SWEEPS)
def test_white_noise_lags_as_in_the_mean_of_perturbed_motions(sweep_start):
    quiet = dataclasses.replace(NOISELESS, gyro_noise=PARAMS.gyro_noise, accel_noise=PARAMS.accel_noise)
    begun = NavEstimate(NAV, jnp.zeros((DOF, DOF)))
    covariance = np.asarray(swept(begun, IMU, quiet, START, END, sweep_start)[0].covariance)[LAG, LAG]
    effect = np.asarray(by_samples(sweep_start))
    sigma = np.repeat(np.array([PARAMS.gyro_noise, PARAMS.accel_noise]) / np.sqrt(STEP), 3)
    flat = (effect * sigma).reshape(6, -1)
    want = flat @ flat.T
    scale = np.sqrt(np.diag(want))
    np.testing.assert_allclose(covariance / np.outer(scale, scale), want / np.outer(scale, scale), atol=0.05)


def test_a_sweep_of_no_duration_does_not_lag():
    begun = NavEstimate(NAV, 0.01 * jnp.eye(DOF))
    covariance = np.asarray(swept(begun, IMU, PARAMS, START, END, END)[0].covariance)
    np.testing.assert_allclose(covariance[LAG], 0, atol=1e-18)
    np.testing.assert_allclose(covariance[:, LAG], 0, atol=1e-18)


def test_a_constant_velocity_error_lags_by_half_the_sweep():
    begun = NavEstimate(NAV, jnp.zeros((DOF, DOF)).at[6:9, 6:9].set(jnp.eye(3)))
    found = np.asarray(swept(begun, IMU, NOISELESS, START, END, jnp.asarray(0.0))[0].covariance)
    np.testing.assert_allclose(np.diag(found[LAG, LAG]), [0, 0, 0, *3 * [0.05**2]], atol=1e-12)
    np.testing.assert_allclose(np.diag(found[POSITION, LAG][:, 3:]), 3 * [0.05 * 0.113], atol=1e-12)
    np.testing.assert_array_equal(found[ROTATION, LAG], 0)


def test_shares_are_the_mean_over_the_sweep():
    time, start, end = jnp.linspace(-0.03, 0.1, 14), jnp.asarray(0.02), jnp.asarray(0.1)
    points = np.linspace(0.02, 0.1, 200_001)
    with np.errstate(invalid="ignore"):
        since = np.maximum(points - np.asarray(time)[:-1, None], 0) / (0.1 - np.asarray(time)[:-1, None])
    shares = [np.asarray(share)[:-1] for share in still_to_show(time, start, end)]
    np.testing.assert_allclose(shares[0], 1 - np.mean(since > 0, axis=1), atol=1e-5)
    np.testing.assert_allclose(shares[1], 1 - np.mean(since, axis=1), atol=1e-5)
    np.testing.assert_allclose(shares[2], 1 - np.mean(since**2, axis=1), atol=1e-5)
