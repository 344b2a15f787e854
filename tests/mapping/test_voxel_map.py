"""The voxel map against numpy's mean and covariance of the points in each voxel.

Distributions are read back through ``query_nearest`` at the voxel's own mean: no other mean is nearer.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.mapping.voxel_map import VoxelMap, anchor_of, empty_map, find_slots, insert, query_nearest

VOXEL = 1.2
FAR = np.array([8333, -8333, 400])
"""A voxel 10 km from the origin along two axes."""

_insert = jax.jit(insert)
_query = jax.jit(query_nearest)
_find = jax.jit(find_slots)


class Report(NamedTuple):
    """An insertion's report without the padding, in numpy."""

    added: np.ndarray
    dropped: int


def extended(rows: np.ndarray) -> jax.Array:
    """Pad with zeros to a power of two, so that few programs are compiled."""
    size = max(64, 1 << (len(rows) - 1).bit_length())
    return jnp.asarray(np.concatenate([rows, np.zeros((size - len(rows), *rows.shape[1:]), rows.dtype)]))


def put(vmap: VoxelMap, points, anchor=(0, 0, 0), mask=None, reach=1000.0) -> tuple[VoxelMap, Report]:
    count = len(points)
    vmap, report = _insert(
        vmap,
        extended(np.asarray(points, np.float32)),
        extended(np.ones(count, bool) if mask is None else mask),
        jnp.asarray(anchor, jnp.int32),
        jnp.float32(VOXEL),
        jnp.float32(reach),
    )
    added = np.asarray(report.added)
    assert not added[count:].any()
    return vmap, Report(added[:count], int(report.dropped))


def ask(vmap: VoxelMap, points, anchor=(0, 0, 0), min_points=1.0):
    """Return valid, mean and full covariance in numpy; the plane has to be that of the covariance."""
    count = len(points)
    found = _query(
        vmap,
        extended(np.asarray(points, np.float32)),
        jnp.asarray(anchor, jnp.int32),
        jnp.float32(VOXEL),
        jnp.float32(min_points),
    )
    found = jax.tree.map(lambda leaf: np.asarray(leaf)[:count], found)
    covariance = covariances(vmap, voxel_of(found.mean) + np.asarray(anchor))
    covariance[~found.valid] = 0
    for row in np.flatnonzero(found.valid):
        values = np.linalg.eigvalsh(covariance[row])
        along = found.normal[row] @ covariance[row] @ found.normal[row]
        np.testing.assert_allclose(found.variances[row], values[:2], atol=2e-6)
        np.testing.assert_allclose(along, values[0], atol=2e-6)
        np.testing.assert_allclose(np.linalg.norm(found.normal[row]), 1, atol=1e-6)
    return found.valid, found.mean.astype(np.float64), covariance


def covariances(vmap: VoxelMap, voxel) -> np.ndarray:
    """Return the covariance of each voxel's points from the map's sums; zeros for voxels it does not hold."""
    slot = np.asarray(_find(vmap, jnp.asarray(voxel, jnp.int32)))
    moments = np.asarray(vmap.moments, np.float64)[np.maximum(slot, 0)] * (slot >= 0)[:, None]
    count = np.maximum(moments[:, 0], 1)[:, None]
    mean, second = moments[:, 1:4] / count, moments[:, 4:] / count
    covariance = np.zeros((len(slot), 3, 3))
    for column, (i, j) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        covariance[:, i, j] = covariance[:, j, i] = second[:, column] - mean[:, i] * mean[:, j]
    return covariance


def voxel_of(points) -> np.ndarray:
    return np.floor(np.asarray(points, np.float32) / np.float32(VOXEL)).astype(int)


