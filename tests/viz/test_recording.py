import os
import subprocess
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.viz import recording as recording_module
from lio_jax.viz.recording import BYTES_PER_POINT, ViewerRecording

TURN = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
SIGMA = TURN @ np.diag([0.01, 0.02, 0.05]) ** 2 @ TURN.T
EPOCH_NS = 1_317_000_000_000_000_001
PERIOD_NS = 100_000_000


def pose(index: int):
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec([0.01 * index, 0.02 * index, 0.1 * index]).as_matrix()
    result[:3, 3] = [index, 2.0 * index, 0.5]
    return result


def write(path, scans: int, points: int = 20_000):
    generator = np.random.default_rng(0)
    cloud = generator.normal(scale=20.0, size=(points, 3)).astype(np.float32)
    corners = np.arange(points) < points // 4
    with ViewerRecording(path, scan_count=scans) as recording:
        recording.log_truth(np.array([pose(index)[:3, 3] for index in range(scans)]))
        for index in range(scans):
            stamp_ns = EPOCH_NS + index * PERIOD_NS
            recording.log_scan(index, stamp_ns, cloud, pose(index), raw=cloud + 1.0, corners=corners)
            recording.log_added(index, stamp_ns, cloud[:100] + 100.0 * index)
            recording.log_pose(index, stamp_ns, "world/imu", pose(index))
            recording.log_sigma(SIGMA)
            recording.log_unobserved(np.eye(3)[: index % 2])
            recording.log_metrics(
                index, stamp_ns, {"times/step": 10.0 + index, "state/bias": [1.0, 2.0, 3.0]}
            )
    return cloud


def rows(path, entity: str) -> list[dict]:
    from rerun.chunk import RrdReader

    found = []
    for chunk in RrdReader(path).stream():
        if chunk.entity_path == entity:
            found += chunk.to_record_batch().to_pylist()
    return found


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("recording") / "recording.rrd"
    return path, write(path, 40)


def test_entities_and_time_lines(written):
    from rerun.chunk import RrdReader

    path, _ = written
    lines: dict[str, set[str]] = {}
    for chunk in RrdReader(path).stream():
        lines.setdefault(chunk.entity_path, set()).update(chunk.timeline_names)
    moving = {
        "/world/lidar",
        "/world/lidar/scan",
        "/world/lidar/raw",
        "/world/lidar/corners",
        "/world/lidar/surfaces",
        "/world/lidar/unobserved",
        "/world/imu",
        "/world/imu/position_100_sigma",
        "/world/added",
        "/world/map/00",
        "/world/trajectory",
        "/metrics/times/step",
        "/metrics/state/bias",
    }
    assert moving | {"/world", "/world/truth"} <= set(lines)
    assert all(lines[entity] == {"scan", "time"} for entity in moving)
    assert lines["/world/truth"] == set()
    assert len(RrdReader(path).blueprints()) == 1


def test_poses_come_back_at_their_nanosecond(written):
    path, _ = written
    logged = rows(path, "/world/lidar")
    assert [row["scan"] for row in logged] == list(range(40))
    assert [np.datetime64(row["time"].value, "ns").astype(int) for row in logged] == [
        EPOCH_NS + index * PERIOD_NS for index in range(40)
    ]
    for index, row in enumerate(logged):
        matrix = Rotation.from_quat(row["Transform3D:quaternion"][0]).as_matrix()
        np.testing.assert_allclose(matrix, pose(index)[:3, :3], atol=1e-6)
        np.testing.assert_allclose(row["Transform3D:translation"][0], pose(index)[:3, 3], atol=1e-5)


def test_scans_are_thinned_evenly_and_coloured(written):
    path, cloud = written
    first = next(row for row in rows(path, "/world/lidar/scan") if "Points3D:positions" in row)
    points = np.array(first["Points3D:positions"])
    assert len(points) == len(first["Points3D:colors"]) == 5_000
    # The pose of scan 0 is the identity, and every thinned point is one of the cloud's, from start to end.
    np.testing.assert_array_equal(points[[0, -1]].astype(np.float32), cloud[[0, -1]])
    assert len(set(first["Points3D:colors"])) > 50


