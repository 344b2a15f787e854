"""Loops confirm or contradict each other by the circles they make."""

import numpy as np
import pytest

from lio_jax.core.leaf import numbers_of
from lio_jax.loops.closing import Consensus, consistent
from lio_jax.loops.proposals import Proposal
from lio_jax.loops.verification import Verdict
from lio_jax.settings.shared import GlobalParams
from tests.loops.places import keyframe, pose

LIMITS = numbers_of(GlobalParams)["loop"]
RADIUS, COUNT = 40.0, 400
"""Twice around a circle, about 1.3 m a keyframe; the odometry turns and stretches a little too far."""


def around(turns):
    angle = np.linspace(0, 2 * np.pi * turns, COUNT)
    return [pose(RADIUS * np.cos(a), RADIUS * np.sin(a), yaw=a + np.pi / 2) for a in angle]


TRUTH = around(2.0)
KEYFRAMES = [keyframe(k, T) for k, T in enumerate(around(2.06))]
RUN = np.linspace(0, 2 * np.pi * 2.06 * RADIUS, COUNT)


def loop(source, target, wrong=None, origin="radius"):
    T = np.linalg.inv(TRUTH[target]) @ TRUTH[source] @ (np.eye(4) if wrong is None else wrong)
    proposal = Proposal(source, target, origin, T, 1.0, 0.1, 100.0)
    return Verdict(proposal, True, "", T, np.eye(6))


def fed(loops):
    consensus = Consensus(LIMITS)
    entering = [consensus.with_loop(one, KEYFRAMES, RUN) for one in loops]
    return consensus, entering


@pytest.mark.parametrize("wrong", [pose(5.0), pose(0, 0, 4.0), pose(yaw=0.5)])
def test_right_loops_are_consistent_and_a_wrong_one_is_not(wrong):
    right, other = loop(230, 30), loop(240, 41)
    assert consistent(right, other, KEYFRAMES, RUN, LIMITS)
    assert consistent(other, right, KEYFRAMES, RUN, LIMITS)
    assert not consistent(right, loop(240, 41, wrong), KEYFRAMES, RUN, LIMITS)
    assert not consistent(loop(240, 41, wrong), right, KEYFRAMES, RUN, LIMITS)


def test_two_equally_wrong_loops_are_consistent():
    """A cycle of loops cannot show an error that both share: loops must be verified first."""
    shifted = [TRUTH[30] @ pose(5.0) @ np.linalg.inv(TRUTH[30])]
    pair = []
    for source, target in ((230, 30), (232, 32)):
        T = np.linalg.inv(TRUTH[target]) @ shifted[0] @ TRUTH[source]
        pair.append(Verdict(Proposal(source, target, "radius", T, 1.0, 0.1, 100.0), True, "", T, np.eye(6)))
    assert consistent(*pair, KEYFRAMES, RUN, LIMITS)


def test_loops_enter_once_two_others_confirm_each():
    loops = [loop(230 + k, 30 + k) for k in range(5)]
    consensus, entering = fed(loops)
    assert entering == [[], [], loops[:3], [loops[3]], [loops[4]]]
    assert consensus.entered == loops
    assert consensus.waiting == []


def test_a_wrong_loop_never_enters_and_does_not_keep_right_ones_out():
    wrong = loop(231, 31, pose(6.0))
    loops = [loop(230, 30), wrong, loop(232, 32), loop(233, 33), loop(234, 34)]
    consensus, _ = fed(loops)
    assert consensus.waiting == [wrong]
    assert consensus.entered == [one for one in loops if one is not wrong]


def test_loops_far_from_each_other_say_nothing():
    loops = [loop(210, 10), loop(290, 90), loop(370, 170)]
    consensus, entering = fed(loops)
    assert entering == [[], [], []]
    assert consensus.waiting == loops


def test_one_from_outside_needs_no_others_but_none_may_contradict_it():
    outside = loop(230, 30, origin="external")
    assert fed([outside])[1] == [[outside]]
    wrong = loop(233, 33, pose(6.0), origin="external")
    right = [loop(230 + k, 30 + k) for k in range(3)]
    consensus, _ = fed([*right, wrong])
    assert consensus.entered == right
    assert consensus.waiting == [wrong]
