"""The motion: smooth to the third derivative, exact rates, bodies that behave like what they are."""

from dataclasses import replace
from functools import cache
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import welch
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.imu import GRAVITY
from lio_jax.sim.trajectory import (
    PoseSpline,
    RouteMotion,
    kinematics_at,
    motion_along,
    motion_through,
    pose_at,
)
from tests.sim.routes import FLIGHT, LAP, WALK

DURATION = 60.0


@cache
def _motion(name):
    if name == "car":
        return motion_along(LAP, duration_s=DURATION, standstill_s=1.5, seed=1)
    if name == "handheld":
        return motion_along(WALK, duration_s=DURATION, standstill_s=1.0, seed=2)
    if name == "drone":
        return motion_along(FLIGHT, duration_s=DURATION, seed=3)
    times = np.cumsum(np.random.default_rng(0).uniform(0.03, 0.07, 200))
    return motion_through(Trajectory((times * 1e9).astype(np.int64), _poses(_motion("handheld"), times)))


MOTIONS = ["car", "handheld", "spline"]

_compiled_poses = eqx.filter_jit(jax.vmap(lambda motion, t: pose_at(motion, t).as_matrix(), (None, 0)))
_compiled_kinematics = eqx.filter_jit(jax.vmap(kinematics_at, (None, 0)))


def _kinematics(motion, times):
    """Return the states at up to 4000 instants, always by the same program."""
    states = _compiled_kinematics(motion, jnp.asarray(np.resize(times, 4000)))
    return jax.tree.map(lambda leaf: np.array(leaf[: len(times)]), states)


def _poses(motion, times):
    return np.asarray(_compiled_poses(motion, jnp.asarray(np.resize(times, 3001)))[: len(times)])


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
    motion = _motion(name)
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
    motion = _motion(name)
    times, step = np.linspace(1.1, 9.0, 60), 2e-4
    stencil = [_poses(motion, times + k * step) for k in (-2, -1, 0, 1, 2)]
    positions = [poses[:, :3, 3] for poses in stencil]
    first = (positions[0] - 8 * positions[1] + 8 * positions[3] - positions[4]) / (12 * step)
    exact = _kinematics(motion, times)
    np.testing.assert_allclose(exact.velocity, first, atol=1e-7)
    velocities = [
        np.asarray(_kinematics(motion, jnp.asarray(times + k * step)).velocity) for k in (-2, -1, 1, 2)
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
    rotation = _poses(_motion(name), np.linspace(0.0, 9.0, 300))[:, :3, :3]
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
    exact = _kinematics(motion, jnp.asarray(query))
    body = Rotation.from_rotvec(np.outer(rate * query, [0, 0, 1])).inv()
    np.testing.assert_allclose(exact.angular_velocity, np.tile([0, 0, rate], (77, 1)), atol=1e-7)
    np.testing.assert_allclose(body.apply(exact.velocity), np.tile([rate * radius, 0, 0], (77, 1)), atol=1e-7)
    np.testing.assert_allclose(
        body.apply(exact.acceleration), np.tile([0, rate**2 * radius, 0], (77, 1)), atol=1e-5
    )


@pytest.mark.parametrize("name", ["car", "handheld"])
def test_stands_exactly_still_first(name):
    motion = _motion(name)
    poses = _poses(motion, np.linspace(0, float(motion.standstill), 50))
    assert np.all(poses == poses[0])
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)


def test_a_moving_start_is_at_full_speed_at_once():
    motion = motion_along(LAP, duration_s=5.0, moving_start=True)
    start = _kinematics(motion, np.zeros(1))
    assert np.linalg.norm(start.velocity[0, :2]) == pytest.approx(LAP.speed, rel=2e-3)
    assert np.linalg.norm(start.acceleration[0, :2]) < 0.05


