"""``lio-jax map``: maps of a run at any resolution, and what is wrong with a request."""

import numpy as np
import pytest

from lio_jax.run.keyframes import KeyframeWriter
from lio_jax.run.map_file import read_cloud, write_cloud
from tests.run.clouds import read_ply

RNG = np.random.default_rng(0)
CLOUDS = [RNG.uniform(-20, 20, (500, 3)).astype(np.float32) for _ in range(6)]
CORNER = np.arange(500) % 5 == 0


def poses():
    T = np.tile(np.eye(4), (len(CLOUDS), 1, 1))
    T[:, 0, 3] = 20.0 * np.arange(len(CLOUDS))
    return T


@pytest.fixture
def run_folder(tmp_path):
    """Return a run folder with keyframes."""
    folder = tmp_path / "run"
    folder.mkdir()
    writer = KeyframeWriter(folder)
    for cloud in CLOUDS:
        writer.append(cloud, CORNER)
    odometry = poses() + 1.0
    writer.finish(np.arange(len(CLOUDS)), poses(), odometry)
    return folder


def cells(points, voxel):
    return {tuple(cell) for cell in np.floor(np.asarray(points, np.float64) / voxel).astype(int).tolist()}


@pytest.mark.parametrize("ending", ["pcd", "ply"])
def test_one_point_per_voxel_of_the_corrected_keyframes(cli, run_folder, tmp_path, ending):
    out = tmp_path / "maps" / f"map.{ending}"
    done = cli("map", run_folder, "--voxel", 2, "--out", out)
    assert (done.status, done.err) == (0, "")
    found = read_cloud(out) if ending == "pcd" else read_ply(out)
    world = np.concatenate([cloud + T[:3, 3] for cloud, T in zip(CLOUDS, poses(), strict=True)])
    assert len(found) == len(cells(world, 2))
    assert cells(found, 2) == cells(world, 2)
    assert done.out == f"map     {out}\npoints  {len(found)} of 3000, one per 2 m\n"
    assert [entry.name for entry in out.parent.iterdir()] == [out.name]


def test_parts(cli, run_folder, tmp_path):
    counts = {}
    for part in ("whole", "corner", "surface"):
        out = tmp_path / f"{part}.pcd"
        done = cli("map", run_folder, "--voxel", 0.001, "--out", out, "--part", part)
        assert done.status == 0, done.err
        counts[part] = len(read_cloud(out))
    assert counts == {"whole": 3000, "corner": 600, "surface": 2400}


def test_a_run_without_keyframes_has_its_map(cli, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    points = RNG.uniform(-50, 50, (4000, 3)).astype(np.float32)
    write_cloud(folder / "map.pcd", [points], len(points))
    done = cli("map", folder, "--voxel", 5, "--out", tmp_path / "map.ply")
    assert done.status == 0
    assert done.err == (
        f"note: {folder}: the run kept no keyframes; its map.pcd is taken, no finer than it was saved.\n"
    )
    assert cells(read_ply(tmp_path / "map.ply"), 5) == cells(points, 5)


def refused(done, status):
    assert done.status == status
    assert done.out == ""
    [sentence] = done.err.splitlines()
    assert sentence.startswith("lio-jax: ")
    assert "unexpected" not in sentence
    return sentence.removeprefix("lio-jax: ")


@pytest.mark.parametrize("voxel", ["0", "-0.1", "nan", "inf", "1e-6"])
def test_impossible_sizes(cli, run_folder, tmp_path, voxel):
    done = cli("map", run_folder, f"--voxel={voxel}", "--out", tmp_path / "map.pcd")
    assert refused(done, 2) == f"--voxel must be 0.001 m or more, not {float(voxel):g}."
    assert not (tmp_path / "map.pcd").exists()


def test_a_size_that_is_no_number(cli, run_folder, tmp_path):
    done = cli("map", run_folder, "--voxel", "fine", "--out", tmp_path / "map.pcd")
    assert refused(done, 2) == "map: --voxel must be a number, not 'fine'."


@pytest.mark.parametrize("name", ["map.las", "map"])
def test_an_unknown_ending(cli, run_folder, tmp_path, name):
    done = cli("map", run_folder, "--out", tmp_path / name)
    assert refused(done, 2) == f"{tmp_path / name}: a map's name ends in .pcd or .ply; choose one of them."


def test_a_file_that_exists_is_replaced_if_asked_for(cli, run_folder, tmp_path):
    out = tmp_path / "map.pcd"
    out.write_text("precious")
    assert "exists already" in refused(cli("map", run_folder, "--out", out), 2)
    assert out.read_text() == "precious"
    assert cli("map", run_folder, "--out", out, "--overwrite").status == 0
    assert len(read_cloud(out))


def test_no_run_folder(cli, tmp_path):
    for folder in (tmp_path / "nothing", tmp_path):
        sentence = refused(cli("map", folder, "--out", tmp_path / "map.pcd"), 1)
        assert sentence == (
            f"{folder}: holds neither keyframes/ nor map.pcd; give a folder that lio-jax run wrote."
        )


def test_corners_of_a_run_that_kept_only_its_map(cli, tmp_path):
    write_cloud(tmp_path / "map.pcd", [CLOUDS[0]], 500)
    done = cli("map", tmp_path, "--out", tmp_path / "corner.pcd", "--part", "corner")
    assert "does not separate corners from surfaces" in refused(done, 1)


def test_an_unfinished_run_and_a_damaged_keyframe(cli, run_folder, tmp_path):
    (run_folder / "keyframes" / "000004.npz").write_bytes(b"")
    out = tmp_path / "map.pcd"
    assert "000004.npz: cannot be read" in refused(cli("map", run_folder, "--out", out), 1)
    (run_folder / "keyframes" / "index.npz").unlink()
    assert "index.npz: missing, the run was ended" in refused(cli("map", run_folder, "--out", out), 1)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == ["run"]


def test_a_run_without_points(cli, tmp_path):
    write_cloud(tmp_path / "map.pcd", [], 0)
    done = cli("map", tmp_path, "--out", tmp_path / "thin.pcd")
    assert done.err.splitlines()[-1] == (
        f"lio-jax: {tmp_path}: the run kept no points; there is no map to write."
    )
    assert done.status == 1
    assert [entry.name for entry in tmp_path.iterdir()] == ["map.pcd"]
