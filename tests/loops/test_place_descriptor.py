"""A place is recognised among others, with the yaw and the side from which it is seen."""

import numpy as np
import pytest

from lio_jax.loops.place_descriptor import DescribedPlaces, polar_image
from tests.loops.places import keyframe, pillars, pose, seen_from

ANY = np.pi
REACH = 60.0


def compared(others, newest, points, heading_error=ANY, poses=None):
    """Compare a place with others, each ``(T_odom_imu, cloud)``; poses as odometry has them if not given."""
    places = DescribedPlaces(20, 60, REACH)
    every = [*others, (newest, points)]
    for index, (T_odom_imu, cloud) in enumerate(every):
        places.add(keyframe(index, T_odom_imu, cloud))
    poses = np.array([T for T, _ in every]) if poses is None else poses
    index = np.arange(len(others))
    return places.compared(poses, index, np.full(len(index), heading_error)), poses


def test_the_image_holds_the_highest_point_of_each_cell():
    points = np.array([[10.5, 0.1, 1.0], [10.6, 0.2, 3.0], [-0.1, 5.2, -9.0], [99.0, 0.0, 5.0]])
    image = polar_image(points, 60, 4, 60.0)
    assert image.shape == (60, 4)
    assert image[10, 0] == pytest.approx(5.5)
    assert np.count_nonzero(image) == 1


@pytest.mark.parametrize("turn", [0.0, 0.7, np.pi, -2.1])
def test_a_place_seen_again_is_the_most_alike_and_its_turn_is_found(turn):
    """The odometry believes to head along x at both times."""
    world = [pillars(seed) for seed in range(6)]
    others = [(pose(), seen_from(pose(), points)) for points in world]
    truth = pose(0.4, 0.3, yaw=turn)
    found, poses = compared(others, pose(), seen_from(truth, world[2]))
    best = int(np.argmin(found.distance))
    assert found.index[best] == 2
    assert found.distance[best] < 0.8 * np.min(np.delete(found.distance, best))
    guess = found.T_target_source(best, poses)
    missed = np.linalg.inv(truth) @ guess
    assert abs(np.arctan2(missed[1, 0], missed[0, 0])) < np.pi / 60 + 1e-6
    assert np.linalg.norm(missed[:3, 3]) < 1.0


@pytest.mark.parametrize("aside", [-4.0, 4.0])
def test_a_pass_in_another_lane_is_found_with_its_side(aside):
    world = [pillars(seed) for seed in range(6)]
    others = [(pose(), seen_from(pose(), points)) for points in world]
    truth = pose(0.0, aside, yaw=0.2)
    found, poses = compared(others, pose(), seen_from(truth, world[4]))
    best = int(np.argmin(found.distance))
    assert found.index[best] == 4
    np.testing.assert_allclose(found.T_target_source(best, poses)[:2, 3], [0.0, aside], atol=1.5)


def test_turns_beyond_the_odometrys_error_are_not_considered():
    points = pillars(0)
    others = [(pose(), seen_from(pose(), points))]
    free, _ = compared(others, pose(), seen_from(pose(yaw=1.5), points))
    bound, _ = compared(others, pose(), seen_from(pose(yaw=1.5), points), heading_error=0.5)
    assert abs(free.turn[0] - 1.5) < 0.06
    assert abs(bound.turn[0]) < 0.56
    assert bound.distance[0] > 1.3 * free.distance[0]


def test_corrections_since_the_places_were_described_count():
    """Odometry had the newest one's heading wrong by 0.6 rad; the corrected poses have not."""
    points = pillars(0)
    odometry = pose(yaw=0.6)
    found, poses = compared(
        [(pose(), seen_from(pose(), points))],
        odometry,
        seen_from(pose(), points),
        heading_error=0.2,
        poses=np.array([pose(), pose()]),
    )
    assert abs(found.turn[0]) < 0.06
    np.testing.assert_allclose(found.T_target_source(0, poses), np.eye(4), atol=0.06)


def test_many_places_are_narrowed_to_the_right_one():
    points = pillars(1)
    rng = np.random.default_rng(0)
    others = [(pose(), pillars(100 + k, 15).astype(np.float32)) for k in range(400)]
    place = int(rng.integers(400))
    others[place] = (pose(), seen_from(pose(), points))
    found, _ = compared(others, pose(), seen_from(pose(0.5, yaw=0.5), points))
    assert len(found.index) < 400
    assert found.index[np.argmin(found.distance)] == place
