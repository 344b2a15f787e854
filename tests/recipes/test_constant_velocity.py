"""The prediction without inertial samples, against the matrix exponential and white noise in closed form."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.linalg import expm

from lio_jax.core.error_state import POSITION, ROTATION, VELOCITY, NavEstimate
from lio_jax.core.types import Scan
from lio_jax.imu.discretise import UNKNOWN_ACCEL, UNKNOWN_RATE
from lio_jax.recipes.constant_velocity import (
    carried_on,
    mean_rate,
    predicted_without_samples,
    unlevelled_start,
    until_its_middle,
)
from tests.params import default_params

PARAMS = default_params()
SPEED = np.array([4.0, -0.5, 0.2])
"""m/s, body axes."""
RATE = np.array([0.1, -0.2, 0.6])
POSE = jaxlie.SE3.from_rotation_and_translation(
    jaxlie.SO3.from_rpy_radians(0.1, -0.3, 1.2), jnp.array([10.0, -3.0, 1.0])
)


def scan(duration: float = 0.1, interval: float = 0.1) -> Scan:
    return Scan(
        points=jnp.zeros((1, 3), jnp.float32),
        time=jnp.zeros(1, jnp.float32),
        ring=jnp.zeros(1, jnp.int32),
        intensity=jnp.zeros(1, jnp.float32),
        mask=jnp.zeros(1, bool),
        duration=jnp.float32(duration),
        interval=jnp.float32(interval),
    )


def moved(seconds: float) -> np.ndarray:
    (vx, vy, vz), (wx, wy, wz) = SPEED, RATE
    twist = np.array([[0, -wz, wy, vx], [wz, 0, -wx, vy], [-wy, wx, 0, vz], [0, 0, 0, 0]])
    return np.asarray(POSE.as_matrix()) @ expm(seconds * twist)


def start() -> NavEstimate:
    """A state that is known exactly."""
    begun = unlevelled_start(PARAMS)
    nav = dataclasses.replace(begun.nav, T_world_imu=POSE, velocity=POSE.rotation() @ jnp.asarray(SPEED))
    return NavEstimate(nav, jnp.zeros_like(begun.covariance))


_predicted = jax.jit(predicted_without_samples)


def predict(item: Scan) -> NavEstimate:
    return _predicted(PARAMS, start(), jnp.asarray(RATE), item, jnp.array(False))[0]


@pytest.mark.parametrize("interval", [0.1, 0.3])
def test_the_prediction_goes_on_with_the_bodys_own_velocity(interval):
    nav = predict(scan(interval=interval)).nav
    expected = moved(np.float32(interval))
    np.testing.assert_allclose(nav.T_world_imu.as_matrix(), expected, atol=2e-3 * interval)
    np.testing.assert_allclose(nav.velocity, expected[:3, :3] @ SPEED, atol=0.02 * interval)
    np.testing.assert_array_equal(nav.gravity, start().nav.gravity)


def test_the_unknown_motion_is_white():
    """Acceleration constant over the interval would correlate position and velocity fully."""
    covariance = np.asarray(predict(scan()).covariance)
    sigma = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(sigma[ROTATION], UNKNOWN_RATE * 0.1**0.5, rtol=0.01)
    np.testing.assert_allclose(sigma[VELOCITY], UNKNOWN_ACCEL * 0.1**0.5, rtol=0.03)
    np.testing.assert_allclose(sigma[POSITION], UNKNOWN_ACCEL * (0.1**3 / 3) ** 0.5, rtol=0.03)
    share = np.diag(covariance[POSITION, VELOCITY]) / (sigma[POSITION] * sigma[VELOCITY])
    np.testing.assert_allclose(share, 3**0.5 / 2, atol=0.02)


def test_an_error_of_the_tilt_is_no_acceleration():
    begun = start()
    tilted = NavEstimate(begun.nav, begun.covariance.at[ROTATION, ROTATION].set(0.01 * jnp.eye(3)))
    prior, _ = _predicted(PARAMS, tilted, jnp.zeros(3), scan(), jnp.array(False))
    covariance = np.asarray(prior.covariance)
    # by gravity it would be 1 m/s^2 for 0.1 rad, 0.1 m/s after the interval
    exact = np.asarray(_predicted(PARAMS, begun, jnp.zeros(3), scan(), jnp.array(False))[0].covariance)
    np.testing.assert_allclose(covariance[ROTATION, VELOCITY] - exact[ROTATION, VELOCITY], 0, atol=1e-9)


def test_a_state_is_carried_on_to_the_scans_end():
    nav = carried_on(start().nav, jnp.asarray(RATE), jnp.asarray(0.05))
    np.testing.assert_allclose(nav.T_world_imu.as_matrix(), moved(0.05), atol=1e-9)
    np.testing.assert_allclose(nav.velocity, moved(0.05)[:3, :3] @ SPEED, atol=1e-9)


def test_the_mean_rate_is_that_of_the_turn():
    nav = dataclasses.replace(start().nav, T_world_imu=jaxlie.SE3.from_matrix(jnp.asarray(moved(0.1))))
    np.testing.assert_allclose(mean_rate(start().nav, nav, scan()), RATE, atol=1e-6)
    np.testing.assert_array_equal(mean_rate(start().nav, nav, scan(interval=0.0)), 0)


def test_from_middle_to_middle():
    """Scans of different length: the interval counts from the last middle to this one."""
    middle = until_its_middle(scan(duration=0.08, interval=0.1), jnp.asarray(0.06))
    assert float(middle.duration) == pytest.approx(0.04)
    assert float(middle.interval) == pytest.approx(0.06 + 0.1 - 0.04)
