"""The mean of a scan's points in each voxel, against numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.lidar.thinning import mean_per_voxel

_mean = jax.jit(mean_per_voxel, static_argnums=3)
VOXEL = 0.5


def means(points, mask=None, capacity=2048) -> tuple[np.ndarray, int]:
    mask = np.ones(len(points), bool) if mask is None else mask
    found = _mean(jnp.asarray(points, jnp.float32), jnp.asarray(mask), jnp.float32(VOXEL), capacity)
    kept = np.asarray(found.mask)
    # the real ones come first
    assert kept[: kept.sum()].all()
    return np.asarray(found.points, float)[kept], int(found.dropped)


def expected(points) -> dict[tuple, np.ndarray]:
    voxel = np.floor(np.asarray(points, np.float32) / np.float32(VOXEL)).astype(int)
    keys, member = np.unique(voxel, axis=0, return_inverse=True)
    member = member.ravel()
    return {tuple(key.tolist()): points[member == row].mean(0) for row, key in enumerate(keys)}


def test_each_voxel_gives_the_mean_of_its_points():
    points = np.random.default_rng(0).uniform(-4, 4, (3000, 3)).astype(np.float32)
    found, dropped = means(points, capacity=4096)
    wanted = expected(points)
    assert dropped == 0
    # voxels that share a hash slot leave one of them out
    assert 0.8 * len(wanted) < len(found) <= len(wanted)
    for point in found:
        key = tuple(np.floor(point / VOXEL).astype(int).tolist())
        np.testing.assert_allclose(point, wanted[key], atol=2e-6)


@pytest.mark.parametrize("filler", [np.nan, np.inf, 0.0])
def test_masked_rows_do_not_count(filler):
    points = np.random.default_rng(1).uniform(-2, 2, (3000, 3)).astype(np.float32)
    mask = np.arange(3000) % 3 == 0
    found, _ = means(np.where(mask[:, None], points, np.float32(filler)), mask, 4096)
    wanted = expected(points[mask])
    for point in found:
        key = tuple(np.floor(point / VOXEL).astype(int).tolist())
        np.testing.assert_allclose(point, wanted[key], atol=2e-6)


def test_voxels_beyond_the_capacity_are_counted_and_left_out_all_over_the_scan():
    points = np.random.default_rng(2).uniform(-8, 8, (3000, 3)).astype(np.float32)
    found, dropped = means(points, capacity=256)
    assert len(found) == 256
    assert dropped > 300
    assert (np.abs(found.mean(0)) < 1.5).all()


def test_nothing_gives_nothing():
    found, dropped = means(np.full((3000, 3), np.nan, np.float32), np.zeros(3000, bool), 256)
    assert len(found) == dropped == 0


def test_times_are_averaged_with_the_points():
    rng = np.random.default_rng(7)
    points = rng.uniform(-2, 2, (800, 3)).astype(np.float32)
    time = (points @ [0.01, 0.02, -0.03] + 0.05).astype(np.float32)
    mask = rng.random(800) > 0.3
    arrays = jnp.asarray(points), jnp.asarray(mask)
    found = _mean(*arrays, jnp.float32(VOXEL), 1024, jnp.asarray(time))
    kept = np.asarray(found.mask)
    # linear in the coordinates, so that it is so for the means
    expected_time = np.asarray(found.points)[kept] @ [0.01, 0.02, -0.03] + 0.05
    np.testing.assert_allclose(np.asarray(found.time)[kept], expected_time, atol=1e-6)
    assert _mean(*arrays, jnp.float32(VOXEL), 1024).time is None
