"""The map is spooled to disk and becomes one PCD."""

import numpy as np
from pypcd4 import PointCloud

from lio_jax.run.map_file import MapFile

POINTS = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)


def test_points_come_back_in_order(tmp_path):
    map_file = MapFile(tmp_path / "map.pcd")
    for part in np.array_split(POINTS, 7):
        map_file.append(part)
    map_file.append(POINTS[:0])
    np.testing.assert_array_equal(map_file.write(), POINTS)
    map_file.close()
    np.testing.assert_array_equal(PointCloud.from_path(tmp_path / "map.pcd").numpy(("x", "y", "z")), POINTS)
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.pcd"]


def test_half_a_point_of_an_interrupted_append_is_left_out(tmp_path):
    map_file = MapFile(tmp_path / "map.pcd")
    map_file.append(POINTS)
    map_file._spool.write(b"half a point"[:7])
    np.testing.assert_array_equal(map_file.write(), POINTS)
    map_file.close()


def test_map_without_points_is_a_valid_file(tmp_path):
    map_file = MapFile(tmp_path / "map.pcd")
    assert map_file.write().shape == (0, 3)
    map_file.close()
    assert PointCloud.from_path(tmp_path / "map.pcd").points == 0


def test_closing_without_finishing_leaves_nothing(tmp_path):
    map_file = MapFile(tmp_path / "map.pcd")
    map_file.append(POINTS)
    map_file.close()
    assert list(tmp_path.iterdir()) == []