def test_a_car_drives_like_one():
    motion = _motion("car")
    times = np.linspace(0, DURATION, 3001)
    state = _kinematics(motion, times)
    speed = np.linalg.norm(state.velocity, axis=1)
    assert speed.max() < LAP.speed * 1.01
    assert 3.5 < speed[times > 6].min() < 4.2  # sqrt(1.75 m/s^2 * 9 m) = 3.97
    assert np.linalg.norm(state.acceleration, axis=1).max() < 3.5
    forward = np.asarray(state.T_world_imu.as_matrix())[:, :3, 0]
    slip = forward[:, 0] * state.velocity[:, 1] - forward[:, 1] * state.velocity[:, 0]
    assert np.abs(slip).max() < 0.01


def test_a_car_pitches_with_the_ramp():
    still = _still(_motion("car"))
    times = np.linspace(5, DURATION, 1000)
    forward = _poses(still, times)[:, :3, 0]
    velocity = np.asarray(_kinematics(still, jnp.asarray(times)).velocity)
    np.testing.assert_allclose(forward, velocity / np.linalg.norm(velocity, axis=1)[:, None], atol=1e-9)
    assert np.degrees(np.arcsin(forward[:, 2].max())) == pytest.approx(np.degrees(np.arctan(2 / 40)), abs=0.1)


def test_a_lap_comes_back():
    motion = _still(_motion("car"))
    lap = motion.control.shape[0] / float(motion.knot_rate)
    np.testing.assert_allclose(_poses(motion, [9.0 + lap]), _poses(motion, [9.0]), atol=1e-9)


def test_an_open_route_is_gone_back_facing_the_same_way():
    motion = _still(_motion("handheld"))
    start, way = float(motion.standstill), _way(motion)
    there = np.linspace(0, way, 97)
    poses = _poses(motion, start + there)
    np.testing.assert_allclose(_poses(motion, start + 2 * way - there), poses, atol=1e-9)
    np.testing.assert_allclose(_poses(motion, start + 2 * way + there), poses, atol=1e-9)
    np.testing.assert_allclose(poses[0, :3, 3], WALK.points[0], atol=1e-9)
    np.testing.assert_allclose(poses[-1, :3, 3], WALK.points[-1], atol=1e-9)
    ends = _kinematics(motion, jnp.asarray([start, start + way, start + 2 * way]))
    np.testing.assert_allclose(ends.velocity, 0, atol=1e-9)
    np.testing.assert_allclose(ends.acceleration, 0, atol=1e-9)


def test_a_way_too_short_for_full_speed_is_gone_more_slowly():
    route = replace(WALK, points=np.array([[0, 0, 0], [0.5, 0, 0.0]]))
    motion = _still(motion_along(route, duration_s=10.0))
    along = _poses(motion, np.linspace(0.0, 10.0, 2001))[:, 0, 3]
    speed = np.diff(along) / 0.005
    assert 0.2 < speed.max() < 0.9 * route.speed
    assert along.max() == pytest.approx(0.5, abs=1e-4)
    assert along[-1] < 0.5


@pytest.mark.parametrize("name", ["car", "handheld", "drone"])
def test_the_path_stays_by_its_route(name):
    route = {"car": LAP, "handheld": WALK, "drone": FLIGHT}[name]
    positions = _poses(_still(_motion(name)), np.linspace(0, DURATION, 3001))[:, :3, 3]
    corners = np.vstack([route.points, route.points[:1]]) if route.closed else route.points
    gap = np.full(len(positions), np.inf)
    for start, end in pairwise(corners):
        along = np.clip((positions - start) @ (end - start) / np.sum((end - start) ** 2), 0, 1)
        gap = np.minimum(gap, np.linalg.norm(positions - start - along[:, None] * (end - start), axis=1))
    # a rounded right angle leaves its vertex by (sqrt(2) - 1) radii, hence both of its sides by 0.293
    assert 0.2 * route.radius < gap.max() < 0.32 * route.radius


