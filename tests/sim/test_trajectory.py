"""The drive: smooth to the third derivative, standing first, on a closed path with turns."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.sim.street import street
from lio_jax.sim.trajectory import pose_at


@pytest.fixture(scope="module")
def drive():
    return street(0)[1]


@cache
def _compiled(order):
    def function(time, drive):
        return pose_at(drive, time).as_matrix()[:3].ravel()

    for _ in range(order):
        function = jax.jacfwd(function)
    return jax.jit(jax.vmap(function, in_axes=(0, None)))


def _derivatives(drive, times, order):
    """Return the twelve numbers of the pose matrix, differentiated ``order`` times."""
    return np.asarray(_compiled(order)(jnp.asarray(times), drive))


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_derivatives_are_continuous_across_knots_and_phases(drive, order):
    knot = 1.0 / float(drive.knot_rate)
    pulled_away = float(drive.standstill + drive.pull_away)
    # at full speed a control point is passed every 1/knot_rate from the moment pulling away ends
    phase = 0.5 * float(drive.pull_away) * float(drive.knot_rate) % 1.0
    knots = pulled_away + (np.arange(1, 60) - phase) * knot
    instants = np.concatenate([[float(drive.standstill), pulled_away], knots])
    step = 1e-6
    before, after = (_derivatives(drive, instants + sign * step, order) for sign in (-1, 1))
    dense = np.linspace(0, 30, 6001)
    slope = np.abs(np.diff(_derivatives(drive, dense, order), axis=0)).max() / (dense[1] - dense[0])
    assert np.all(np.isfinite(before))
    assert np.abs(after - before).max() < 4 * step * slope + 1e-9


@pytest.mark.parametrize("order", [0, 1])
def test_derivatives_agree_with_finite_differences(drive, order):
    times = np.linspace(1.6, 20.0, 50)
    step = 1e-5
    low, high = (_derivatives(drive, times + sign * step, order) for sign in (-1, 1))
    exact = _derivatives(drive, times, order + 1)
    np.testing.assert_allclose(exact, (high - low) / (2 * step), atol=1e-6 * max(1, np.abs(exact).max()))


def test_rotations_are_proper_and_the_start_is_the_origin(drive):
    poses = np.asarray(jax.vmap(lambda time: pose_at(drive, time).as_matrix())(jnp.linspace(0.0, 200.0, 400)))
    rotation = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (400, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)


def test_stands_then_drives_like_a_car(drive):
    times = np.linspace(0, 120, 6001)
    pose, velocity, acceleration = (_derivatives(drive, times, order).reshape(-1, 3, 4) for order in range(3))
    speed = np.linalg.norm(velocity[:, :2, 3], axis=1)
    standing = times <= float(drive.standstill)
    assert standing.sum() > 50
    assert np.all(pose[standing] == pose[0])
    assert np.all(speed[times > 6] > 3.5)
    assert speed.max() < 8.0
    assert np.linalg.norm(acceleration[:, :, 3], axis=1).max() < 3.5
    forward = pose[:, :2, 0]
    slip = np.abs(forward[:, 0] * velocity[:, 1, 3] - forward[:, 1] * velocity[:, 0, 3])
    assert slip.max() < 0.01


def test_turns_within_the_first_ten_seconds_and_comes_back(drive):
    poses = np.asarray(jax.vmap(lambda time: pose_at(drive, time).as_matrix())(jnp.arange(0.0, 120.0, 0.1)))
    yaw = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    assert yaw[100] > np.deg2rad(60)
    assert np.diff(yaw).min() < -0.01  # a right turn, too
    lap = 10 + np.argmin(np.linalg.norm(poses[200:, :2, 3], axis=1)) + 190
    assert np.linalg.norm(poses[lap, :2, 3]) < 0.5
    assert abs(yaw[lap] - 2 * np.pi) < 0.02
