"""The map of one point per voxel against a dictionary, and its cube."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from lio_jax.mapping.hash_slots import FREE, claim_slots, find_slots, free_keys
from lio_jax.mapping.point_map import EDGE, PointMap, empty_map, insert, move_cube

VOXEL = 0.5
BLOCK = EDGE * VOXEL
WIDE = 1e6
SIZE = 2048

_insert = jax.jit(insert)
_move = jax.jit(move_cube)


def put(pmap: PointMap, points, anchor=(0, 0, 0), mask=None, half_side=WIDE, nearer_by=0.0):
    """Insert points of the frame anchored at ``anchor``: the map, which were added, how many had no room."""
    count = len(points)
    mask = np.ones(count, bool) if mask is None else np.asarray(mask)
    rows = np.zeros((SIZE, 3), np.float32)
    rows[:count] = points
    pmap, report = _insert(
        pmap,
        jnp.asarray(rows),
        jnp.asarray(np.concatenate([mask, np.zeros(SIZE - count, bool)])),
        jnp.asarray(anchor, jnp.int32),
        jnp.float32(VOXEL),
        jnp.float32(half_side),
        jnp.float32(nearer_by),
    )
    added = np.asarray(report.added)
    assert not added[count:].any()
    return pmap, added[:count], int(report.dropped)


def held(pmap: PointMap, voxel_size: float = VOXEL) -> np.ndarray:
    """Return all points of the map in world, (n, 3) m."""
    point = np.asarray(pmap.point, float).reshape(-1, 3, EDGE**3)
    centre = (np.asarray(pmap.block, float) + 0.5) * EDGE * voxel_size
    full = np.isfinite(point[:, 0])
    return (point + centre[:, :, None]).transpose(0, 2, 1)[full]


def voxel_of(points) -> np.ndarray:
    return np.floor(np.asarray(points, float) / VOXEL).astype(int)


def off_centre(points) -> np.ndarray:
    return np.linalg.norm(points - (voxel_of(points) + 0.5) * VOXEL, axis=1)


def nearest_to_centres(points) -> np.ndarray:
    """Return, sorted, the point nearest its voxel's centre for each voxel."""
    order = np.argsort(off_centre(points), kind="stable")
    _, first = np.unique(voxel_of(points)[order], axis=0, return_index=True)
    return by_place(np.asarray(points)[order][first])


def by_place(points) -> np.ndarray:
    return points[np.lexsort(voxel_of(points).T)]


def cloud(count: int, half: float, seed: int) -> np.ndarray:
    """Return points clear of voxel faces, so that rounding cannot move them over."""
    points = np.random.default_rng(seed).uniform(-half, half, (count, 3))
    clear = np.abs(points / VOXEL - np.round(points / VOXEL)).min(1) > 1e-3
    return points[clear].astype(np.float32)


@pytest.mark.parametrize("half", [0.7, 3.0, 20.0])
def test_each_voxel_holds_the_point_nearest_its_centre(half):
    points = cloud(SIZE, half, seed=0)
    pmap = empty_map(65536)
    for scan in np.array_split(points, 3):
        pmap, added, dropped = put(pmap, scan)
        assert dropped == 0
        # those that were just added are in the map
        assert cKDTree(held(pmap)).query(scan[added])[0].max(initial=0) < 1e-5
    np.testing.assert_allclose(by_place(held(pmap)), nearest_to_centres(points), atol=2e-6)


def test_the_order_of_the_points_does_not_matter():
    points = cloud(1500, 1.5, seed=1)
    one, _, _ = put(empty_map(4096), points)
    other, _, _ = put(empty_map(4096), points[::-1])
    np.testing.assert_array_equal(one.off_centre, other.off_centre)
    np.testing.assert_array_equal(one.point, other.point)


