"""Means per ring and voxel against numpy's groups."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.lidar.thinning import mean_per_ring_and_voxel

MEANS = jax.jit(mean_per_ring_and_voxel, static_argnums=4)
SIZE = np.float32(0.2)


def groups(points: np.ndarray, time: np.ndarray, mask: np.ndarray, size: np.float32 = SIZE) -> dict:
    """Return mean point and time of each (ring, voxel) in double precision."""
    ring = np.broadcast_to(np.arange(mask.shape[1]), mask.shape)[mask]
    kept, when = points[mask], time[mask]
    keys = np.c_[ring, np.floor(kept / size).astype(int)]
    unique, member = np.unique(keys, axis=0, return_inverse=True)
    number = np.bincount(member.ravel())
    columns = [np.bincount(member.ravel(), weights=c) / number for c in (*kept.T.astype(float), when)]
    return {tuple(key): row for key, row in zip(unique.tolist(), np.stack(columns, -1), strict=True)}


def means(points, time, mask, capacity=8192, size=SIZE):
    xyz = tuple(jnp.asarray(points[..., axis]) for axis in range(3))
    return MEANS(xyz, jnp.asarray(time), jnp.asarray(mask), jnp.float32(size), capacity)


def wandering(seed: int, places: int = 500, rings: int = 6, half: float = 30.0):
    """Return rings that come back to voxels where they have been."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-half, half, (40, rings, 3))
    points = centres[rng.integers(0, 40, places)] + rng.normal(0, 0.15, (places, rings, 3))
    time = rng.uniform(0, 0.1, (places, rings)).astype(np.float32)
    return points.astype(np.float32), time, rng.uniform(size=(places, rings)) < 0.8


@pytest.mark.parametrize("half", [0.3, 3.0, 100.0])
@pytest.mark.parametrize("seed", range(3))
def test_each_ring_and_voxel_gives_one_mean(seed, half):
    points, time, mask = wandering(seed, half=half)
    found, wanted = means(points, time, mask), groups(points, time, mask)
    rows = np.flatnonzero(found.mask)
    assert len(rows) == len(wanted)
    assert int(found.dropped) == 0
    # no key in the answer: a mean lies in its voxel, up to its rounding
    wanted_rows = np.array([[key[0], *row] for key, row in wanted.items()])
    found_rows = np.c_[found.ring[rows], found.points[rows], found.time[rows]].astype(float)
    for ring in range(mask.shape[1]):
        ours, theirs = (all_rows[all_rows[:, 0] == ring, 1:] for all_rows in (found_rows, wanted_rows))
        assert len(ours) == len(theirs)
        nearest = np.abs(ours[:, None] - theirs).max(-1)
        assert sorted(nearest.argmin(1)) == list(range(len(theirs)))
        np.testing.assert_allclose(nearest.min(1), 0, atol=2e-5)


def test_every_row_knows_its_ring():
    """However many points are averaged: a mean of whole numbers is rounded."""
    rings = 128
    points = np.zeros((60, rings, 3), np.float32)
    mask = np.arange(60)[:, None] < 1 + np.arange(rings) % 60
    found = means(points, np.zeros((60, rings), np.float32), mask, capacity=rings)
    np.testing.assert_array_equal(found.ring, np.arange(rings))


def test_rows_follow_ring_after_ring():
    found = means(*wandering(1))
    assert (np.diff(np.asarray(found.ring)[np.asarray(found.mask)]) >= 0).all()


def test_too_many_rows_are_thinned_evenly_and_counted():
    points, time, mask = wandering(2, half=200.0)
    everything = means(points, time, mask)
    total = int(everything.mask.sum())
    found = means(points, time, mask, capacity=total // 3)
    assert int(found.mask.sum()) >= 0.98 * (total // 3)
    assert int(found.dropped) + int(found.mask.sum()) == total
    shares = [
        np.bincount(np.asarray(one.ring)[np.asarray(one.mask)], minlength=6) for one in (found, everything)
    ]
    np.testing.assert_allclose(shares[0] / shares[1], 1 / 3, atol=0.02)
    # what is there is untouched
    all_points = {tuple(p) for p in np.asarray(everything.points)[np.asarray(everything.mask)].tolist()}
    assert {tuple(p) for p in np.asarray(found.points)[np.asarray(found.mask)].tolist()} <= all_points


def test_one_more_than_the_capacity_loses_one():
    steps = np.arange(101, dtype=np.float32)
    points = np.stack([steps, 0 * steps, 0 * steps], -1)[:, None]
    time, mask = np.zeros((101, 1), np.float32), np.ones((101, 1), bool)
    found = means(points, time, mask, capacity=100)
    assert int(found.dropped) == 1
    assert int(found.mask.sum()) == 100


@pytest.mark.parametrize("filler", [np.nan, np.inf, 0.0])
def test_masked_points_do_not_count(filler):
    points, time, mask = wandering(3)
    filled = np.where(mask[..., None], points, np.float32(filler))
    for one, other in zip(
        jax.tree.leaves(means(filled, time, mask)), jax.tree.leaves(means(points, time, mask)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_nothing_gives_nothing():
    points, time, mask = wandering(4)
    found = means(points, time, np.zeros_like(mask))
    assert not np.asarray(found.mask).any()
    assert np.isfinite(found.points).all()


def test_the_mean_has_the_gradient_of_a_mean():
    points, time, mask = wandering(5, places=60, rings=2, half=0.2)
    weights = np.random.default_rng(0).normal(size=(256, 3)).astype(np.float32)

    def weighted(xyz):
        found = mean_per_ring_and_voxel(xyz, jnp.asarray(time), jnp.asarray(mask), jnp.float32(SIZE), 256)
        return jnp.sum(weights * found.points)

    xyz = tuple(jnp.asarray(points[..., axis]) for axis in range(3))
    slopes = jax.grad(weighted)(xyz)
    found = means(points, time, mask, 256)
    ring = np.broadcast_to(np.arange(2), mask.shape)
    keys = {
        tuple(key): row
        for row, key in enumerate(
            np.c_[found.ring, np.floor(np.asarray(found.points) / SIZE)].astype(int).tolist()
        )
        if found.mask[row]
    }
    members = groups(points, time, mask)
    number = dict.fromkeys(members, 0)
    of_point = {}
    for place, one in zip(*np.nonzero(mask), strict=True):
        key = (int(ring[place, one]), *np.floor(points[place, one] / SIZE).astype(int).tolist())
        of_point[place, one] = key
        number[key] += 1
    for (place, one), key in of_point.items():
        for axis in range(3):
            expected = weights[keys[key], axis] / number[key]
            np.testing.assert_allclose(slopes[axis][place, one], expected, atol=1e-6)
    assert not np.asarray(slopes[0])[~mask].any()
