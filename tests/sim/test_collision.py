"""A motion that runs into something is refused, with the time and the place."""

import re
from itertools import pairwise

import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.data.trajectory import Trajectory, pose_matrices
from lio_jax.sim.assembly import Traffic, assembled, upright
from lio_jax.sim.collision import CLEARANCE, STEP, check_clear
from lio_jax.sim.open_worlds import SIZE, START
from lio_jax.sim.sequence import SimulatedSequence

DURATION = 10.0
TIMES = np.arange(0, DURATION, STEP)


def _straight(speed, start=(0.0, 0.0, 0.0)):
    """Return positions along +x, m."""
    return np.asarray(start) + np.outer(speed * TIMES, [1.0, 0.0, 0.0])


def _found(world, positions):
    """Return time (s) and place (m) that the error names."""
    with pytest.raises(UsageError, match="runs into a surface") as error:
        check_clear(world, TIMES, positions)
    numbers = re.findall(r"-?\d+\.\d+", str(error.value))
    return float(numbers[0]), np.array(numbers[1:4], float)


def _world(**shapes):
    """Return a world with the shapes and, so that all tests share one program, one far one of each kind."""
    far = {
        "boxes": upright([500, 500, 0], [501, 501, 1], 0.5),
        "cylinders": [[500.0, 0.0, 0.0, 1.0, 1.0, 0.5]],
        "spheres": [[500.0, 9.0, 0.0, 1.0, 0.5]],
    }
    rows = {
        kind: np.vstack([row, shapes.pop(kind, np.empty((0, np.shape(row)[1])))]) for kind, row in far.items()
    }
    return assembled([0.0, 0.0, 0.0], planes=[[0, 0, -1.5, 0, 0, 1, 0.2]], **rows, **shapes)


def test_free_motions_pass():
    check_clear(_world(), TIMES, _straight(5.0))
    check_clear(_world(), TIMES, _straight(0.0))


def test_a_wall_across_the_way_stops_it_just_before():
    wall = upright([20.0, -5, -2], [20.3, 5, 3], 0.5)
    time, place = _found(_world(boxes=wall), _straight(5.0))
    np.testing.assert_allclose(place[0], 5.0 * time, atol=0.01)
    assert 20.0 - CLEARANCE - 5.0 * STEP < place[0] <= 20.0


def test_a_thin_wall_is_not_jumped_over_at_speed():
    thin = upright([20.13, -5, -2], [20.131, 5, 3], 0.5)
    time, place = _found(_world(boxes=thin), _straight(25.0))
    assert place[0] <= 20.13 < 25.0 * (time + STEP)


@pytest.mark.parametrize(
    "shape",
    [
        {"cylinders": [[12.0, 0.03, -1.5, 0.05, 4.0, 0.5]]},
        {"spheres": [[12.0, 0.3, 0.2, 0.4, 0.5]]},
    ],
    ids=["pole", "ball"],
)
def test_a_pole_or_ball_in_the_way(shape):
    _, place = _found(_world(**shape), _straight(4.0))
    assert 11.0 < place[0] < 12.0


@pytest.mark.parametrize(("gap", "touches"), [(CLEARANCE - 0.05, True), (CLEARANCE + 0.05, False)])
def test_a_wall_beside_the_way_has_to_keep_clear(gap, touches):
    world = _world(boxes=upright([-5, gap, -2], [90, gap + 1, 3], 0.5))
    if touches:
        assert _found(world, _straight(2.0))[0] == 0.0
    else:
        check_clear(world, TIMES, _straight(2.0))


def test_the_ground_has_to_keep_clear():
    _, place = _found(_world(), _straight(2.0) - np.outer(0.2 * TIMES, [0, 0, 1]))
    assert -1.5 <= place[2] < -1.5 + CLEARANCE + 0.02


def test_a_car_that_comes_along_is_run_into_when_it_is_there():
    # from (30, 20) to (30, -20) in 8 s and back
    path = np.array([[[30.0, 20, -0.5], [30, 10, -0.5], [30, 0, -0.5], [30, -10, -0.5], [30, -20, -0.5]]])
    path = np.concatenate([path, path[:, -2:0:-1]], axis=1)
    traffic = Traffic(
        path=path,
        yaw=np.zeros(path.shape[:2]),
        period=np.array([16.0]),
        body=np.array([0]),
        boxes=np.array([[0.0, 0, 0, 1, 1, 1, 0, 0.5]]),
    )
    time, place = _found(_world(traffic=traffic), np.tile([30.0, -5.0, 0.0], (len(TIMES), 1)))
    # its front is a metre ahead of its middle, which passes y = -5 at 5 s with 5 m/s
    assert time == pytest.approx(5.0 - (1.0 + CLEARANCE) / 5.0, abs=2 * STEP)
    np.testing.assert_allclose(place, [30, -5, 0])


def test_a_second_call_worth_of_positions_is_checked_too():
    times = np.arange(0, 60, STEP)
    positions = np.outer(0.5 * times, [1.0, 0.0, 0.0])
    world = _world(boxes=upright([25.0, -5, -2], [26, 5, 3], 0.5))
    with pytest.raises(UsageError, match=r"4[89]\.\d+ s after its start, at \(24\."):
        check_clear(world, times, positions)


def test_nothing_to_check():
    check_clear(_world(), np.empty(0), np.empty((0, 3)))


def _walk(*places, speed=1.0):
    """Return a trajectory in straight lines between places of the room, builder's frame, m."""
    points = [np.asarray(places[0], float)]
    for start, end in pairwise(np.asarray(places, float)):
        steps = max(2, int(np.linalg.norm(end - start) / (0.1 * speed)))
        points += [start + share * (end - start) for share in np.arange(1, steps + 1) / steps]
    positions = np.array(points) - START
    stamps = (np.arange(len(points)) * 100_000_000).astype(np.int64)
    return Trajectory(stamps, pose_matrices(positions, np.tile([0.0, 0, 0, 1], (len(points), 1))))


def test_a_users_trajectory_through_the_rooms_wall_is_refused():
    half = SIZE[0] / 2
    with pytest.raises(UsageError, match=r"runs into a surface 3\.[78]\d s after its start") as error:
        SimulatedSequence("room", trajectory=_walk([2, 3, 1.4], [half + 1, 3, 1.4]), columns=64)
    assert "another world, seed or trajectory" in str(error.value)


def test_a_users_trajectory_through_the_free_room_is_taken():
    walk = _walk([2, -3, 1.4], [4, -3, 1.4])
    sequence = SimulatedSequence("room", trajectory=walk, columns=64)
    assert sequence.info.scan_count == 20
    np.testing.assert_allclose(sequence.truth().positions[0], walk.positions[0], atol=1e-9)
    np.testing.assert_allclose(sequence.truth().positions[-1], walk.positions[-1], atol=1e-6)