def test_walking_bounces_at_the_step_frequency():
    times = np.arange(20, 60, 0.01)
    acceleration = np.asarray(_kinematics(_motion("handheld"), jnp.asarray(times)).acceleration)[:, 2]
    frequency, power = welch(acceleration, 100, nperseg=1000)
    assert frequency[np.argmax(power)] == pytest.approx(1.9, abs=0.15)
    assert 1.0 < np.abs(acceleration).max() < 5.0


def test_a_hand_turns_as_fast_as_asked():
    motion = motion_along(WALK, duration_s=DURATION, swing_rate=4.0)
    rate = np.linalg.norm(_kinematics(motion, np.linspace(2.0, 200.0, 4000)).angular_velocity, axis=1)
    assert 3.3 < rate.max() < 5.0
    calm = motion_along(WALK, duration_s=DURATION, swing_rate=0.0)
    rate = np.linalg.norm(_kinematics(calm, np.linspace(2.0, 200.0, 4000)).angular_velocity, axis=1)
    assert rate.max() < 1.6  # corners at 0.89 m/s and 0.8 m


def test_a_drone_banks_into_its_turns():
    banked = _still(_motion("drone"))
    level = eqx.tree_at(lambda m: m.control, banked, banked.control.at[:, 3].set(0))
    sideways = []
    for motion in (banked, level):
        state = _kinematics(motion, np.linspace(4.0, 55.0, 1000))
        felt = np.asarray(state.acceleration) - GRAVITY
        rotation = np.asarray(state.T_world_imu.as_matrix())[:, :3, :3]
        sideways.append(np.einsum("nij,ni->nj", rotation, felt)[:, 1])
    assert np.abs(sideways[1]).max() > 1.5
    assert np.sqrt(np.mean(sideways[0] ** 2)) < 0.5 * np.sqrt(np.mean(sideways[1] ** 2))


def test_a_drone_shakes_by_tens_of_hertz():
    times = np.arange(10, 18, 0.002)
    state = _kinematics(_motion("drone"), jnp.asarray(times))
    frequency, power = welch(np.asarray(state.acceleration)[:, 2], 500, nperseg=1000)
    shaking = np.sum(power[frequency > 20]) * frequency[1]
    assert 0.2 < np.sqrt(shaking) < 1.0
    assert 30 < frequency[20:][np.argmax(power[20:])] < 80


def test_the_seed_decides_the_sway():
    times = [20.0]
    same, again, other = (motion_along(WALK, duration_s=30.0, seed=seed) for seed in (5, 5, 6))
    assert np.all(_poses(same, times) == _poses(again, times))
    assert np.abs(_poses(same, times) - _poses(other, times)).max() > 1e-3


def test_motions_are_float64_whatever_the_mode():
    with jax.enable_x64(False):
        single = motion_along(WALK, duration_s=DURATION, standstill_s=1.0, seed=2)
    for leaf, expected in zip(jax.tree.leaves(single), jax.tree.leaves(_motion("handheld")), strict=True):
        assert leaf.dtype == np.float64
        np.testing.assert_array_equal(leaf, expected)


def test_a_motion_meets_the_poses_it_was_given():
    times = np.cumsum(np.random.default_rng(1).uniform(0.03, 0.07, 100))
    poses = _poses(_motion("handheld"), times)
    motion = motion_through(Trajectory((times * 1e9).astype(np.int64), poses))
    np.testing.assert_allclose(
        _poses(motion, (times * 1e9).astype(np.int64) * 1e-9 - times[0]), poses, atol=1e-7
    )
    assert float(motion.duration) == pytest.approx(times[-1] - times[0], abs=1e-8)
    # between the poses it is close to what they were taken from
    between = (times[10:-11] + times[11:-10]) / 2
    np.testing.assert_allclose(
        _poses(motion, between - times[0]), _poses(_motion("handheld"), between), atol=2e-5
    )


