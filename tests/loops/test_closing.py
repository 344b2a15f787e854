"""Loops one keyframe after the other: none is lost, and similar places are not confused."""

from dataclasses import replace

import numpy as np
import pytest
from loops import absolute_error, closed, error_of, revisits, town

from lio_jax.loops.closing import LoopCloser, held_by
from lio_jax.loops.keyframe import same_piece
from lio_jax.loops.proposals import Proposal
from lio_jax.loops.verification import Verdict
from lio_jax.settings.settings import Settings
from tests.loops.places import keyframe, pose


def verdict(source, target, T=None, origin="radius", accepted=True, overlap=0.9):
    T = pose() if T is None else T
    proposal = Proposal(source, target, origin, T, 1.0, 0.1, 500.0)
    return Verdict(proposal, accepted, "", T, np.eye(6), overlap=overlap)


def driven_on(closer, count):
    """Take up keyframes 1 m apart, 10 s each, that propose nothing."""
    keyframes = []
    for index in range(count):
        keyframes.append(keyframe(index, pose(index)))
        poses = np.array([one.T_odom_imu for one in keyframes])
        poses[:, 0, 3] *= 1e4
        assert closer.proposals_for(keyframes, poses) == []
        assert closer.settle([], keyframes) == []
    return keyframes


def test_two_places_that_fit_as_well_are_both_refused():
    closer = LoopCloser(Settings())
    keyframes = driven_on(closer, 60)
    two = [verdict(59, 10), verdict(59, 40, origin="descriptor")]
    assert closer.settle(two, keyframes) == []
    assert closer.closed == []
    outcomes = [(one.accepted, one.reason) for one in closer.outcomes()]
    assert outcomes == [(False, "another place fits as well")] * 2


def test_the_same_place_found_twice_enters_once_and_every_proposal_is_kept():
    closer = LoopCloser(Settings())
    keyframes = driven_on(closer, 60)
    for source in (56, 57, 58):
        closer.settle(
            [
                verdict(source, source - 50, overlap=0.8),
                verdict(source, source - 50, origin="descriptor"),
                verdict(source, source - 40, origin="external", accepted=False),
            ],
            keyframes,
        )
    assert [one.proposal.origin for one in closer.closed] == ["descriptor"] * 3
    outcomes = closer.outcomes()
    assert len(outcomes) == 9
    assert sum(one.accepted for one in outcomes) == 3


def test_a_loop_that_no_other_confirms_is_kept_with_that_reason():
    closer = LoopCloser(Settings())
    keyframes = driven_on(closer, 60)
    assert closer.settle([verdict(59, 10)], keyframes) == []
    (outcome,) = closer.outcomes()
    assert not outcome.accepted
    assert outcome.reason == "no other loop nearby confirms it"


def test_pairs_from_outside_are_proposed_when_their_later_time_has_come(tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_text("1 42\n33 38\n-5 70\n20 900\n")
    settings = Settings().with_value("config.loops.pairs", str(path), "test")
    closer = LoopCloser(settings)
    keyframes, proposed = [], {}
    for index in range(10):
        keyframes.append(keyframe(index, pose(100.0 * index)))
        found = closer.proposals_for(keyframes, np.array([one.T_odom_imu for one in keyframes]))
        proposed |= {index: [(one.source, one.target, one.origin) for one in found]} if found else {}
    assert proposed == {5: [(4, 0, "external")]}
    assert [pair.line for pair in closer.untried()] == [2, 3, 4]


def test_only_loops_that_the_poses_agree_with_are_short_cuts():
    poses = np.array([pose(), pose(50), pose(52, yaw=0.02), pose(0.4)])
    right, ignored, distrusted = verdict(3, 0), verdict(2, 0), verdict(2, 1, pose(2, yaw=0.3))
    assert held_by(poses, [right, ignored, distrusted, verdict(2, 1, pose(2))]) == [(3, 0), (2, 1)]
    assert held_by(poses, []) == []


@pytest.fixture(scope="module")
def twice_around_a_block():
    """Twice around a block of the city, the second time in the other lane and direction, with 2.5 m steps."""
    return town("city", 0, -1.0, loop=[(0, 0), (1, 0), (1, 1), (0, 1)], spacing=2.5, speed=5.0)


def test_a_loop_driven_twice_is_closed_wherever_it_is_driven_again(twice_around_a_block):
    keyframes, truth = twice_around_a_block
    closer, _, _ = closed(keyframes)
    again = set(revisits(keyframes, truth).tolist())
    loops = closer.closed
    assert len(again) > 60
    assert len(again & {loop.proposal.source for loop in loops}) >= 0.95 * len(again)
    for loop in loops:
        moved, turned = error_of(loop.T_target_source, truth, loop.proposal.source, loop.proposal.target)
        assert moved < 0.5
        assert turned < 0.02


def test_a_loop_among_doubtful_places_has_to_be_confirmed_by_more_than_there_are_of_them():
    closer = LoopCloser(Settings())
    keyframes = driven_on(closer, 70)
    for source in (50, 51, 52):
        closer.settle([verdict(source, 5), verdict(source, 30, origin="descriptor")], keyframes)
    for source in (53, 54, 55, 56):
        assert closer.settle([verdict(source, source - 48)], keyframes) == []
    entering = closer.settle([verdict(57, 9)], keyframes)
    assert [loop.proposal.source for loop in entering] == [53, 54, 55, 56, 57]


def across_an_outage(keyframes, at, shift, yaw, known=True):
    """Return keyframes whose odometry is off by a step from one of them on, as after an outage there."""
    moved = []
    for one in keyframes:
        if one.index < at:
            moved.append(one)
            continue
        T = keyframes[at - 1].T_odom_imu @ shift_of(shift, yaw) @ np.linalg.inv(keyframes[at - 1].T_odom_imu)
        begins = known and one.index == at
        moved.append(
            replace(
                one,
                T_odom_imu=T @ one.T_odom_imu,
                covariance=np.diag([0.1**2] * 3 + [10.0**2] * 3) if begins else one.covariance,
                position_error=40.0 if begins else 0.0,
                heading_error=0.4 if begins else 0.0,
            )
        )
    return moved


def shift_of(shift, yaw):
    T = pose(*shift)
    T[:3, :3] = pose(yaw=yaw)[:3, :3]
    return T


@pytest.mark.long
def test_loops_tie_the_pieces_of_a_map_on_both_sides_of_an_outage(twice_around_a_block):
    keyframes, truth = twice_around_a_block
    middle = len(keyframes) // 2
    broken = across_an_outage(keyframes, middle, (25.0, -15.0), 0.2)
    before = np.array([one.T_odom_imu for one in broken])
    assert absolute_error(before, truth) > 8
    closer, found, _ = closed(broken)
    across = [one for one in closer.closed if one.proposal.target < middle <= one.proposal.source]
    assert len(across) > 30
    _, whole, _ = closed(keyframes)
    assert absolute_error(found.T_world_imu, truth) < 1.2 * absolute_error(whole.T_world_imu, truth) + 0.1


def test_a_submap_ends_where_another_piece_of_map_begins():
    keyframes = across_an_outage([keyframe(k, pose(k)) for k in range(8)], 4, (9.0, 0.0), 0.0)
    assert same_piece(keyframes, 2, range(8)) == [0, 1, 2, 3]
    assert same_piece(keyframes, 4, range(8)) == same_piece(keyframes, 6, range(8)) == [4, 5, 6, 7]
