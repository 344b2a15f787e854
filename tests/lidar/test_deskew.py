"""Constant-velocity motion compensation against the matrix exponential, point by point."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation, Slerp

from lio_jax.lidar.deskew import deskew_constant_velocity

DESKEW = jax.jit(deskew_constant_velocity)


def twist_matrix(twist: np.ndarray) -> np.ndarray:
    """Return the 4x4 matrix of (translation, rotation)."""
    (vx, vy, vz), (wx, wy, wz) = twist[:3], twist[3:]
    return np.array([[0, -wz, wy, vx], [wz, 0, -wx, vy], [-wy, wx, 0, vz], [0, 0, 0, 0]])


def by_expm(points, delay, twist) -> np.ndarray:
    """Return exp(delay * twist) p for each point, by scipy, in double precision."""
    moved = [
        (expm(t * twist_matrix(np.asarray(twist))) @ np.append(p, 1.0))[:3]
        for p, t in zip(np.asarray(points, float), np.asarray(delay, float), strict=True)
    ]
    return np.array(moved)


def sweep(count=60, seed=0):
    """Return points up to 100 m away and their delays around the middle of a 0.1 s sweep, in float32."""
    rng = np.random.default_rng(seed)
    points = jnp.asarray(rng.uniform(-60, 60, (count, 3)), jnp.float32)
    return points, jnp.asarray(rng.uniform(-0.05, 0.05, count), jnp.float32)


TWISTS = {
    "standing": [0, 0, 0, 0, 0, 0],
    "straight": [30, -2, 0.5, 0, 0, 0],
    "turning on the spot": [0, 0, 0, 0.1, -0.2, 1.5],
    "rate almost zero": [20, 1, 0, 1e-9, -1e-9, 1e-9],
    "below the series' bound": [20, 1, 0, 0.004, 0.003, -0.005],
    "at the series' bound": [20, 1, 0, 0.02, 0, 0],
    "above the series' bound": [20, 1, 0, 0.03, -0.02, 0.03],
    "car": [25, 0.1, -0.2, 0.02, 0.05, 0.6],
    "hand": [1.5, -1.0, 0.7, 3.0, -2.0, 4.0],
    "more than half a turn within the sweep": [5, 5, 5, 30, 40, -60],
}


@pytest.mark.parametrize("name", TWISTS)
def test_every_point_moves_as_the_matrix_exponential_says(name):
    points, delay = sweep()
    twist = np.array(TWISTS[name], float)
    found = np.asarray(DESKEW(points, delay, jnp.asarray(twist)))
    assert found.dtype == np.float32
    # float32 holds 60 m to 4e-6 m; the angle of the fastest twist is rounded too
    np.testing.assert_allclose(found, by_expm(points, delay, twist), atol=6e-5)


@pytest.mark.parametrize("angle", [0.9e-3, 0.999e-3, 1.001e-3, 1.1e-3, 5e-3])
def test_series_and_closed_form_meet(angle):
    points, _ = sweep()
    delay = np.full(len(points), 0.1, np.float32)
    twist = np.concatenate([[40.0, -30.0, 20.0], np.array([2, -1, 2]) / 3 * angle / 0.1])
    # 54 m/s: right above the bound 1 - cos has few digits left
    np.testing.assert_allclose(
        DESKEW(points, delay, jnp.asarray(twist)), by_expm(points, delay, twist), atol=6e-5
    )


def test_no_delay_no_motion():
    points, _ = sweep()
    twist = jnp.asarray(TWISTS["hand"], jnp.float64)
    np.testing.assert_array_equal(DESKEW(points, np.zeros(len(points), np.float32), twist), points)


def test_a_wall_seen_from_a_turning_sensor_becomes_straight():
    """Poses by interpolation, not by an exponential: the sensor turns at 2 rad/s about its own axis."""
    delay = np.linspace(-0.05, 0.05, 41).astype(np.float32)
    turns = Slerp([-0.1, 0.1], Rotation.from_euler("z", [[-0.2], [0.2]]))(delay.astype(float))
    wall = np.stack([np.full(41, 20.0), np.linspace(-10, 10, 41), np.zeros(41)], -1)
    measured = turns.inv().apply(wall).astype(np.float32)
    twist = jnp.asarray([0, 0, 0, 0, 0, 2.0], jnp.float64)
    np.testing.assert_allclose(DESKEW(measured, delay, twist), wall, atol=2e-5)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivative_at_rest_is_finite_and_known(derivative):
    points, delay = sweep(10)
    jacobian = np.asarray(
        derivative(lambda twist: deskew_constant_velocity(points, delay, twist))(jnp.zeros(6))
    )
    expected = np.zeros((10, 3, 6))
    for row, (p, t) in enumerate(zip(points, delay, strict=True)):
        expected[row, :, :3] = t * np.eye(3)
        expected[row, :, 3:] = t * np.cross(np.eye(3), p).T
    assert np.isfinite(jacobian).all()
    np.testing.assert_allclose(jacobian, expected, atol=1e-5)


@pytest.mark.parametrize("name", ["straight", "rate almost zero", "at the series' bound", "car", "hand"])
def test_derivative_is_that_of_the_matrix_exponential(name):
    points, delay = sweep(10)
    twist = np.array(TWISTS[name], float)
    jacobian = np.asarray(
        jax.jacfwd(lambda twist: deskew_constant_velocity(points, delay, twist))(jnp.asarray(twist))
    )
    step = 1e-4
    for axis in range(6):
        change = step * np.eye(6)[axis]
        slope = (by_expm(points, delay, twist + change) - by_expm(points, delay, twist - change)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., axis], slope, atol=2e-4)
