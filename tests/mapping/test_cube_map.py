"""LOAM's cubes: which points are matched, how the grid shifts and what it forgets."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.mapping.feature_map import (
    FeaturePoints,
    added_to_cubes,
    empty_feature_map,
    frames_at,
    matched_cubes,
)
from lio_jax.mapping.point_map import EDGE
from lio_jax.settings.settings import recipe_settings, with_overrides
from tests.mapping.test_point_map import held

PARAMS = recipe_settings("loam").params()
CORNER, SURFACE = float(PARAMS.map.corner_voxel_size), float(PARAMS.map.voxel_size)


def cube_of(position: np.ndarray) -> np.ndarray:
    """Return A-LOAM's cube number of a position, its first cube's centre at the origin."""
    return np.floor((position + 25.0) / 50.0).astype(int)


@pytest.mark.parametrize("position", [[0.0, 0.0, 0.0], [24.0, -26.0, 3.0], [130.0, 77.0, -40.0]])
def test_points_are_matched_in_the_five_by_five_by_three_cubes_around(position):
    rng = np.random.default_rng(0)
    where = np.array(position)
    points = where + rng.uniform(-220, 220, (5000, 3))
    frame = frames_at(jnp.asarray(where), PARAMS.map).surface
    placed = jnp.asarray(points - np.asarray(frame.origin), jnp.float32)
    near = np.asarray(matched_cubes(placed, frame, jnp.asarray(where), PARAMS.cubes))
    apart = np.abs(cube_of(points) - cube_of(where))
    expected = (apart <= [2, 2, 1]).all(1)
    at_face = (np.abs((points + 25.0) / 50.0 - np.round((points + 25.0) / 50.0)) < 1e-5).any(1)
    np.testing.assert_array_equal(near[~at_face], expected[~at_face])
    assert 0.02 < expected.mean() < 0.5


class Grid:
    """A-LOAM's grid, sequentially: shifts by whole cubes as long as fewer than 3 are left to a border."""

    def __init__(self) -> None:
        self.centre = np.zeros(3, int)
        self.points = np.zeros((0, 3))

    def move_to(self, position: np.ndarray) -> None:
        half = np.array([10, 10, 5])
        for axis in range(3):
            while cube_of(position)[axis] - self.centre[axis] < -half[axis] + 3:
                self.centre[axis] -= 1
            while cube_of(position)[axis] - self.centre[axis] > half[axis] - 3:
                self.centre[axis] += 1
        inside = (np.abs(cube_of(self.points) - self.centre) <= half).all(1)
        self.points = self.points[inside]


_add = jax.jit(partial(added_to_cubes, map_params=PARAMS.map, point_map=PARAMS.point_map, cubes=PARAMS.cubes))


def added(cubes, points: np.ndarray, position: np.ndarray):
    frames = frames_at(jnp.asarray(position), PARAMS.map)
    mask = jnp.ones(len(points), bool)
    placed = FeaturePoints(
        jnp.asarray(points - np.asarray(frames.corner.origin), jnp.float32),
        mask,
        jnp.asarray(points - np.asarray(frames.surface.origin), jnp.float32),
        mask,
    )
    return _add(cubes, placed, jnp.array(True), frames)


def test_the_grid_shifts_and_forgets_as_loams_does():
    """Along a way of 1.5 km with a climb; points one per 8 m, so that no two share a voxel."""
    rng = np.random.default_rng(1)
    cubes, grid, homeless = empty_feature_map(16384), Grid(), np.zeros(2, int)
    way = np.stack([np.linspace(0, 1500, 40), np.linspace(0, -900, 40), np.linspace(0, 240, 40)], 1)
    for position in way:
        points = np.unique(np.round((position + rng.uniform(-90, 90, (60, 3))) / 8), axis=0) * 8 + 0.13
        points = np.concatenate([points, np.full((60 - len(points), 3), points[0])])
        cubes, *insertions = added(cubes, points, position)
        homeless += [int(insertion.dropped) for insertion in insertions]
        grid.points = np.unique(np.concatenate([grid.points, points]), axis=0)
        grid.move_to(position)
    # blocks are kept or forgotten whole, and the grid's faces are rounded to them
    blurred = 2 * EDGE * SURFACE
    half = 50 * np.array([10.5, 10.5, 5.5])
    at_face = (np.abs(np.abs(grid.points - 50 * grid.centre) - half) < blurred).any(1)
    assert homeless.max() < 0.03 * 40 * 60
    for pmap, size, missing in zip((cubes.corner, cubes.surface), (CORNER, SURFACE), homeless, strict=True):
        kept = {tuple(row) for row in np.round(held(pmap, size), 1)}
        expected = {tuple(row) for row in np.round(grid.points[~at_face], 1)}
        assert len(expected - kept) <= missing
        assert len(kept - {tuple(row) for row in np.round(grid.points, 1)}) <= 0.05 * len(kept)
        assert len(kept) < 0.95 * 40 * 60


def test_nothing_is_added_where_the_scan_was_lost():
    points = np.random.default_rng(2).uniform(-20, 20, (60, 3))
    frames = frames_at(jnp.zeros(3), PARAMS.map)
    mask = jnp.ones(60, bool)
    placed = FeaturePoints(jnp.asarray(points, jnp.float32), mask, jnp.asarray(points, jnp.float32), mask)
    cubes, corner, surface = _add(empty_feature_map(1024), placed, jnp.array(False), frames)
    assert not corner.added.any()
    assert not surface.added.any()
    assert len(held(cubes.corner, CORNER)) == len(held(cubes.surface, SURFACE)) == 0


def test_sizes_of_the_grid_are_parameters():
    small = with_overrides(
        recipe_settings("loam"), ["params.cubes.edge=10", "params.cubes.matched_across=1"]
    ).params()
    frame = frames_at(jnp.zeros(3), small.map).surface
    placed = jnp.asarray([[4.0, 0, 0], [6.0, 0, 0], [0, 0, 14.0], [0, 0, 16.0]], jnp.float32)
    near = matched_cubes(placed - jnp.asarray(frame.origin, jnp.float32), frame, jnp.zeros(3), small.cubes)
    assert near.tolist() == [True, False, True, False]
