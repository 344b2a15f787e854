"""Clouds are written as other programs read them."""

import numpy as np
import pytest
from pypcd4 import Encoding, PointCloud

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.run.map_file import read_cloud, write_cloud
from tests.run.clouds import read_ply

POINTS = np.random.default_rng(0).normal(size=(1000, 3)).astype(np.float32)


def test_a_pcd_written_in_parts_is_the_librarys_own_byte_for_byte(tmp_path):
    write_cloud(tmp_path / "ours.pcd", iter(np.array_split(POINTS, 7)), 1000)
    PointCloud.from_xyz_points(POINTS).save(tmp_path / "theirs.pcd", encoding=Encoding.BINARY)
    assert (tmp_path / "ours.pcd").read_bytes() == (tmp_path / "theirs.pcd").read_bytes()
    np.testing.assert_array_equal(read_cloud(tmp_path / "ours.pcd"), POINTS)


@pytest.mark.parametrize("name", ["map.ply", "MAP.PLY"])
def test_a_ply_written_in_parts(tmp_path, name):
    write_cloud(tmp_path / name, iter(np.array_split(POINTS, 7)), 1000)
    np.testing.assert_array_equal(read_ply(tmp_path / name), POINTS)


@pytest.mark.parametrize("ending", ["pcd", "ply"])
def test_no_points_make_a_valid_file(tmp_path, ending):
    path = tmp_path / f"map.{ending}"
    write_cloud(path, [], 0)
    assert (read_cloud(path) if ending == "pcd" else read_ply(path)).shape == (0, 3)


def test_an_unknown_ending(tmp_path):
    with pytest.raises(UsageError, match=r"map\.las: a map's name ends in \.pcd or \.ply; choose one"):
        write_cloud(tmp_path / "map.las", [POINTS], 1000)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("count", [999, 1001])
def test_a_wrong_count_leaves_nothing(tmp_path, count):
    with pytest.raises(ValueError, match=f"1000 points came where {count}"):
        write_cloud(tmp_path / "map.pcd", [POINTS], count)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"holiday", None])
def test_what_is_no_pcd_is_said_in_a_sentence(tmp_path, content):
    path = tmp_path / "map.pcd"
    if content is None:
        write_cloud(path, [POINTS], 1000)
        content = path.read_bytes()[:-5]
    path.write_bytes(content)
    with pytest.raises(
        LioJaxError, match=r"map\.pcd: cannot be read as a PCD \(.+\); write it again\.$"
    ) as raised:
        read_cloud(path)
    assert "\n" not in str(raised.value)
