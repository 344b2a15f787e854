"""Alignment on the device: known poses come back from several guesses, each on its own."""

import numpy as np
import pytest

from lio_jax.core.leaf import traced
from lio_jax.loops.alignment import aligned
from lio_jax.loops.keyframe import padded, thinned
from lio_jax.loops.params import AlignmentParams
from tests.loops.places import pose, seen_from

TRUTH = pose(2.0, -1.0, 0.2, 0.4)


def yard():
    """Return the walls of a yard with a house in it, and its ground, (n, 3) m."""
    rng = np.random.default_rng(0)
    sides = [(-20, "x", 25), (22, "x", 25), (-15, "y", 25), (17, "y", 25), (5, "x", 6), (6, "y", 6)]
    parts = []
    for at, axis, half in sides:
        along, up = rng.uniform(-half, half, 6000), rng.uniform(-1.5, 4, 6000)
        across = np.full(6000, float(at))
        parts.append(np.stack([across, along, up] if axis == "x" else [along, across, up], axis=1))
    parts.append(np.column_stack([rng.uniform(-20, 20, (9000, 2)), np.full(9000, -1.5)]))
    return (np.concatenate(parts) + rng.normal(0, 0.02, (45000, 3))).astype(np.float32)


def solve(target, source, guesses, most=3):
    return aligned(
        *padded(target, 32768), *padded(source, 1024), np.array(guesses), most, traced(AlignmentParams)
    )


@pytest.fixture(scope="module")
def places():
    points = thinned(yard(), 0.3)
    return points, thinned(seen_from(TRUTH, yard()), 0.8)


def test_each_guess_near_the_truth_leads_there(places):
    guesses = [TRUTH @ pose(0.8, -0.5, 0.2, 0.05), TRUTH @ pose(-0.6, 0.6, -0.2, -0.06)]
    found = solve(*places, guesses)
    assert found.converged.all()
    assert not found.degenerate.any()
    for T in found.T_target_source:
        missed = np.linalg.inv(TRUTH) @ T
        assert np.linalg.norm(missed[:3, 3]) < 0.02
        assert np.abs(missed[:3, :3] - np.eye(3)).max() < 2e-3


def test_a_guess_is_not_touched_by_the_others(places):
    far, near = TRUTH @ pose(9.0, 3.0, 0, 0.5), TRUTH @ pose(0.5)
    together, alone = solve(*places, [far, near]), solve(*places, [near])
    np.testing.assert_array_equal(together.T_target_source[1], alone.T_target_source[0])
    assert np.linalg.norm((np.linalg.inv(TRUTH) @ together.T_target_source[0])[:3, 3]) > 1.0


def test_the_direction_that_two_parallel_walls_leave_open_is_reported(places):
    target, source = places
    hall = target[
        (np.abs(target[:, 1] - 17) < 0.2) | (np.abs(target[:, 1] + 15) < 0.2) | (target[:, 2] < -1.4)
    ]
    found = solve(hall, source, [TRUTH])
    assert found.degenerate.all()
