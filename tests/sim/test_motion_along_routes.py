"""Bodies that behave like what they are: cars, walkers and drones on their routes."""

from dataclasses import replace
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import welch

from lio_jax.sim.imu import GRAVITY
from lio_jax.sim.trajectory import motion_along
from tests.sim.motions import DURATION, motion_of, poses_at, states_at, way_time, without_sway
from tests.sim.routes import FLIGHT, LAP, WALK


@pytest.mark.parametrize("name", ["car", "handheld"])
def test_stands_exactly_still_first(name):
    motion = motion_of(name)
    poses = poses_at(motion, np.linspace(0, float(motion.standstill), 50))
    assert np.all(poses == poses[0])
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-9)


def test_a_moving_start_is_at_full_speed_at_once():
    motion = motion_along(LAP, duration_s=5.0, moving_start=True)
    start = states_at(motion, np.zeros(1))
    assert np.linalg.norm(start.velocity[0, :2]) == pytest.approx(LAP.speed, rel=2e-3)
    assert np.linalg.norm(start.acceleration[0, :2]) < 0.05


def test_a_car_drives_like_one():
    motion = motion_of("car")
    times = np.linspace(0, DURATION, 3001)
    state = states_at(motion, times)
    speed = np.linalg.norm(state.velocity, axis=1)
    assert speed.max() < LAP.speed * 1.01
    assert 3.5 < speed[times > 6].min() < 4.2  # sqrt(1.75 m/s^2 * 9 m) = 3.97
    assert np.linalg.norm(state.acceleration, axis=1).max() < 3.5
    forward = np.asarray(state.T_world_imu.as_matrix())[:, :3, 0]
    slip = forward[:, 0] * state.velocity[:, 1] - forward[:, 1] * state.velocity[:, 0]
    assert np.abs(slip).max() < 0.01


def test_a_car_pitches_with_the_ramp():
    still = without_sway(motion_of("car"))
    times = np.linspace(5, DURATION, 1000)
    forward = poses_at(still, times)[:, :3, 0]
    velocity = np.asarray(states_at(still, jnp.asarray(times)).velocity)
    np.testing.assert_allclose(forward, velocity / np.linalg.norm(velocity, axis=1)[:, None], atol=1e-9)
    assert np.degrees(np.arcsin(forward[:, 2].max())) == pytest.approx(np.degrees(np.arctan(2 / 40)), abs=0.1)


def test_a_lap_comes_back():
    motion = without_sway(motion_of("car"))
    lap = motion.control.shape[0] / float(motion.knot_rate)
    np.testing.assert_allclose(poses_at(motion, [9.0 + lap]), poses_at(motion, [9.0]), atol=1e-9)


def test_an_open_route_is_gone_back_facing_the_same_way():
    motion = without_sway(motion_of("handheld"))
    start, way = float(motion.standstill), way_time(motion)
    there = np.linspace(0, way, 97)
    poses = poses_at(motion, start + there)
    np.testing.assert_allclose(poses_at(motion, start + 2 * way - there), poses, atol=1e-9)
    np.testing.assert_allclose(poses_at(motion, start + 2 * way + there), poses, atol=1e-9)
    np.testing.assert_allclose(poses[0, :3, 3], WALK.points[0], atol=1e-9)
    np.testing.assert_allclose(poses[-1, :3, 3], WALK.points[-1], atol=1e-9)
    ends = states_at(motion, jnp.asarray([start, start + way, start + 2 * way]))
    np.testing.assert_allclose(ends.velocity, 0, atol=1e-9)
    np.testing.assert_allclose(ends.acceleration, 0, atol=1e-9)


def test_a_way_too_short_for_full_speed_is_gone_more_slowly():
    route = replace(WALK, points=np.array([[0, 0, 0], [0.5, 0, 0.0]]))
    motion = without_sway(motion_along(route, duration_s=10.0))
    along = poses_at(motion, np.linspace(0.0, 10.0, 2001))[:, 0, 3]
    speed = np.diff(along) / 0.005
    assert 0.2 < speed.max() < 0.9 * route.speed
    assert along.max() == pytest.approx(0.5, abs=1e-4)
    assert along[-1] < 0.5


