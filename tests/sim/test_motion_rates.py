"""The motion is smooth to the third derivative, and its rates are exact."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.trajectory import PoseSpline, motion_through, pose_at
from tests.sim.motions import DURATION, motion_of, poses_at, states_at

MOTIONS = ["car", "handheld", "spline"]


@eqx.filter_jit
def _derivatives(motion, times):
    """Return the pose's seven numbers and their first four derivatives, (n, 5, 7)."""

    def differentiated(function):
        def orders(t):
            lower, rates = jax.jvp(function, (t,), (jnp.ones_like(t),))
            return jnp.concatenate([lower, rates[-1:]])

        return orders

    def orders(t):
        return pose_at(motion, t).wxyz_xyz[None]

    for _ in range(4):
        orders = differentiated(orders)
    return jax.vmap(orders)(times)


def _joints(motion):
    """Return the instants where pieces of the motion meet."""
    if isinstance(motion, PoseSpline):
        return np.asarray(motion.breaks[1:-1])
    standstill, pull_away = float(motion.standstill), float(motion.pull_away)
    phases = [standstill, standstill + pull_away]
    knots_at = eqx.filter_jit(jax.vmap(lambda t: motion._progress(t)[0]))
    dense = np.linspace(standstill + 1e-3, DURATION, 6001)
    passed = np.floor(np.asarray(knots_at(jnp.asarray(dense))))
    crossed = np.flatnonzero(np.diff(passed) != 0)
    low, high = dense[crossed], dense[crossed + 1]
    before = passed[crossed]
    for _ in range(40):
        middle = (low + high) / 2
        same = np.floor(np.asarray(knots_at(jnp.asarray(middle)))) == before
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    if not motion.closed:
        way = (motion.control.shape[0] - 6) / float(motion.knot_rate) + pull_away
        phases += [standstill + way - pull_away, standstill + way, standstill + way + pull_away]
    return np.concatenate([phases, low])


@pytest.mark.parametrize("name", MOTIONS)
def test_three_derivatives_are_continuous_where_pieces_meet(name):
    motion = motion_of(name)
    step = 1e-7
    joints = _joints(motion)
    assert len(joints) > 50
    before, after = (np.array(_derivatives(motion, jnp.asarray(joints + s * step))) for s in (-1, 1))
    assert np.all(np.isfinite(before))
    # q and -q are one rotation
    opposite = np.sum(before[:, 0, :4] * after[:, 0, :4], axis=1) < 0
    after[opposite, :, :4] *= -1
    for order in range(4):
        jump = np.abs(after - before)[:, order]
        slope = np.maximum(np.abs(after), np.abs(before))[:, order + 1]
        # what the next derivative explains, its own jump included, plus rounding
        rounding = 1e-9 * (1 + np.abs(before[:, order]).max())
        assert np.all(jump <= 2 * step * (slope + slope.max()) + rounding), f"derivative {order}"


@pytest.mark.parametrize("name", MOTIONS)
def test_rates_agree_with_finite_differences(name):
    motion = motion_of(name)
    times, step = np.linspace(1.1, 9.0, 60), 2e-4
    stencil = [poses_at(motion, times + k * step) for k in (-2, -1, 0, 1, 2)]
    positions = [poses[:, :3, 3] for poses in stencil]
    first = (positions[0] - 8 * positions[1] + 8 * positions[3] - positions[4]) / (12 * step)
    exact = states_at(motion, times)
    np.testing.assert_allclose(exact.velocity, first, atol=1e-7)
    velocities = [
        np.asarray(states_at(motion, jnp.asarray(times + k * step)).velocity) for k in (-2, -1, 1, 2)
    ]
    second = (velocities[0] - 8 * velocities[1] + 8 * velocities[2] - velocities[3]) / (12 * step)
    np.testing.assert_allclose(exact.acceleration, second, atol=2e-6)
    turned = [
        (
            Rotation.from_matrix(stencil[2 - k][:, :3, :3]).inv()
            * Rotation.from_matrix(stencil[2 + k][:, :3, :3])
        ).as_rotvec()
        / (2 * k * step)
        for k in (1, 2)
    ]
    np.testing.assert_allclose(exact.angular_velocity, (4 * turned[0] - turned[1]) / 3, atol=1e-6)
    np.testing.assert_allclose(exact.T_world_imu.as_matrix(), stencil[2], atol=1e-14)


@pytest.mark.parametrize("name", MOTIONS)
def test_rotations_are_proper(name):
    rotation = poses_at(motion_of(name), np.linspace(0.0, 9.0, 300))[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ rotation.transpose(0, 2, 1), np.tile(np.eye(3), (300, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1, atol=1e-12)


def test_a_circle_has_its_closed_form():
    rate, radius = 0.7, 5.0
    times = np.linspace(0, 10, 201)
    poses = np.tile(np.eye(4), (201, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(rate * times, [0, 0, 1])).as_matrix()
    poses[:, 0, 3], poses[:, 1, 3] = radius * np.sin(rate * times), -radius * np.cos(rate * times)
    motion = motion_through(Trajectory((times * 1e9).round().astype(np.int64), poses))
    query = np.linspace(1, 9, 77)
    exact = states_at(motion, jnp.asarray(query))
    body = Rotation.from_rotvec(np.outer(rate * query, [0, 0, 1])).inv()
    np.testing.assert_allclose(exact.angular_velocity, np.tile([0, 0, rate], (77, 1)), atol=1e-7)
    np.testing.assert_allclose(body.apply(exact.velocity), np.tile([rate * radius, 0, 0], (77, 1)), atol=1e-7)
    np.testing.assert_allclose(
        body.apply(exact.acceleration), np.tile([0, rate**2 * radius, 0], (77, 1)), atol=1e-5
    )
