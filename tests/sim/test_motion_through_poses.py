"""Motions through given poses, and what no motion can be made of."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.trajectory import Trajectory
from lio_jax.sim.trajectory import motion_along, motion_through
from tests.sim.motions import motion_of, poses_at
from tests.sim.routes import LAP, WALK


def test_a_motion_meets_the_poses_it_was_given():
    times = np.cumsum(np.random.default_rng(1).uniform(0.03, 0.07, 100))
    poses = poses_at(motion_of("handheld"), times)
    motion = motion_through(Trajectory((times * 1e9).astype(np.int64), poses))
    np.testing.assert_allclose(
        poses_at(motion, (times * 1e9).astype(np.int64) * 1e-9 - times[0]), poses, atol=1e-7
    )
    assert float(motion.duration) == pytest.approx(times[-1] - times[0], abs=1e-8)
    # between the poses it is close to what they were taken from
    between = (times[10:-11] + times[11:-10]) / 2
    np.testing.assert_allclose(
        poses_at(motion, between - times[0]), poses_at(motion_of("handheld"), between), atol=2e-5
    )


def test_a_motion_through_poses_prefers_no_axis():
    times = np.arange(0, 3, 0.05)
    poses = poses_at(motion_of("handheld"), times + 5)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.4, -1.9, 1.1]).as_matrix()
    stamps = (times * 1e9).round().astype(np.int64)
    query = np.linspace(0, 2.9, 50)
    plain = poses_at(motion_through(Trajectory(stamps, poses)), query)
    turned = poses_at(motion_through(Trajectory(stamps, turn @ poses)), query)
    np.testing.assert_allclose(turned, turn @ plain, atol=1e-10)
    turned = poses_at(motion_through(Trajectory(stamps, poses @ turn)), query)
    np.testing.assert_allclose(turned, plain @ turn, atol=1e-10)


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
