"""The map of a run, thinned tile by tile, against thinning all points at once."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lio_jax.run import map_file as map_tiles
from lio_jax.run.map_file import MapTiles, read_cloud


def clouds(count=12, points=800, apart=30.0, seed=0):
    """Return poses and clouds along a way that leads through several tiles, on both sides of the origin."""
    rng = np.random.default_rng(seed)
    made = []
    for number in range(count):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("zyx", rng.normal(size=3)).as_matrix()
        T[:3, 3] = [apart * (number - count / 2), 0.3 * apart * (number - 4), number - 5.0]
        made.append((T, rng.uniform(-25, 25, (points, 3)).astype(np.float32)))
    return made


def world_of(made):
    return np.concatenate([points.astype(np.float64) @ T[:3, :3].T + T[:3, 3] for T, points in made])


def tiled(tmp_path, made, voxel, name="map.pcd"):
    tiles = MapTiles(tmp_path / f"tiles_{name}", voxel)
    for T, points in made:
        tiles.add(T, points)
    written = tiles.write(tmp_path / name)
    return read_cloud(tmp_path / name), written, tiles


def sorted_rows(points):
    return points[np.lexsort(points.T)]


def thinned_at_once(world, voxel):
    """Return the means of the voxels' points, with a dictionary."""
    voxels = {}
    for cell, point in zip(map(tuple, np.floor(world / voxel).astype(int)), world, strict=True):
        voxels.setdefault(cell, []).append(point)
    return np.array([np.mean(points, axis=0) for points in voxels.values()])


@pytest.mark.parametrize("voxel", [0.7, 3.0, 55.0])
def test_each_voxel_holds_the_mean_of_its_points(tmp_path, voxel):
    made = clouds()
    found, written, tiles = tiled(tmp_path, made, voxel)
    expected = thinned_at_once(world_of(made), voxel)
    assert written == len(found) == len(expected)
    assert tiles.taken == 12 * 800
    away, nearest = cKDTree(expected).query(found)
    assert away.max() < 1e-4
    assert len(set(nearest)) == len(expected)


def test_what_is_kept_in_memory_does_not_change_the_map(tmp_path, monkeypatch):
    made = clouds()
    whole, *_ = tiled(tmp_path, made, 1.0, "whole.pcd")
    monkeypatch.setattr(map_tiles, "_KEPT", 1000)
    in_pieces, *_ = tiled(tmp_path, made, 1.0, "pieces.pcd")
    np.testing.assert_array_equal(in_pieces, whole)


def test_the_same_clouds_give_the_same_bytes(tmp_path):
    for name in ("one.ply", "two.ply"):
        tiles = MapTiles(tmp_path / name.partition(".")[0], 0.5)
        for T, points in clouds():
            tiles.add(T, points)
        tiles.write(tmp_path / name)
    assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "two.ply").read_bytes()


def test_finer_maps_have_more_points_and_the_finest_all_of_them(tmp_path):
    made = clouds(4, 300)
    counts = [tiled(tmp_path, made, voxel, f"{voxel}.pcd")[1] for voxel in (20.0, 5.0, 1.0, 0.001)]
    assert counts == sorted(counts)
    assert counts[-1] == 1200
    found, *_ = tiled(tmp_path, made, 0.001, "finest.pcd")
    np.testing.assert_allclose(sorted_rows(found), sorted_rows(world_of(made)), atol=1e-5)


def test_ten_kilometres_from_the_origin_a_millimetre_is_left(tmp_path):
    """A millimetre is the limit of single precision there; the thinning itself loses nothing."""
    [(T, points)] = clouds(1, 500)
    T[:3, 3] = [9000.0, -9000.0, 50.0]
    found, *_ = tiled(tmp_path, [(T, points)], 0.01)
    np.testing.assert_allclose(sorted_rows(found), sorted_rows(world_of([(T, points)])), atol=1e-3)


def test_points_that_are_none_are_left_out(tmp_path):
    [(T, points)] = clouds(1, 100)
    points[3] = np.nan
    points[5, 1] = np.inf
    points[7] = 1e8
    found, written, tiles = tiled(tmp_path, [(T, points), (T, points[:0])], 0.01)
    assert written == tiles.taken == len(found) == 97
    assert np.isfinite(found).all()


def test_no_clouds_at_all(tmp_path):
    found, written, tiles = tiled(tmp_path, [], 1.0)
    assert written == tiles.taken == len(found) == 0