def test_the_same_points_again_add_nothing():
    points = cloud(1500, 3.0, seed=2)
    pmap, _, _ = put(empty_map(65536), points)
    again, added, _ = put(pmap, points)
    assert not added.any()
    for before, after in zip(jax.tree.leaves(pmap), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(before, after)


@pytest.mark.parametrize(("gain", "taken"), [(0.04, False), (0.06, True)])
def test_a_point_replaces_another_only_if_it_is_nearer_by_the_margin(gain, taken):
    centre = np.full(3, VOXEL / 2)
    pmap, _, _ = put(empty_map(64), np.array([[0.15, 0, 0]]) + centre, nearer_by=0.05)
    pmap, added, _ = put(pmap, np.array([[0.15 - gain, 0, 0]]) + centre, nearer_by=0.05)
    assert added[0] == taken
    assert len(held(pmap)) == 1


def test_range_noise_does_not_pull_a_surface_to_the_centres():
    """A wall off its voxels' centres, seen a hundred times: the luckiest noise must not win."""
    rng = np.random.default_rng(3)
    wall = np.stack([np.full(400, 0.15), *np.moveaxis(rng.uniform(-5, 5, (400, 2)), 1, 0)], 1)
    shift = []
    for nearer_by in (0.0, 0.1):
        pmap = empty_map(4096)
        for _ in range(50):
            pmap, _, _ = put(pmap, wall + rng.normal(0, 0.02, (400, 1)) * [1, 0, 0], nearer_by=nearer_by)
        shift.append(float(held(pmap)[:, 0].mean() - 0.15))
    assert shift[0] > 0.02
    assert abs(shift[1]) < 0.006


@pytest.mark.parametrize("filler", [np.nan, np.inf, -np.inf, 1e30])
def test_what_stands_in_masked_rows_does_not_matter(filler):
    points = cloud(600, 2.0, seed=4)
    mask = np.arange(len(points)) % 3 > 0
    pmap, added, dropped = put(empty_map(4096), np.where(mask[:, None], points, filler), mask=mask)
    assert dropped == 0
    assert not added[~mask].any()
    np.testing.assert_allclose(by_place(held(pmap)), nearest_to_centres(points[mask]), atol=2e-6)


def test_an_empty_scan_changes_nothing():
    pmap, _, _ = put(empty_map(4096), cloud(500, 2.0, seed=5))
    after, _, _ = put(pmap, np.full((10, 3), np.nan), mask=np.zeros(10, bool))
    for one, other in zip(jax.tree.leaves(pmap), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("anchor", [(6667, -6667, 300), (-100000, 0, 0)])
def test_ten_kilometres_away_is_as_precise_as_the_origin(anchor):
    points = cloud(1500, 3.0, seed=6)
    pmap, _, _ = put(empty_map(65536), points, anchor)
    at_home, _, _ = put(empty_map(65536), points)
    far = by_place(held(pmap) - np.array(anchor) * BLOCK)
    np.testing.assert_allclose(far, by_place(held(at_home)), atol=1e-6)


def test_a_full_table_counts_dropped_points_and_keeps_its_own():
    points = cloud(600, 4.0, seed=7)
    pmap, _, first = put(empty_map(16), points)
    assert first > 0
    before = by_place(held(pmap))
    pmap, _, dropped = put(pmap, cloud(600, 4.0, seed=8) + np.float32(30.0))
    assert dropped > 0
    assert {tuple(p) for p in before.tolist()} <= {tuple(p) for p in held(pmap).tolist()}


def test_the_cube_stays_while_the_sensor_is_inside_its_margin():
    pmap, _, _ = put(empty_map(4096), cloud(500, 5.0, seed=9))
    moved = _move(pmap, jnp.array([12, -12, 3], jnp.int32), jnp.float32(20.0), jnp.float32(8.0))
    for one, other in zip(jax.tree.leaves(pmap), jax.tree.leaves(moved), strict=True):
        np.testing.assert_array_equal(one, other)


def test_near_a_face_the_cube_moves_along_that_axis_and_what_falls_out_is_deleted():
    points = cloud(2000, 29.0, seed=10)
    pmap, _, _ = put(empty_map(65536), points, half_side=20.0)
    sensor = np.array([13, -12, 3])
    moved = _move(pmap, jnp.asarray(sensor, jnp.int32), jnp.float32(20.0), jnp.float32(8.0))
    np.testing.assert_array_equal(moved.cube, [13, 0, 0])
    expected = nearest_to_centres(points)
    block = np.floor(expected / BLOCK)
    stays = (np.abs(block - [13, 0, 0]) <= 20).all(1)
    assert 0.1 < stays.mean() < 0.9
    np.testing.assert_allclose(by_place(held(moved)), expected[stays], atol=2e-6)
    gone = np.asarray(moved.block)[:, 0] == FREE
    assert not np.isfinite(np.asarray(moved.point)[gone]).any()
    # coming back finds nothing
    back = _move(moved, jnp.zeros(3, jnp.int32), jnp.float32(20.0), jnp.float32(8.0))
    assert len(held(back)) == len(held(moved)[(np.abs(np.floor(held(moved) / BLOCK)) <= 20).all(1)])


def test_points_outside_the_cube_are_left_out():
    _, added, dropped = put(empty_map(64), [[0.1, 0.1, 0.1], [8.0, 0.1, 0.1]], half_side=3.0)
    assert added.tolist() == [True, False]
    assert dropped == 0


def test_slots_that_were_freed_are_claimed_again():
    pmap = empty_map(64)
    for drive in range(6):
        anchor = (200 * drive, 0, 0)
        pmap = _move(pmap, jnp.asarray(anchor, jnp.int32), jnp.float32(20.0), jnp.float32(10.0))
        points = cloud(100, 2.0, seed=drive)
        pmap, _, dropped = put(pmap, points, anchor, half_side=20.0)
        assert dropped < 30
        there = held(pmap) - np.array(anchor) * BLOCK
        assert (np.abs(there) < 3.0).all()
        assert cKDTree(nearest_to_centres(points)).query(there)[0].max() < 1e-5


def test_keys_that_share_a_bucket_are_told_apart():
    """A table of one bucket: two keys fit, the third does not, none is taken for another."""
    wanted = jnp.asarray(np.random.default_rng(0).integers(-50, 50, (3, 3)), jnp.int32)
    keys, slot = claim_slots(free_keys(2), wanted, jnp.ones(3, bool))
    slot = np.asarray(slot)
    assert sorted(slot.tolist()) == [-1, 0, 1]
    np.testing.assert_array_equal(np.asarray(keys)[slot[slot >= 0]], np.asarray(wanted)[slot >= 0])
    np.testing.assert_array_equal(find_slots(keys, wanted), slot)
    np.testing.assert_array_equal(find_slots(keys, wanted + 1), -1)


def test_claims_of_one_key_share_its_slot():
    rng = np.random.default_rng(1)
    wanted = jnp.asarray(rng.integers(-4, 4, (500, 3)), jnp.int32)
    mask = rng.random(500) < 0.8
    keys, slot = claim_slots(free_keys(4096), wanted, jnp.asarray(mask))
    slot = np.asarray(slot)
    assert (slot[~mask] == -1).all()
    assert (slot[mask] >= 0).mean() > 0.95
    placed = mask & (slot >= 0)
    np.testing.assert_array_equal(np.asarray(keys)[slot[placed]], np.asarray(wanted)[placed])
    assert len(set(slot[placed].tolist())) == len(np.unique(np.asarray(wanted)[placed], axis=0))
