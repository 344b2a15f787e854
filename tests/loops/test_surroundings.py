"""The thinned points of several keyframes together."""

import numpy as np

from lio_jax.loops.keyframe import level_points, padded, thinned
from tests.loops.places import keyframe, pillars, pose, seen_from


def test_keyframes_are_laid_together_in_the_worlds_axes_from_the_centre():
    world = pillars(0)
    poses = np.array([pose(5, 1, 0.5, 0.3), pose(9, -2, 0, 2.0), pose(-20, 8, 0, -1.0)])
    keyframes = [keyframe(k, pose(), seen_from(T, world)) for k, T in enumerate(poses)]
    points = level_points(keyframes, poses, 1, [0, 2], reach=30.0)
    expected = world - poses[1, :3, 3]
    expected = expected[np.abs(expected[:, :2]).max(axis=1) < 30.0]
    np.testing.assert_allclose(points, np.tile(expected, (2, 1)), atol=1e-4)
    assert level_points(keyframes, poses, 0, [], 30.0).shape == (0, 3)


def test_thinning_keeps_one_point_of_each_cube():
    points = np.random.default_rng(0).uniform(-40, 40, (20000, 3)).astype(np.float32)
    kept = thinned(points, 4.0)
    cubes = {tuple(cube) for cube in np.floor(points / 4.0).astype(int).tolist()}
    assert len(kept) == len(cubes)
    assert {tuple(cube) for cube in np.floor(kept / 4.0).astype(int).tolist()} == cubes
    assert {tuple(point) for point in kept.tolist()} <= {tuple(point) for point in points.tolist()}


def test_what_is_cut_off_is_spread_over_all_of_space():
    points = np.random.default_rng(0).uniform(-40, 40, (50000, 3)).astype(np.float32)
    kept, mask = padded(thinned(points, 1.0), 4096)
    assert mask.all()
    octant = (kept > 0) @ np.array([1, 2, 4])
    np.testing.assert_allclose(np.bincount(octant) / 4096, 1 / 8, atol=0.03)


def test_padding_marks_what_is_real():
    rows, mask = padded(np.ones((3, 3), np.float32), 5)
    assert mask.tolist() == [True, True, True, False, False]
    np.testing.assert_array_equal(rows[3:], 0.0)