def distributions(points) -> dict[tuple, tuple[int, np.ndarray, np.ndarray]]:
    """Return count, mean and covariance of the points of each voxel, in double precision."""
    points = np.asarray(points, np.float64)
    voxel, member = np.unique(voxel_of(points), axis=0, return_inverse=True)
    result = {}
    for row, key in enumerate(voxel):
        mine = points[member.ravel() == row]
        result[tuple(key.tolist())] = (len(mine), mine.mean(0), np.cov(mine.T, bias=True).reshape(3, 3))
    return result


def one_point_per_cell(half: float, share: float, seed: int) -> np.ndarray:
    """Return points in a cube, at most one in each quarter of a voxel's edge, well inside their cells."""
    rng = np.random.default_rng(seed)
    cell = VOXEL / 4
    axis = np.arange(-int(half / cell), int(half / cell))
    corners = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    corners = corners[rng.random(len(corners)) < share]
    points = (corners + rng.uniform(0.05, 0.95, corners.shape)) * cell
    return rng.permutation(points).astype(np.float32)


def assert_holds(vmap: VoxelMap, points, anchor=(0, 0, 0)) -> None:
    """Assert that the map's distributions are those of the points."""
    expected = distributions(points)
    means = np.array([mean for _, mean, _ in expected.values()])
    valid, mean, covariance = ask(vmap, means, anchor)
    assert valid.all()
    np.testing.assert_allclose(mean, means, atol=2e-6)
    np.testing.assert_allclose(covariance, [c for _, _, c in expected.values()], atol=2e-6)


def filled(points, anchor=(0, 0, 0), capacity=65536) -> VoxelMap:
    """Insert until every cell that waited for the next scan is in."""
    vmap = empty_map(capacity)
    for _ in range(10):
        vmap, report = put(vmap, points, anchor)
        assert report.dropped == 0
        if not report.added.any():
            return vmap
    raise AssertionError("some points never got in")


@pytest.mark.parametrize("share", [0.05, 0.3])
def test_voxels_hold_the_mean_and_covariance_of_their_points(share):
    points = one_point_per_cell(4.0, share, seed=0)
    assert_holds(filled(points), points)


def test_the_first_insertion_adds_nearly_all_points_and_reports_which():
    points = one_point_per_cell(4.0, 0.2, seed=1)
    vmap, report = put(empty_map(65536), points)
    added = report.added
    assert added.mean() > 0.85
    assert_holds(vmap, points[added])


def test_mean_and_covariance_run_on_over_several_scans():
    points = one_point_per_cell(3.0, 0.3, seed=2)
    vmap = empty_map(65536)
    taken = []
    for scan in np.array_split(points, 4):
        vmap, report = put(vmap, scan)
        taken.append(scan[report.added])
    assert_holds(vmap, np.concatenate(taken))


