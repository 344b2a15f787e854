"""The map of means against PCL's VoxelGrid, worked out by numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.mapping import point_map
from lio_jax.mapping.point_map import EDGE, empty_map, insert, move_cube
from tests.mapping.test_map_derivative import ANCHORS, CLOUDS, SIZE, Moved, assert_reverse_agrees
from tests.mapping.test_point_map import BLOCK, VOXEL, by_place, cloud, held, put, voxel_of


def voxel_grid(points) -> np.ndarray:
    """Return the mean of the points in each leaf, as PCL's VoxelGrid does; sorted by leaf.

    The leaf of a point is floor(p / leaf), counted from the origin of the cloud's frame.
    """
    leaves = {}
    for point in np.asarray(points, float):
        leaves.setdefault(tuple(np.floor(point / VOXEL).astype(int)), []).append(point)
    return by_place(np.array([np.mean(of_leaf, axis=0) for of_leaf in leaves.values()]))


@pytest.mark.parametrize("half", [0.7, 3.0, 20.0])
@pytest.mark.parametrize("parts", [1, 3])
def test_each_voxel_holds_the_mean_of_all_points_put_into_it(half, parts):
    points = cloud(2048, half, seed=0)
    pmap = empty_map(65536, of_means=True)
    filled = 0
    for scan in np.array_split(points, parts):
        full = {tuple(voxel) for voxel in voxel_of(held(pmap))}
        pmap, added, dropped = put(pmap, scan, nearer_by=0.1)
        assert dropped == 0
        np.testing.assert_array_equal(added, [tuple(voxel) not in full for voxel in voxel_of(scan)])
        filled += np.count_nonzero(added)
    np.testing.assert_allclose(by_place(held(pmap)), voxel_grid(points), atol=2e-6)
    assert filled >= len(voxel_grid(points))
    assert float(np.asarray(pmap.count).sum()) == len(points)


def test_the_order_of_the_points_has_no_effect():
    points = cloud(2048, 3.0, seed=1)
    one, other = empty_map(4096, of_means=True), empty_map(4096, of_means=True)
    for scan in np.array_split(points, 4):
        one, _, _ = put(one, scan)
    for scan in np.array_split(points[::-1], 3):
        other, _, _ = put(other, scan)
    np.testing.assert_allclose(by_place(held(one)), by_place(held(other)), atol=2e-6)


def test_masked_points_and_those_outside_of_the_cube_enter_no_mean():
    points = cloud(2048, 12.0, seed=2)
    mask = np.arange(len(points)) % 3 != 0
    blocks = 3
    inside = (np.abs(np.floor(points / BLOCK)) <= blocks).all(axis=1)
    pmap, added, _ = put(empty_map(65536, of_means=True), points, mask=mask, half_side=blocks)
    np.testing.assert_allclose(by_place(held(pmap)), voxel_grid(points[mask & inside]), atol=2e-6)
    np.testing.assert_array_equal(added, mask & inside)


def test_a_forgotten_voxel_begins_anew():
    points = cloud(512, 2.0, seed=3)
    pmap, _, _ = put(empty_map(4096, of_means=True), points)
    away, back = jnp.asarray([100, 0, 0], jnp.int32), jnp.zeros(3, jnp.int32)
    pmap = move_cube(
        move_cube(pmap, away, jnp.float32(5), jnp.float32(1)), back, jnp.float32(5), jnp.float32(1)
    )
    assert len(held(pmap)) == 0
    later = cloud(512, 2.0, seed=4)
    pmap, _, _ = put(pmap, later)
    np.testing.assert_allclose(by_place(held(pmap)), voxel_grid(later), atol=2e-6)


def test_points_without_room_are_counted():
    points = cloud(2048, 20.0, seed=5)
    pmap, _, dropped = put(empty_map(64, of_means=True), points)
    assert dropped + float(np.asarray(pmap.count).sum()) == len(points)
    assert dropped > 0


def drive(parameters, count=3):
    """Return the map after clouds that move with the parameters, its cube moved to each anchor."""
    pmap = empty_map(512, jnp.float64, of_means=True)
    half, margin = jnp.float64(5.0), jnp.float64(3.0)
    anchors = [jnp.asarray(anchor, jnp.int32) for anchor in ([0, 0, 0], [1, 0, 0], [4, 0, 0])]
    assert len(anchors) == len(ANCHORS)
    for (points, directions), anchor in list(zip(CLOUDS, anchors, strict=True))[:count]:
        moving = Moved(points, directions, parameters)(jnp.arange(len(points)))
        mask = jnp.arange(len(points)) % 10 != 0
        inserted, found = insert(pmap, moving, mask, anchor, SIZE, half, jnp.float64(0.01))
        cleared = move_cube(inserted, anchor, half, margin)
        pmap = point_map.following(cleared, pmap, inserted, found.moved, moving, anchor, SIZE)
    return pmap


def test_the_means_follow_their_points():
    at = jnp.asarray([0.01, -0.02])
    slope, last = jax.jacfwd(lambda p: drive(p).point)(at), drive(at)
    known = np.isfinite(np.asarray(last.point))
    assert_reverse_agrees(lambda p: drive(p).point, at, slope, known)
    assert (np.asarray(last.count) > 1).sum() > 100, "means of several points"
    assert (np.isfinite(np.asarray(drive(at, 2).point)) & ~known).sum() > 100, "points are left behind"
    for component in range(2):
        step = 1e-8 * np.eye(2)[component]
        difference = (drive(at + step).point[known] - drive(at - step).point[known]) / 2e-8
        np.testing.assert_allclose(slope[..., component][known], difference, atol=1e-5)


def test_blocks_have_the_voxels_of_the_world():
    assert BLOCK == EDGE * VOXEL
    shifted = cloud(512, 2.0, seed=6)
    near, _, _ = put(empty_map(4096, of_means=True), shifted)
    far, _, _ = put(empty_map(4096, of_means=True), shifted, anchor=(2000, -700, 30))
    moved = held(far) - np.array([2000, -700, 30]) * BLOCK
    np.testing.assert_allclose(by_place(moved), by_place(held(near)), atol=1e-5)
