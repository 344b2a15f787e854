"""The keyframes that are compared: the nearest ones and the most similar ones, where both are allowed."""

import numpy as np
import pytest

from lio_jax.core.leaf import numbers_of
from lio_jax.loops.place_descriptor import DescribedPlaces
from lio_jax.loops.proposals import described_proposals, external_proposal, is_old, nearest_proposal
from lio_jax.settings.shared import GlobalParams
from tests.loops.places import keyframe, pillars, pose, seen_from

LIMITS = numbers_of(GlobalParams)["loop"]


def test_old_is_what_lies_further_back_than_the_gap():
    keyframes = [keyframe(k, pose(), seconds=10.0 * k) for k in range(6)]
    assert is_old(keyframes, 5, 30.0).tolist() == [True, True, False, False, False, False]
    assert is_old(keyframes, 4, 5.0).tolist() == [True] * 4 + [False, False]


def test_the_nearest_old_keyframe_within_the_radius_is_proposed():
    poses = np.array([pose(20), pose(14, yaw=1.0), pose(9, 9), pose(1), pose()])
    old = np.array([True, True, True, False, False])
    metres = np.array([40.0, 30.0, 20.0, 1.0, 0.0])
    (proposal,) = nearest_proposal(poses, old, metres, LIMITS)
    assert (proposal.source, proposal.target, proposal.origin) == (4, 2, "radius")
    np.testing.assert_allclose(poses[2] @ proposal.T_target_source, poses[4], atol=1e-12)
    assert proposal.metres == 20.0
    assert proposal.shift_error == pytest.approx(1.0 + 20 * LIMITS["drift"])


@pytest.mark.parametrize("old", [[True, False], [False, False]])
def test_nothing_is_proposed_beyond_the_radius_or_among_the_recent(old):
    poses = np.array([pose(15.5), pose()])
    assert nearest_proposal(poses, np.array(old), np.array([500.0, 0.0]), LIMITS) == []


def described(worlds, truth, newest, points, metres, twin=None):
    """Return the proposals of a keyframe after others that each saw a world of their own from its middle."""
    places = DescribedPlaces(20, 60, 60.0)
    poses = [pose(*where) for where in truth]
    for index, (T, seed) in enumerate(zip(poses, worlds, strict=True)):
        shape = pillars(seed if twin != index else worlds[0])
        places.add(keyframe(index, T, seen_from(pose(), shape)))
    places.add(keyframe(len(poses), newest, points))
    poses = np.array([*poses, newest])
    old = np.arange(len(poses)) < len(poses) - 1
    return described_proposals(places, poses, old, np.full(len(poses), metres), LIMITS), poses


WHERE = [(0, 0), (60, 0), (120, 0), (180, 0)]


def test_a_place_whose_distance_drift_may_hide_is_found_by_its_look():
    """It is 40 m away by the odometry, which may be wrong by 51 m."""
    again = seen_from(pose(0.5, 0.2, yaw=0.3), pillars(11))
    (proposal,), poses = described([10, 11, 12, 13], WHERE, pose(60, 40), again, metres=1000.0)
    assert (proposal.source, proposal.target, proposal.origin) == (4, 1, "descriptor")
    implied = poses[1] @ proposal.T_target_source
    np.testing.assert_allclose(implied[:3, 3], [60, 0, 0], atol=1.0)
    assert np.arctan2(implied[1, 0], implied[0, 0]) == pytest.approx(0.3, abs=0.06)


@pytest.mark.parametrize(("metres", "y"), [(100.0, 40.0), (1000.0, 90.0), (100.0, 5.0)])
def test_a_place_is_not_sought_where_it_cannot_be_or_where_the_radius_finds_it(metres, y):
    again = seen_from(pose(yaw=0.3), pillars(11))
    assert described([10, 11, 12, 13], WHERE, pose(60, y), again, metres)[0] == []


def test_a_place_as_much_alike_elsewhere_is_compared_as_well():
    again = seen_from(pose(yaw=0.1), pillars(10))
    proposals, _ = described([10, 11, 12, 13], WHERE, pose(30, 20), again, metres=2000.0, twin=2)
    assert {proposal.target for proposal in proposals} == {0, 2}


def test_a_twin_where_the_odometry_cannot_have_been_is_noted():
    again = seen_from(pose(yaw=0.1), pillars(10))
    (proposal,), _ = described([10, 11, 12, 13], WHERE, pose(10, 10), again, metres=400.0, twin=3)
    assert proposal.target == 0
    assert proposal.twin == 3


def test_a_place_that_looks_like_none_before_is_not_compared():
    new = seen_from(pose(), pillars(99))
    assert described([10, 11, 12, 13], WHERE, pose(60, 20), new, metres=1000.0)[0] == []


def test_a_proposal_from_outside_begins_with_its_own_pose_or_with_the_odometrys_heading():
    poses = np.array([pose(0, 0, yaw=0.5), pose(80, 0, yaw=2.0)])
    given = external_proposal(1, 0, pose(1, 2, yaw=3.0), poses, 500.0, LIMITS)
    np.testing.assert_array_equal(given.T_target_source, pose(1, 2, yaw=3.0))
    none = external_proposal(1, 0, None, poses, 500.0, LIMITS)
    np.testing.assert_allclose(none.T_target_source, pose(yaw=1.5), atol=1e-12)
    assert none.turn_error > given.turn_error
    assert given.origin == none.origin == "external"