def test_a_motion_through_poses_prefers_no_axis():
    times = np.arange(0, 3, 0.05)
    poses = _poses(_motion("handheld"), times + 5)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.4, -1.9, 1.1]).as_matrix()
    stamps = (times * 1e9).round().astype(np.int64)
    query = np.linspace(0, 2.9, 50)
    plain = _poses(motion_through(Trajectory(stamps, poses)), query)
    turned = _poses(motion_through(Trajectory(stamps, turn @ poses)), query)
    np.testing.assert_allclose(turned, turn @ plain, atol=1e-10)
    turned = _poses(motion_through(Trajectory(stamps, poses @ turn)), query)
    np.testing.assert_allclose(turned, plain @ turn, atol=1e-10)


def _way(motion: RouteMotion) -> float:
    return (motion.control.shape[0] - 6) / float(motion.knot_rate) + float(motion.pull_away)


def _still(motion: RouteMotion) -> RouteMotion:
    """Return the same motion without sway."""
    return eqx.tree_at(lambda m: m.sway.amplitude, motion, 0 * motion.sway.amplitude)


def _line(count):
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = np.arange(count)
    return Trajectory(np.arange(count) * 100_000_000, poses)


def test_too_few_poses_are_refused():
    with pytest.raises(LioJaxError, match="5 poses; a smooth motion needs at least 6"):
        motion_through(_line(5))


def test_poses_out_of_order_are_refused():
    line = _line(8)
    line.stamp_ns[3] = line.stamp_ns[2]
    with pytest.raises(LioJaxError, match="time does not ascend at pose 3"):
        motion_through(line)


def test_poses_that_are_not_finite_are_refused():
    line = _line(8)
    line.poses[4, 1, 3] = np.nan
    with pytest.raises(LioJaxError, match="pose 4 holds numbers that are not finite"):
        motion_through(line)


def test_poses_too_far_turned_are_refused():
    line = _line(8)
    line.poses[5, :3, :3] = np.diag([-1.0, -1.0, 1.0])
    with pytest.raises(LioJaxError, match="pose 5 is turned by 180 degrees"):
        motion_through(line)


def test_no_duration_is_refused():
    with pytest.raises(UsageError, match="duration of 0 s holds nothing"):
        motion_along(LAP, duration_s=0)


def test_a_negative_standstill_is_refused():
    with pytest.raises(UsageError, match="standstill of -1 s"):
        motion_along(LAP, duration_s=1.0, standstill_s=-1)


def test_a_moving_start_that_stands_still_is_refused():
    with pytest.raises(UsageError, match="contradicts a moving start"):
        motion_along(LAP, duration_s=1.0, standstill_s=1.0, moving_start=True)


def test_an_impossible_swing_rate_is_refused():
    with pytest.raises(UsageError, match="swing rate of -1 rad/s"):
        motion_along(WALK, duration_s=1.0, swing_rate=-1)


def test_a_route_of_one_point_is_refused():
    with pytest.raises(UsageError, match="at least 2 points"):
        motion_along(replace(WALK, points=np.zeros((1, 3))), duration_s=1.0)


def test_a_route_that_turns_on_the_spot_is_refused():
    points = np.array([[0, 0, 0], [5, 0, 0], [1, 0, 0.0]])
    with pytest.raises(UsageError, match="turns back on itself at point 1"):
        motion_along(replace(WALK, points=points), duration_s=1.0)


def test_an_upright_route_is_refused():
    points = np.array([[0, 0, 0], [5, 0, 0], [5, 0, 3.0]])
    with pytest.raises(UsageError, match="from point 1 to the next the route is upright"):
        motion_along(replace(WALK, points=points), duration_s=1.0)


def test_a_route_without_speed_is_refused():
    with pytest.raises(UsageError, match="both must be greater than zero"):
        motion_along(replace(WALK, speed=0.0), duration_s=1.0)