@pytest.mark.parametrize("name", ["car", "handheld", "drone"])
def test_the_path_stays_by_its_route(name):
    route = {"car": LAP, "handheld": WALK, "drone": FLIGHT}[name]
    positions = poses_at(without_sway(motion_of(name)), np.linspace(0, DURATION, 3001))[:, :3, 3]
    corners = np.vstack([route.points, route.points[:1]]) if route.closed else route.points
    gap = np.full(len(positions), np.inf)
    for start, end in pairwise(corners):
        along = np.clip((positions - start) @ (end - start) / np.sum((end - start) ** 2), 0, 1)
        gap = np.minimum(gap, np.linalg.norm(positions - start - along[:, None] * (end - start), axis=1))
    # a rounded right angle leaves its vertex by (sqrt(2) - 1) radii, hence both of its sides by 0.293
    assert 0.2 * route.radius < gap.max() < 0.32 * route.radius


def test_walking_bounces_at_the_step_frequency():
    times = np.arange(20, 60, 0.01)
    acceleration = np.asarray(states_at(motion_of("handheld"), jnp.asarray(times)).acceleration)[:, 2]
    frequency, power = welch(acceleration, 100, nperseg=1000)
    assert frequency[np.argmax(power)] == pytest.approx(1.9, abs=0.15)
    assert 1.0 < np.abs(acceleration).max() < 5.0


def test_a_hand_turns_as_fast_as_asked():
    motion = motion_along(WALK, duration_s=DURATION, swing_rate=4.0)
    rate = np.linalg.norm(states_at(motion, np.linspace(2.0, 200.0, 4000)).angular_velocity, axis=1)
    assert 3.3 < rate.max() < 5.0
    calm = motion_along(WALK, duration_s=DURATION, swing_rate=0.0)
    rate = np.linalg.norm(states_at(calm, np.linspace(2.0, 200.0, 4000)).angular_velocity, axis=1)
    assert rate.max() < 1.6  # corners at 0.89 m/s and 0.8 m


def test_a_drone_banks_into_its_turns():
    banked = without_sway(motion_of("drone"))
    level = eqx.tree_at(lambda m: m.control, banked, banked.control.at[:, 3].set(0))
    sideways = []
    for motion in (banked, level):
        state = states_at(motion, np.linspace(4.0, 55.0, 1000))
        felt = np.asarray(state.acceleration) - GRAVITY
        rotation = np.asarray(state.T_world_imu.as_matrix())[:, :3, :3]
        sideways.append(np.einsum("nij,ni->nj", rotation, felt)[:, 1])
    assert np.abs(sideways[1]).max() > 1.5
    assert np.sqrt(np.mean(sideways[0] ** 2)) < 0.5 * np.sqrt(np.mean(sideways[1] ** 2))


def test_a_drone_shakes_by_tens_of_hertz():
    times = np.arange(10, 18, 0.002)
    state = states_at(motion_of("drone"), jnp.asarray(times))
    frequency, power = welch(np.asarray(state.acceleration)[:, 2], 500, nperseg=1000)
    shaking = np.sum(power[frequency > 20]) * frequency[1]
    assert 0.2 < np.sqrt(shaking) < 1.0
    assert 30 < frequency[20:][np.argmax(power[20:])] < 80


def test_the_seed_decides_the_sway():
    times = [20.0]
    same, again, other = (motion_along(WALK, duration_s=30.0, seed=seed) for seed in (5, 5, 6))
    assert np.all(poses_at(same, times) == poses_at(again, times))
    assert np.abs(poses_at(same, times) - poses_at(other, times)).max() > 1e-3


def test_motions_are_float64_in_both_modes():
    with jax.enable_x64(False):
        single = motion_along(WALK, duration_s=DURATION, standstill_s=1.0, seed=2)
    for leaf, expected in zip(jax.tree.leaves(single), jax.tree.leaves(motion_of("handheld")), strict=True):
        assert leaf.dtype == np.float64
        np.testing.assert_array_equal(leaf, expected)
