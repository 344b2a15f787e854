"""The evidence for and against an alignment, compared with plain definitions."""

import numpy as np

from lio_jax.loops.overlap import OverlapAgreement, conflict, fitness_of
from tests.loops.places import pose


def test_distances_are_those_to_the_nearest_point_of_the_map():
    rng = np.random.default_rng(0)
    target, source = (rng.uniform(-5, 5, (count, 3)).astype(np.float32) for count in (300, 50))
    nearest = np.linalg.norm(source[:, None] - target, axis=2).min(axis=1)
    expected = np.where(nearest < 1.0, nearest, np.inf)
    assert 5 < np.sum(np.isfinite(expected)) < 50
    found = OverlapAgreement(target).distances(source.astype(np.float64))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    assert np.isclose(fitness_of(found), np.mean(nearest[nearest < 1.0] ** 2))
    assert fitness_of(np.full(3, np.inf)) == np.inf


def wall(distance, high=4.0):
    """Return a wall across x, (n, 3) m."""
    across, up = np.meshgrid(np.arange(-15, 15, 0.2), np.arange(-1, high, 0.2))
    return np.column_stack([np.full(across.size, distance), across.ravel(), up.ravel()]).astype(np.float32)


def test_a_wall_before_what_was_seen_conflicts_and_one_behind_does_not():
    seen, T = wall(20.0), np.eye(4)
    assert conflict(seen, wall(10.0), T) > 0.95
    assert conflict(seen, wall(30.0), T) == 0.0
    assert conflict(seen, wall(20.5), T) == 0.0


def test_it_is_judged_from_where_the_alignment_puts_the_sensor():
    """The map's wall stands 10 m before the target, 20 m before the source: where that saw one."""
    assert conflict(wall(20.0), wall(10.0), pose(-10.0)) == 0.0
    turned = pose(-10.0, yaw=np.pi)
    assert conflict(wall(20.0), wall(-30.0), turned) == 0.0


def test_directions_in_which_nothing_was_seen_say_nothing():
    assert conflict(wall(20.0), wall(-10.0), np.eye(4)) == 0.0