def test_the_same_points_again_add_nothing():
    points = one_point_per_cell(3.0, 0.2, seed=3)
    vmap = filled(points)
    again, report = put(vmap, points)
    assert not report.added.any()
    for before, after in zip(jax.tree.leaves(vmap), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(after, before)


def test_other_points_in_the_same_cells_add_nothing():
    points = one_point_per_cell(3.0, 0.2, seed=4)
    vmap = filled(points)
    cell = np.floor(points / np.float32(VOXEL / 4))
    moved = (cell + np.random.default_rng(5).uniform(0.1, 0.9, points.shape)) * (VOXEL / 4)
    again, report = put(vmap, moved)
    assert not report.added.any()
    assert_holds(again, points)


def test_of_many_points_in_a_cell_one_is_taken():
    rng = np.random.default_rng(6)
    points = np.float32(VOXEL / 4) * (np.array([2, 1, 3]) + rng.uniform(0.1, 0.9, (100, 3)))
    vmap, report = put(empty_map(64), points)
    added = report.added
    assert added.sum() == 1
    assert_holds(vmap, points[added])


def test_a_dense_scan_fills_each_cell_once():
    """A wall hit by 20,000 points: its voxels hold 16 evenly spread points each, for every density."""
    rng = np.random.default_rng(7)
    points = np.stack([np.full(20000, 0.65), *rng.uniform(-2.4, 2.4, (2, 20000))], -1)
    vmap = empty_map(1024)
    added = 0
    for _ in range(4):
        vmap, report = put(vmap, points)
        added += int(report.added.sum())
    assert added == 16 * 16
    valid, mean, covariance = ask(vmap, [[0.65, 0.6, 0.6]], min_points=16.0)
    assert valid.all()
    np.testing.assert_allclose(mean[0], [0.65, 0.6, 0.6], atol=0.06)
    values, vectors = np.linalg.eigh(covariance[0])
    assert values[0] < 1e-6
    np.testing.assert_allclose(np.abs(vectors[:, 0]), [1, 0, 0], atol=1e-2)
    np.testing.assert_allclose(values[1:], VOXEL**2 / 12, rtol=0.2)


def test_masked_rows_are_not_inserted():
    points = one_point_per_cell(2.0, 0.3, seed=8)
    mask = np.random.default_rng(9).random(len(points)) < 0.5
    vmap, report = put(empty_map(2048), points, mask=mask)
    added = report.added
    assert not (added & ~mask).any()
    assert_holds(vmap, points[added])


@pytest.mark.parametrize("filler", [np.nan, np.inf, -np.inf, 0.0, 1e30])
def test_what_stands_in_masked_rows_does_not_matter(filler):
    points = one_point_per_cell(2.0, 0.3, seed=10)
    mask = np.arange(len(points)) % 3 > 0
    spoiled = np.where(mask[:, None], points, np.float32(filler))
    vmap, report = put(empty_map(2048), spoiled, mask=mask)
    assert_holds(vmap, points[report.added])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(vmap))


