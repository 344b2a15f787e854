"""How far the odometry ran between keyframes, loops being short cuts."""

import numpy as np
import pytest

from lio_jax.core.leaf import numbers_of
from lio_jax.loops.proposals import metres_from, possible_error
from lio_jax.settings.shared import GlobalParams

LIMITS = numbers_of(GlobalParams)["loop"]


def test_without_loops_it_is_the_way_along_the_trajectory():
    run = np.array([0.0, 1.0, 1.0, 4.0, 9.0])
    np.testing.assert_array_equal(metres_from(3, run, []), [4.0, 3.0, 3.0, 0.0, 5.0])


@pytest.mark.parametrize("seed", range(3))
def test_with_loops_it_is_the_shortest_way(seed):
    rng = np.random.default_rng(seed)
    run = np.concatenate([[0.0], np.cumsum(rng.uniform(0.1, 3, 199))])
    loops = [tuple(sorted(rng.choice(200, 2, replace=False).tolist(), reverse=True)) for _ in range(8)]
    # given twice, as when a keyframe is confirmed by radius and from outside, and between neighbours
    loops += [loops[0], (51, 50)]
    edges = [(k, k + 1, run[k + 1] - run[k]) for k in range(199)] + [(a, b, 1.0) for a, b in loops]
    expected = np.where(np.arange(200) == 199, 0.0, np.inf)
    for _ in range(200):
        for a, b, length in edges:
            expected[a] = min(expected[a], expected[b] + length)
            expected[b] = min(expected[b], expected[a] + length)
    np.testing.assert_allclose(metres_from(199, run, loops), expected, atol=1e-3)


def test_the_possible_error_grows_with_the_way_and_its_heading_ends_at_a_half_turn():
    near, far, farthest = (possible_error(metres, LIMITS) for metres in (0.0, 1000.0, 1e5))
    assert 0 < near.position < LIMITS["radius"] < far.position
    np.testing.assert_allclose(far.position - near.position, 1000 * LIMITS["drift"])
    assert near.heading < far.heading < farthest.heading == np.pi
