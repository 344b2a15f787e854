"""``lio-jax run`` leaves the run folder it promises."""

import json

import numpy as np
import pytest
import yaml
from pypcd4 import PointCloud
from scipy.spatial.transform import Rotation

from lio_jax.settings.settings import load_settings
from tests.commands.conftest import NOTES, PLAIN
from tests.run.small_drive import COUNT, drive, moving

FILES = {
    "trajectory.tum",
    "trajectory_kitti.txt",
    "states.npz",
    "map.pcd",
    "keyframes.g2o",
    "metrics.json",
    "config.yaml",
    "recording.rrd",
    "trajectory.png",
    "timings.png",
    "scans.npz",
    "truth.tum",
    "report.html",
}


@pytest.fixture(scope="module")
def run(folder, tmp_path_factory):
    """A whole run, as a newcomer would start it."""
    from lio_jax.cli import main

    out = tmp_path_factory.mktemp("run") / "out"
    assert main(["run", str(folder), "--out", str(out)]) == 0
    return out


def _poses(path):
    rows = np.loadtxt(path)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, 3] = rows[:, 1:4]
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 4:]).as_matrix()
    return poses


def _metrics(out):
    return json.loads((out / "metrics.json").read_text())


def test_files_are_all_there_and_nothing_else(run):
    assert {entry.name for entry in run.iterdir()} == FILES
    assert all((run / name).stat().st_size for name in FILES)


def test_trajectory_is_stamped_at_scan_ends_to_the_nanosecond(run):
    lines = (run / "trajectory.tum").read_text().splitlines()
    stamps = [line.split()[0] for line in lines]
    assert stamps == [f"{scan.end_ns // 10**9}.{scan.end_ns % 10**9:09d}" for scan in moving()]
    assert all(len(word.partition(".")[2]) == 9 for line in lines for word in line.split())


def test_trajectory_starts_at_the_origin_and_follows_the_truth(run):
    poses = _poses(run / "trajectory.tum")
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-8)
    ends = np.array([(scan.end_ns - moving()[0].end_ns) * 1e-9 for scan in moving()])
    began = (moving()[0].end_ns - next(drive().scans(0, 1)).stamp_ns) * 1e-9
    true = drive().poses(began + ends)
    expected = np.linalg.inv(true[0]) @ true
    # measured: 0.04 m at most; the first scan, of unknown velocity, is the worst
    assert np.linalg.norm((poses - expected)[:, :3, 3], axis=1).max() < 0.08
    turned = Rotation.from_matrix(np.swapaxes(poses[:, :3, :3], 1, 2) @ expected[:, :3, :3]).magnitude()
    assert turned.max() < 0.02


def test_kitti_poses_are_those_of_the_lidar(run):
    rows = np.loadtxt(run / "trajectory_kitti.txt").reshape(-1, 3, 4)
    expected = _poses(run / "trajectory.tum") @ drive().info.T_imu_lidar
    np.testing.assert_allclose(rows, expected[:, :3], atol=1e-7)


def test_states_have_their_shapes(run):
    states = np.load(run / "states.npz")
    shapes = {name: states[name].shape for name in states.files}
    assert shapes == {
        "stamps_ns": (COUNT,),
        "poses": (COUNT, 4, 4),
        "velocity": (COUNT, 3),
        "biases": (COUNT, 6),
        "gravity": (COUNT, 3),
        "extrinsic": (COUNT, 4, 4),
        "time_offset": (COUNT,),
        "nis": (COUNT,),
        "nis_dof": (COUNT,),
        "covariance": (COUNT, 6, 6),
        "state_covariance": (COUNT, 24, 24),
    }
    assert states["stamps_ns"].dtype == np.int64
    assert states["poses"].dtype == np.float64
    np.testing.assert_allclose(states["poses"], _poses(run / "trajectory.tum"), atol=1e-8)
    np.testing.assert_allclose(states["extrinsic"][-1], drive().info.T_imu_lidar, atol=1e-9)


def test_velocity_is_that_of_the_imu_in_world(run):
    states = np.load(run / "states.npz")
    began = next(drive().scans(0, 1)).stamp_ns
    ends = (states["stamps_ns"] - began) * 1e-9
    origin, ahead, behind = drive().poses(ends[:1]), drive().poses(ends + 0.01), drive().poses(ends - 0.01)
    true = (ahead - behind)[:, :3, 3] / 0.02 @ origin[0, :3, :3]
    assert np.linalg.norm(true[-1]) > 2.0
    # constant velocity lags behind an accelerating vehicle by half a scan and more
    np.testing.assert_allclose(states["velocity"][2:], true[2:], atol=0.5)


def test_map_is_a_point_cloud(run):
    cloud = PointCloud.from_path(run / "map.pcd")
    assert cloud.fields == ("x", "y", "z")
    points = cloud.numpy(("x", "y", "z"))
    assert len(points) > 5000
    assert np.isfinite(points).all()


def test_keyframes_form_a_chain_of_the_trajectory(run):
    lines = [line.split() for line in (run / "keyframes.g2o").read_text().splitlines()]
    vertices = [line for line in lines if line[0] == "VERTEX_SE3:QUAT"]
    edges = [line for line in lines if line[0] == "EDGE_SE3:QUAT"]
    assert len(vertices) + len(edges) == len(lines)
    assert [int(line[1]) for line in vertices] == list(range(len(vertices)))
    assert [(int(line[1]), int(line[2])) for line in edges] == [(i, i + 1) for i in range(len(edges))]
    assert len(edges) == len(vertices) - 1 >= 1
    positions = np.array([line[2:5] for line in vertices], float)
    trajectory = _poses(run / "trajectory.tum")[:, :3, 3]
    assert all(np.linalg.norm(trajectory - position, axis=1).min() < 1e-6 for position in positions)
    for line in edges:
        assert len(line) == 3 + 7 + 21
        information = np.zeros((6, 6))
        information[np.triu_indices(6)] = np.array(line[10:], float)
        assert np.linalg.eigvalsh(information + np.triu(information, 1).T).min() > 0