def test_an_empty_scan_changes_nothing():
    points = one_point_per_cell(2.0, 0.3, seed=11)
    vmap = filled(points)
    after, report = put(vmap, np.full((50, 3), np.nan), mask=np.zeros(50, bool))
    assert report.dropped == 0
    for one, other in zip(jax.tree.leaves(vmap), jax.tree.leaves(after), strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_empty_map_answers_nothing():
    valid, mean, covariance = ask(empty_map(64), np.random.default_rng(0).uniform(-5, 5, (20, 3)))
    assert not valid.any()
    assert np.isfinite(mean).all()
    assert np.isfinite(covariance).all()


def nearest_of_four(point, held) -> np.ndarray | None:
    """Return the nearest mean among the point's voxel and the face neighbours on the nearer sides."""
    own = voxel_of(point)
    side = np.where(point / VOXEL - own > 0.5, 1, -1)
    candidates = [own, *(own + side[axis] * np.eye(3, dtype=int)[axis] for axis in range(3))]
    means = [held[key][1] for key in (tuple(c.tolist()) for c in candidates) if key in held]
    return min(means, key=lambda mean: np.linalg.norm(mean - point)) if means else None


@pytest.mark.parametrize("min_points", [1, 4])
def test_query_returns_the_nearest_mean_of_the_four_voxels(min_points):
    points = one_point_per_cell(4.0, 0.06, seed=12)
    vmap = filled(points)
    held = {key: value for key, value in distributions(points).items() if value[0] >= min_points}
    queries = np.random.default_rng(13).uniform(-4.5, 4.5, (3000, 3)).astype(np.float32)
    valid, mean, _ = ask(vmap, queries, min_points=min_points)
    expected = [nearest_of_four(q.astype(float), held) for q in queries]
    assert 0.02 < np.mean([e is None for e in expected]) < 0.98
    np.testing.assert_array_equal(valid, [e is not None for e in expected])
    wanted = np.array([e for e in expected if e is not None])
    np.testing.assert_allclose(mean[valid], wanted, atol=2e-6)


def test_query_on_the_other_side_of_a_voxel_face_finds_the_voxel():
    points = np.random.default_rng(14).uniform(0.05, 1.15, (40, 3))
    vmap, _ = put(empty_map(64), points)
    for axis in range(3):
        for outside in (-0.1, VOXEL + 0.1):
            query = np.full(3, 0.6)
            query[axis] = outside
            assert ask(vmap, [query])[0].all()
            query[axis] = outside + np.sign(outside) * VOXEL
            assert not ask(vmap, [query])[0].any()


@pytest.mark.parametrize("anchor", [FAR, -FAR, [100000, 0, 0]])
def test_ten_kilometres_away_is_as_precise_as_the_origin(anchor):
    points = one_point_per_cell(4.0, 0.2, seed=15)
    assert_holds(filled(points, anchor), points, anchor)


def test_the_anchor_may_move_between_insertion_and_query():
    points = one_point_per_cell(3.0, 0.2, seed=16)
    vmap = filled(points, FAR)
    means = np.array([mean for _, mean, _ in distributions(points).values()])
    step = np.array([40, -25, 3])
    _, mean, covariance = ask(vmap, means - step * VOXEL, FAR + step)
    np.testing.assert_allclose(mean + step * VOXEL, means, atol=2e-5)
    _, _, at_home = ask(vmap, means, FAR)
    np.testing.assert_array_equal(covariance, at_home)


@pytest.mark.parametrize("position", [[0.0, 0.0, 0.0], [-0.1, 2.5, 7.3], [10000.3, -9999.9, 123.4]])
def test_anchor_is_the_voxel_below_the_position(position):
    anchor, corner = anchor_of(jnp.asarray(position, jnp.float64), jnp.float64(VOXEL))
    offset = np.asarray(position) - np.asarray(corner)
    assert ((offset >= -1e-9) & (offset < VOXEL + 1e-9)).all()
    np.testing.assert_allclose(np.asarray(anchor) * VOXEL, corner, rtol=1e-15)
    assert corner.dtype == jnp.float64


def seen_from(points: np.ndarray, sensor: np.ndarray | None, vmap: VoxelMap | None = None) -> VoxelMap:
    vmap = empty_map(64) if vmap is None else vmap
    points, mask = jnp.asarray(points, jnp.float32), jnp.ones(len(points), bool)
    where = None if sensor is None else jnp.asarray(sensor, jnp.float32)
    size, reach = jnp.float32(VOXEL), jnp.float32(1000)
    return insert(vmap, points, mask, jnp.zeros(3, jnp.int32), size, reach, where)[0]


def is_surface(vmap: VoxelMap) -> bool:
    near = jnp.full((1, 3), 0.6, jnp.float32)
    found = query_nearest(vmap, near, jnp.zeros(3, jnp.int32), jnp.float32(VOXEL), jnp.float32(1))
    assert found.valid[0]
    assert found.count[0] > 0
    return bool(found.surface[0])


def test_a_plane_that_contains_its_sensor_is_no_surface_until_it_is_seen_from_elsewhere():
    """One beam of a turning sensor at height 0.6 m sweeps around the corner of a house."""
    along = np.linspace(0.05, 1.15, 8)
    corner = np.concatenate([np.stack([np.full(8, 0.1), along], -1), np.stack([along, np.full(8, 0.1)], -1)])
    swept = np.column_stack([corner, 0.6 + 0.005 * np.sin(np.arange(16.0))])
    sensor = np.array([-20.0, -15.0, 0.6])
    assert not is_surface(seen_from(swept, sensor))
    assert is_surface(seen_from(swept, None))
    assert is_surface(seen_from(swept, sensor + np.array([0, 0, 8.0])))
    # a floor is there after all
    x, y = np.meshgrid(along, along)
    floor = np.column_stack([x.ravel(), y.ravel(), 0.6 + 0.005 * np.cos(np.arange(64.0))])
    above = np.array([-2.0, -1.0, 2.4])
    assert is_surface(seen_from(floor, above, seen_from(swept, sensor)))
