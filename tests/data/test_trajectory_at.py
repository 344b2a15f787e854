"""Poses between a trajectory's own, against scipy over the whole of it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from lio_jax.data.trajectory import Trajectory, pose_matrices

RNG = np.random.default_rng(2)
STAMPS = np.cumsum(RNG.integers(1_000_000, 200_000_000, 50))
POSITIONS, TURNS = RNG.normal(size=(50, 3)), Rotation.random(50, random_state=3)
TRAJECTORY = Trajectory(STAMPS, pose_matrices(POSITIONS, TURNS.as_quat()))
MIDDLES = (STAMPS[:-1] + STAMPS[1:]) // 2
QUERIES = {
    "first": STAMPS[:1],
    "last": STAMPS[-1:],
    "on one": STAMPS[7:8],
    "between two": MIDDLES[20:21],
    "last piece": MIDDLES[-1:],
    "a stretch": MIDDLES[10:30],
    "everything": np.sort(np.concatenate([STAMPS, MIDDLES])),
    "none in order": MIDDLES[[31, 5, 18]],
}


@pytest.mark.parametrize("query", QUERIES.values(), ids=QUERIES)
def test_poses_are_those_of_the_whole_trajectory(query):
    knots, wanted = (STAMPS - STAMPS[0]) * 1e-9, (query - STAMPS[0]) * 1e-9
    found = TRAJECTORY.at(query)
    np.testing.assert_array_equal(found.stamp_ns, query)
    turns = Slerp(knots, TURNS)(wanted).as_matrix()
    np.testing.assert_allclose(found.poses[:, :3, :3], turns, atol=1e-6)
    for axis in range(3):
        expected = np.interp(wanted, knots, POSITIONS[:, axis])
        np.testing.assert_allclose(found.positions[:, axis], expected, atol=1e-6)


def test_stamps_outside_are_left_out():
    outside = np.array([STAMPS[0] - 1, STAMPS[3], STAMPS[-1] + 1])
    np.testing.assert_array_equal(TRAJECTORY.at(outside).stamp_ns, STAMPS[3:4])