def test_metrics_hold_what_is_promised(run):
    metrics = _metrics(run)
    assert metrics["scans"] == COUNT
    assert {"decode", "pad", "step", "record", "total"} == set(metrics["scan_ms"])
    assert all(
        0 <= stage["median"] <= stage["p95"] <= stage["p99"] and set(stage) == {"median", "p95", "p99"}
        for stage in metrics["scan_ms"].values()
    )
    assert 0 < metrics["compile_s"] < metrics["wall_s"]
    assert metrics["peak_rss_mb"] > 100
    assert metrics["failures"] == metrics["warnings"] == []
    assert {"rmse", "mean", "max"} <= set(metrics["ate"])
    assert {"rmse", "mean", "max"} <= set(metrics["rpe"])
    # measured: 0.013 m
    assert metrics["ate"]["rmse"] < 0.026
    assert metrics["kitti"] is None


def test_recording_holds_scans_map_trajectory_and_truth(run):
    from rerun.chunk import RrdReader

    rows: dict[str, int] = {}
    for chunk in RrdReader(run / "recording.rrd").stream():
        rows[chunk.entity_path] = rows.get(chunk.entity_path, 0) + chunk.num_rows
    expected = {"lidar", "lidar/scan", "lidar/raw", "imu", "map/00", "trajectory", "truth", "added"}
    assert {f"/world/{entity}" for entity in expected} <= set(rows)
    assert rows["/world/lidar"] == rows["/metrics/times/step"] == rows["/metrics/match/residual_m"] == COUNT


def test_recorded_scans_lie_on_the_recorded_map(run):
    from rerun.chunk import RrdReader
    from scipy.spatial import cKDTree

    def rows(entity):
        chunks = [c for c in RrdReader(run / "recording.rrd").stream() if c.entity_path == entity]
        return [row for chunk in chunks for row in chunk.to_record_batch().to_pylist()]

    def points(row):
        return np.array(row["Points3D:positions"])

    pieces = [row for number in range(COUNT) for row in rows(f"/world/map/{number:02d}")]
    tree = cKDTree(np.concatenate([points(row) for row in pieces]))
    poses = rows("/world/lidar")
    clouds = [row for row in rows("/world/lidar/scan") if row.get("Points3D:positions")]
    expected = np.loadtxt(run / "trajectory_kitti.txt").reshape(-1, 3, 4)
    for pose, cloud, T in list(zip(poses, clouds, expected, strict=True))[4:]:
        rotation = Rotation.from_quat(pose["Transform3D:quaternion"][0]).as_matrix()
        np.testing.assert_allclose(rotation, T[:, :3], atol=1e-5)
        np.testing.assert_allclose(pose["Transform3D:translation"][0], T[:, 3], atol=1e-5)
        world = points(cloud) @ rotation.T + pose["Transform3D:translation"][0]
        assert np.median(tree.query(world)[0]) < 0.3


@pytest.mark.parametrize("name", ["trajectory.png", "timings.png"])
def test_pictures_are_pictures(run, name):
    from matplotlib.image import imread

    picture = imread(run / name)
    assert picture.shape[1] > 800
    assert picture.std() > 0.01


def test_resolved_config_names_every_setting(run):
    tree = yaml.safe_load((run / "config.yaml").read_text())
    assert set(tree) == {"recipe", "config", "params"}
    assert load_settings(run / "config.yaml").as_dict() == tree
    np.testing.assert_allclose(
        tree["params"]["extrinsics"]["translation"], drive().info.T_imu_lidar[:3, 3], atol=1e-12
    )


def test_resolved_config_repeats_the_run_bit_for_bit(run, folder, cli, tmp_path):
    done = cli("run", folder, "--recipe", run / "config.yaml", *PLAIN, "--out", tmp_path / "again")
    assert done.status == 0, done.err
    for name in ("trajectory.tum", "trajectory_kitti.txt", "keyframes.g2o", "map.pcd"):
        assert (tmp_path / "again" / name).read_bytes() == (run / name).read_bytes(), name


def test_two_runs_are_bit_identical(run, folder, cli, tmp_path):
    assert cli("run", folder, *PLAIN, "--out", tmp_path / "again").status == 0
    for name in ("trajectory.tum", "map.pcd", "config.yaml"):
        if name != "config.yaml":
            assert (tmp_path / "again" / name).read_bytes() == (run / name).read_bytes(), name
    one, other = np.load(run / "states.npz"), np.load(tmp_path / "again" / "states.npz")
    for name in one.files:
        assert one[name].tobytes() == other[name].tobytes(), name


def test_evaluating_the_folder_gives_the_metrics(run, folder, cli):
    done = cli("eval", run, folder, "--json")
    assert done.status == 0, done.err
    ate = json.loads(done.out)["ate"]
    # the file holds nine decimals
    assert ate["rmse"] == pytest.approx(_metrics(run)["ate"]["rmse"], abs=1e-8)


def test_report_on_standard_output(folder, cli, tmp_path):
    done = cli("run", folder, *PLAIN, "--out", tmp_path / "out")
    assert f"scans      {COUNT}  (" in done.out
    assert "ATE translation" in done.out
    assert f"results    {tmp_path / 'out'}" in done.out
    assert done.err == NOTES
