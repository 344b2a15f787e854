"""Nearest neighbours against scipy's k-d tree."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from lio_jax.mapping.nearest_points import nearest_points
from lio_jax.mapping.point_map import empty_map
from tests.mapping.test_point_map import BLOCK, VOXEL, held, put

NEIGHBOURS = 5
QUERIES = 700
_nearest = jax.jit(nearest_points, static_argnums=5)


def ask(pmap, queries, anchor=(0, 0, 0), mask=None, neighbours=NEIGHBOURS):
    """Return (k, n) distances and (k, n, 3) points in the anchored frame."""
    mask = np.ones(len(queries), bool) if mask is None else mask
    found = _nearest(
        pmap,
        jnp.asarray(queries, jnp.float32),
        jnp.asarray(mask),
        jnp.asarray(anchor, jnp.int32),
        jnp.float32(VOXEL),
        neighbours,
    )
    points = np.stack([found.x, found.y, found.z], -1).astype(float)
    return np.sqrt(np.asarray(found.squared_distance, float)).T, points.transpose(1, 0, 2)


def street(seed: int) -> np.ndarray:
    """Return points of a floor, two walls and scattered bushes, sparser with distance."""
    rng = np.random.default_rng(seed)
    along = rng.normal(0, 12, (3, 600))
    across = rng.uniform(-6, 6, 600)
    height = rng.uniform(0, 4, (2, 600))
    floor = np.stack([along[0], across, np.zeros(600)], 1)
    walls = [np.stack([along[1 + k], np.full(600, (-6.0, 6.0)[k]), height[k]], 1) for k in (0, 1)]
    return np.concatenate([floor, *walls, rng.normal([3, 2, 1], 0.6, (200, 3))]).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    pmap, points = empty_map(16384), street(0)
    for scan in np.array_split(points, 2):
        pmap, _, dropped = put(pmap, scan)
        assert dropped == 0
    return pmap, held(pmap)


@pytest.fixture(scope="module")
def queries() -> np.ndarray:
    return (street(1) + np.random.default_rng(2).normal(0, 0.1, (2000, 3)))[::2][:QUERIES].astype(np.float32)


def test_recall_within_a_block_is_complete(scene, queries):
    pmap, points = scene
    distance, found = ask(pmap, queries)
    expected, _ = cKDTree(points).query(queries, NEIGHBOURS)
    sure = expected[:, -1] < BLOCK
    assert 0.6 < sure.mean() < 0.98
    np.testing.assert_allclose(distance[sure], expected[sure], rtol=2e-3)
    # far ones: the nearest among the blocks searched, never nearer than the truth
    assert (distance >= expected - 1e-3).all()
    within = expected[:, -1] < 5**0.5
    recalled = np.abs(distance - expected) < 2e-3 * expected + 1e-6
    assert recalled[within].mean() > 0.97
    np.testing.assert_allclose(
        np.linalg.norm(found[sure] - queries[sure][:, None], axis=-1), distance[sure], rtol=1e-4
    )


def test_what_is_found_is_in_the_map_and_each_point_once(scene, queries):
    pmap, points = scene
    distance, found = ask(pmap, queries)
    real = np.isfinite(distance)
    away, which = cKDTree(points).query(found[real])
    assert away.max() < 1e-5
    for row in range(len(queries)):
        mine = which[real[:row].sum() : real[: row + 1].sum()]
        assert len(set(mine.tolist())) == len(mine)
    assert (np.diff(np.where(real, distance, 1e9), axis=1) >= -1e-3).all()


def test_missing_neighbours_are_infinitely_far():
    pmap, _, _ = put(empty_map(64), [[0.1, 0.1, 0.1], [0.7, 0.1, 0.1], [0.1, 0.8, 0.1]])
    distance, _ = ask(pmap, np.array([[0.2, 0.2, 0.2], [0.2, 0.2, 50.0]], np.float32))
    assert np.isfinite(distance).sum(1).tolist() == [3, 0]
    assert np.isinf(ask(empty_map(64), np.zeros((2, 3), np.float32))[0]).all()


def test_masked_rows_may_hold_anything(scene, queries):
    pmap, _ = scene
    mask = np.arange(len(queries)) % 4 > 0
    plain, _ = ask(pmap, queries)
    spoiled, _ = ask(pmap, np.where(mask[:, None], queries, np.nan).astype(np.float32), mask=mask)
    np.testing.assert_array_equal(spoiled[mask], plain[mask])


def test_the_anchor_moves_nothing(scene, queries):
    pmap, _ = scene
    step = np.array([7, -5, 2])
    plain, _ = ask(pmap, queries)
    moved, _ = ask(pmap, queries - (step * BLOCK).astype(np.float32), step)
    np.testing.assert_allclose(moved, plain, rtol=2e-3, atol=1e-4)


@pytest.mark.parametrize("neighbours", [1, 3])
def test_any_number_of_neighbours(scene, queries, neighbours):
    pmap, points = scene
    distance, _ = ask(pmap, queries, neighbours=neighbours)
    expected, _ = cKDTree(points).query(queries, neighbours)
    expected = expected.reshape(-1, neighbours)
    sure = expected[:, -1] < BLOCK
    np.testing.assert_allclose(distance[sure], expected[sure], rtol=2e-3)