def test_trajectory_ends_complete(written):
    path, _ = written
    strip = np.array(rows(path, "/world/trajectory")[-1]["LineStrips3D:strips"][0])
    np.testing.assert_allclose(strip, [pose(index)[:3, 3] for index in range(40)], atol=1e-5)


def test_the_map_grows_in_pieces_that_stay(written):
    path, cloud = written
    for index in range(40):
        (row,) = rows(path, f"/world/map/{index:02d}")
        np.testing.assert_allclose(row["Points3D:positions"], cloud[:100] + 100.0 * index, atol=1e-3)
        # a piece is complete when the next scan comes
        assert row["scan"] == min(index + 1, 39)


def test_truth_is_there_at_all_times(written):
    path, _ = written
    assert len(rows(path, "/world/truth")[0]["LineStrips3D:strips"][0]) == 40


def test_features_are_apart(written):
    path, cloud = written
    counts = [
        len(rows(path, f"/world/lidar/{kind}")[0]["Points3D:positions"]) for kind in ("corners", "surfaces")
    ]
    assert counts == [len(cloud) // 4, 5_000]
    raw = np.array(rows(path, "/world/lidar/raw")[0]["Points3D:positions"])
    np.testing.assert_allclose(raw[0], cloud[0] + 1.0, atol=1e-5)


def test_the_ellipsoid_is_the_covariance_enlarged(written):
    path, _ = written
    row = rows(path, "/world/imu/position_100_sigma")[0]
    axes = Rotation.from_quat(row["Ellipsoids3D:quaternions"][0]).as_matrix()
    sizes = np.array(row["Ellipsoids3D:half_sizes"][0])
    np.testing.assert_allclose(axes @ np.diag(sizes**2) @ axes.T, 100.0**2 * SIGMA, atol=1e-4)


def test_open_directions_come_and_go(written):
    path, _ = written
    arrows = [row["Arrows3D:vectors"] for row in rows(path, "/world/lidar/unobserved")]
    assert [len(vectors or ()) for vectors in arrows] == [index % 2 for index in range(40)]


def test_metrics_come_back(written):
    path, _ = written
    logged = rows(path, "/metrics/times/step")
    assert [row["Scalars:scalars"][0] for row in logged] == [10.0 + index for index in range(40)]
    assert rows(path, "/metrics/state/bias")[3]["Scalars:scalars"] == [1.0, 2.0, 3.0]


def test_the_blueprint_shows_what_is_logged(written):
    from lio_jax.viz.recording import ADDED, PLOTS, RAW

    path, _ = written
    entities = _entities(path)
    assert {f"/{RAW}", f"/{ADDED}"} <= entities
    assert all(
        any(entity.startswith(f"/{PLOTS[name]}/") for entity in entities) for name in ("state", "times")
    )


def test_clouds_stay_within_their_budget(tmp_path, monkeypatch):
    budget = 4_000_000
    monkeypatch.setattr(recording_module, "CLOUD_BUDGET_BYTES", budget)
    for scans in (20, 400):
        path = tmp_path / f"{scans}.rrd"
        write(path, scans)
        clouds = rows(path, "/world/lidar/scan")
        # the others: a map of 100 points a scan, poses and metrics
        assert path.stat().st_size < budget + 8_000 * scans
        assert 0.5 * budget < sum(len(row["Points3D:positions"]) for row in clouds) * BYTES_PER_POINT
        assert len(rows(path, "/world/lidar")) == len(rows(path, "/metrics/times/step")) == scans
    # of the long one not every scan
    assert 50 < len(clouds) < 400


def _entities(path) -> set[str]:
    from rerun.chunk import RrdReader

    return {chunk.entity_path for chunk in RrdReader(path).stream()}


def test_long_recordings_get_fewer_points_a_scan(tmp_path):
    cloud = np.zeros((20_000, 3), np.float32)
    with ViewerRecording(tmp_path / "long.rrd", scan_count=5_000) as recording:
        recording.log_scan(0, 0, cloud, np.eye(4))
    first = next(
        row for row in rows(tmp_path / "long.rrd", "/world/lidar/scan") if "Points3D:positions" in row
    )
    assert len(first["Points3D:positions"]) == 1_000


def test_strips_stay_linear_in_the_length_of_the_run(tmp_path):
    point = np.zeros((1, 3), np.float32)
    with ViewerRecording(tmp_path / "long.rrd") as recording:
        for index in range(2_000):
            recording.log_scan(index, index, point, np.eye(4))
    lengths = [len(row["LineStrips3D:strips"][0]) for row in rows(tmp_path / "long.rrd", "/world/trajectory")]
    assert lengths[-1] == 2_000
    assert sum(lengths) < 40 * 2_000


def test_empty_scan_and_empty_map_are_recorded(tmp_path):
    with ViewerRecording(tmp_path / "empty.rrd") as recording:
        recording.log_scan(0, 0, np.zeros((0, 3), np.float32), np.eye(4))
        recording.log_added(0, 0, np.zeros((0, 3), np.float32))
    assert len(rows(tmp_path / "empty.rrd", "/world/lidar")) == 1


def test_pose_that_is_not_finite_is_left_out(tmp_path):
    with ViewerRecording(tmp_path / "diverged.rrd") as recording:
        recording.log_scan(0, 0, np.zeros((1, 3), np.float32), np.eye(4))
        recording.log_scan(1, 1, np.zeros((1, 3), np.float32), np.full((4, 4), np.nan))
    assert [row["scan"] for row in rows(tmp_path / "diverged.rrd", "/world/lidar")] == [0]


def test_nothing_is_left_when_the_run_fails(tmp_path):
    def run():
        with ViewerRecording(tmp_path / "failed.rrd") as recording:
            recording.log_scan(0, 0, np.zeros((1, 3), np.float32), np.eye(4))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run()
    assert list(tmp_path.iterdir()) == []


def test_file_has_its_name_only_when_it_is_whole(tmp_path):
    path = tmp_path / "recording.rrd"
    recording = ViewerRecording(path)
    recording.log_scan(0, 0, np.zeros((1, 3), np.float32), np.eye(4))
    assert not path.exists()
    recording.close()
    recording.close()
    assert [entry.name for entry in tmp_path.iterdir()] == ["recording.rrd"]


def test_folder_that_does_not_exist_is_an_error(tmp_path):
    with pytest.raises(LioJaxError, match=r"nowhere/recording\.rrd"):
        ViewerRecording(tmp_path / "nowhere" / "recording.rrd")


def test_logging_after_close_is_an_error(tmp_path):
    recording = ViewerRecording(tmp_path / "closed.rrd")
    recording.close()
    with pytest.raises(LioJaxError, match=r"closed\.rrd: the recording is closed"):
        recording.log_metrics(0, 0, {"scan_ms": 1.0})


# The runtime inside rerun wakes itself through a local socket pair: only network sockets count.
NETWORK_SOCKETS = """
import os
from pathlib import Path
def network_sockets():
    tables = [Path("/proc/self/net") / kind for kind in ("tcp", "tcp6", "udp", "udp6")]
    lines = [line for table in tables if table.exists() for line in table.read_text().splitlines()[1:]]
    inodes = {f"socket:[{line.split()[9]}]" for line in lines}
    entries = [entry for entry in Path("/proc/self/fd").glob("*") if entry.exists()]
    return [entry for entry in entries if os.readlink(entry) in inodes]
"""


def test_neither_prints_nor_talks_nor_touches_home(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    code = NETWORK_SOCKETS + (
        "import sys\n"
        "import numpy as np\n"
        "from lio_jax.viz.recording import ViewerRecording\n"
        "with ViewerRecording(Path(sys.argv[1])) as recording:\n"
        "    recording.log_scan(0, 0, np.zeros((9, 3), np.float32), np.eye(4))\n"
        "    assert not network_sockets()\n"
        "import rerun\n"
        "assert rerun.get_global_data_recording() is None\n"
    )
    environment = {key: value for key, value in os.environ.items() if key != "CI"}
    environment |= {"HOME": str(home), "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", code, str(tmp_path / "recording.rrd")]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(home.iterdir()) == []
