"""Every fault of a recording gives one clear sentence and the right exit status."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from lio_jax.data.trajectory import write_tum
from tests.commands.conftest import PLAIN
from tests.data import bags
from tests.run.small_drive import (
    COUNT,
    bag_messages,
    extrinsics,
    moving,
    shifted,
    standing,
    truth,
    without_points,
    write_folder,
    write_kitti,
    write_kitti_raw,
)


@pytest.fixture
def run(cli, tmp_path):
    """Return a function that runs a recording and gives back what was done and its metrics, if any."""

    def start(data, *words):
        out = tmp_path / "out"
        done = cli("run", data, "--out", out, *PLAIN, *words)
        metrics = out / "metrics.json"
        return done, json.loads(metrics.read_text()) if metrics.exists() else None

    return start


def _refused(done):
    """Return the one sentence of a failed job."""
    assert done.status == 1
    assert done.out == ""
    assert "Traceback" not in done.err
    *notes, sentence = done.err.splitlines()
    assert all(note.startswith("note: ") for note in notes)
    assert sentence.startswith("lio-jax: ")
    assert "unexpected" not in sentence
    return sentence


def _warnings(done):
    assert done.status == 0, done.err
    assert "Traceback" not in done.err
    return [line.removeprefix("warning: ") for line in done.err.splitlines() if line.startswith("warning: ")]


def test_no_recording(run, tmp_path):
    sentence = _refused(run(tmp_path / "nothing")[0])
    assert sentence == f"lio-jax: {tmp_path / 'nothing'}: no such file or folder; check the path."


def test_folder_of_an_unknown_layout(run, tmp_path):
    (tmp_path / "holiday.jpg").touch()
    assert "the layout is not known; looked for a KITTI odometry sequence" in _refused(run(tmp_path)[0])


def test_zero_byte_scan_and_truncated_scan(run, tmp_path):
    data = write_kitti(tmp_path / "04", standing())
    (data / "velodyne" / "000005.bin").write_bytes(b"")
    path = data / "velodyne" / "000008.bin"
    path.write_bytes(path.read_bytes()[:-7])
    done, metrics = run(data)
    warnings = _warnings(done)
    assert len(warnings) == 3
    assert f"{data / 'velodyne' / '000005.bin'}: the file is empty (0 bytes): an empty scan." in warnings
    assert any(
        warning.startswith("scan 5: it holds no points; the pose is the prediction") for warning in warnings
    )
    assert any("000008.bin: truncated" in warning for warning in warnings)
    assert metrics["scans"] == COUNT
    assert [failure["scan"] for failure in metrics["failures"]] == [5]


@pytest.mark.parametrize("write", [write_kitti, write_kitti_raw])
def test_missing_scans_kitti(run, tmp_path, write):
    data = write(tmp_path / "drive", standing())
    scans = data / ("velodyne" if write is write_kitti else "velodyne_points/data")
    for number in (3, 4, 8):
        next(scans.glob(f"*00{number}.bin")).unlink()
    done, metrics = run(data)
    [warning] = _warnings(done)
    digits = 6 if write is write_kitti else 10
    assert warning == (
        f"{scans}: scan(s) {3:0{digits}d}-{4:0{digits}d}, {8:0{digits}d} are missing and were skipped."
    )
    assert metrics["scans"] == COUNT - 3


def test_missing_scans_native(run, tmp_path):
    data = write_folder(tmp_path / "drive", moving())
    (data / "scans" / "000005.npz").unlink()
    done, metrics = run(data)
    assert _warnings(done) == [f"{data / 'scans'}: scan(s) 000005 are missing and were skipped."]
    # the gap is bridged by the velocity: measured 0.014 m, without a gap 0.013 m
    assert metrics["ate"]["rmse"] < 0.03


def test_no_scans_left(run, tmp_path):
    data = write_folder(tmp_path / "drive", moving()[:2])
    shutil.rmtree(data / "scans")
    assert "holds no scans (NNNNNN.npz); give a complete native folder." in _refused(run(data)[0])


def test_unreadable_scan(run, tmp_path):
    data = write_folder(tmp_path / "drive", moving())
    path = data / "scans" / "000005.npz"
    path.write_bytes(path.read_bytes()[:1000])
    done, metrics = run(data)
    [warning] = _warnings(done)
    assert warning.startswith(f"{path}: cannot be read (")
    assert metrics["scans"] == COUNT - 1


def test_all_scans_unreadable(run, tmp_path):
    data = write_folder(tmp_path / "drive", moving()[:3])
    for path in (data / "scans").iterdir():
        path.write_bytes(b"noise")
    done, metrics = run(data)
    sentence = _refused(done)
    assert f"{data}: no scan could be read. {data / 'scans' / '000000.npz'}: cannot be read" in sentence
    assert metrics is None
    assert not (tmp_path / "out").exists()


def test_points_that_are_not_finite_in_a_bin(run, tmp_path):
    data = write_kitti(tmp_path / "04", standing())
    for number in range(COUNT):
        path = data / "velodyne" / f"{number:06d}.bin"
        rows = np.fromfile(path, np.float32).reshape(-1, 4)
        rows[::9, 0], rows[4::9, 2] = np.nan, np.inf
        rows.tofile(path)
    done, metrics = run(data)
    assert _warnings(done) == []
    assert metrics["failures"] == []


def test_points_that_are_not_finite(run, tmp_path):
    scans = []
    for scan in moving():
        points = scan.points.copy()
        for first, bad in enumerate((np.nan, np.inf, -np.inf)):
            points[3 * first :: 27, 1] = bad
        scans.append(replace(scan, points=points))
    done, metrics = run(write_folder(tmp_path / "drive", scans))
    assert _warnings(done) == []
    assert metrics["failures"] == []
    assert metrics["ate"]["rmse"] < 0.05


def test_scan_of_nothing_but_nan(run, tmp_path):
    scans = list(moving())
    scans[6] = replace(scans[6], points=np.full_like(scans[6].points, np.nan))
    done, metrics = run(write_folder(tmp_path / "drive", scans))
    [warning] = _warnings(done)
    assert warning.startswith("scan 6: it holds no points")
    assert metrics["scans"] == COUNT


def test_empty_scan_in_the_middle(run, tmp_path):
    scans = list(moving())
    scans[6] = without_points(scans[6])
    done, metrics = run(write_folder(tmp_path / "drive", scans))
    assert _warnings(done) == ["scan 6: it holds no points; the pose is the prediction."]
    assert metrics["scans"] == COUNT
    # measured: 0.015 m
    assert metrics["ate"]["rmse"] < 0.03


def test_scans_out_of_order(run, tmp_path):
    scans = list(moving())
    scans[5], scans[6] = scans[6], scans[5]
    data = write_folder(tmp_path / "drive", scans)
    done, metrics = run(data)
    [warning] = _warnings(done)
    assert warning.startswith(f"{data / 'scans' / '000006.npz'} (")
    assert "is 0.100 s older than" in warning
    assert warning.endswith("out of order, skipped.")
    assert metrics["scans"] == COUNT - 1
    assert metrics["ate"]["rmse"] < 0.03


def test_duplicate_stamps(run, tmp_path):
    scans = [*moving()[:5], moving()[4], *moving()[5:]]
    data = write_folder(tmp_path / "drive", scans)
    done, metrics = run(data)
    [warning] = _warnings(done)
    assert "000005.npz has the same stamp as" in warning
    assert warning.endswith("the duplicate was dropped.")
    assert metrics["scans"] == COUNT
    assert metrics["ate"]["rmse"] < 0.03


def test_many_warnings_are_cut_short(run, tmp_path):
    scans = [scan for scan in moving()[:9] for _ in range(2)]
    done, metrics = run(write_folder(tmp_path / "drive", scans))
    shown = _warnings(done)
    assert len(shown) == 6
    assert shown[-1] == "4 more of these; metrics.json lists them all."
    assert len(metrics["warnings"]) == 9


def test_stamps_that_jump_back_a_day(run, tmp_path):
    scans = [*moving()[:6], *(shifted(scan, -86_400_000_000_000) for scan in moving()[6:])]
    done, metrics = run(write_folder(tmp_path / "drive", scans))
    assert "6" not in str(done.status)
    assert len(metrics["warnings"]) == 6
    assert metrics["scans"] == 6


@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3"])
def test_truncated_bag(run, tmp_path, name):
    bag = bags.write_bag(tmp_path / name, bag_messages(moving(), bags.is_ros2(tmp_path / name)))
    file = bag if bag.is_file() else next(path for path in bag.iterdir() if path.suffix == f".{name[2:]}")
    file.write_bytes(file.read_bytes()[: int(0.6 * file.stat().st_size)])
    done, metrics = run(bag)
    if done.status == 1:
        assert "the bag was not closed properly or is truncated" in _refused(done)
        assert "reindex" in done.err or "recover" in done.err
        assert metrics is None
    else:
        # a database cut short still holds its first pages
        [warning] = _warnings(done)
        assert "the bag is damaged after scan" in warning
        assert 0 < metrics["scans"] < COUNT


def test_empty_bag(run, tmp_path):
    (tmp_path / "a.bag").touch()
    assert _refused(run(tmp_path / "a.bag")[0]) == (
        f"lio-jax: {tmp_path / 'a.bag'}: is empty (0 bytes); record or copy the bag again."
    )


def test_bag_that_is_something_else(run, tmp_path):
    (tmp_path / "a.bag").write_text("<html>404 not found</html>")
    assert "a.bag: not a ROS bag, although its name ends in .bag" in _refused(run(tmp_path / "a.bag")[0])


def test_topic_that_does_not_exist(run, tmp_path):
    rows = bag_messages(moving()[:2], False)
    bag = bags.write_bag(
        tmp_path / "a.bag", [*rows, ("/imu/data", moving()[0].stamp_ns, bags.imu_message(1, False))]
    )
    sentence = _refused(run(bag, "--set", "config.data.lidar_topic=/velodyne_points")[0])
    assert "config.data.lidar_topic='/velodyne_points' is not in the bag; its topics are" in sentence
    assert "/points (sensor_msgs/msg/PointCloud2, 2)" in sentence
    assert "/imu/data (sensor_msgs/msg/Imu, 1)" in sentence


def test_topic_of_another_type(run, tmp_path):
    rows = bag_messages(moving()[:2], False)
    imu = ("/imu/data", moving()[0].stamp_ns, bags.imu_message(1, False))
    bag = bags.write_bag(tmp_path / "a.bag", [*rows, imu])
    sentence = _refused(run(bag, "--set", "config.data.lidar_topic=/imu/data")[0])
    assert "is sensor_msgs/msg/Imu, not a point cloud" in sentence


def test_bag_without_point_clouds(run, tmp_path):
    bag = bags.write_bag(tmp_path / "a.bag", [("/imu/data", 10**9, bags.imu_message(10**9, False))])
    sentence = _refused(run(bag)[0])
    assert "no topic holds point clouds" in sentence
    assert "/imu/data (sensor_msgs/msg/Imu, 1)" in sentence


def test_two_lidar_topics(run, tmp_path):
    rows = bag_messages(moving(), False, "/top/points") + bag_messages(moving()[:3], False, "/rear/points")
    bag = bags.write_bag(tmp_path / "a.bag", sorted(rows, key=lambda row: row[1]))
    done, metrics = run(bag)
    assert done.status == 0
    assert (
        "note: lidar: topic /top/points was taken (12 messages); there is also "
        "/rear/points (sensor_msgs/msg/PointCloud2, 3): "
        "choose with --set config.data.lidar_topic=/rear/points" in done.err
    )
    assert metrics["scans"] == COUNT


def test_faults_in_the_messages_of_a_bag(run, tmp_path):
    scans = list(moving())
    points = scans[2].points.copy()
    points[::9] = np.nan
    scans[2] = replace(scans[2], points=points)
    scans[6] = without_points(scans[6])
    rows = bag_messages(scans, True)
    topic, _, duplicate = rows[8]
    rows.insert(9, (topic, rows[8][1] + 1, duplicate))
    # published again long after: out of order
    rows.append((topic, rows[-1][1] + 1, rows[3][2]))
    bag = bags.write_bag(tmp_path / "a.db3", rows)
    write_tum(tmp_path / "truth.tum", truth())
    done, metrics = run(bag, "--set", *extrinsics(), "--gt", tmp_path / "truth.tum")
    warnings = "\n".join(_warnings(done))
    assert "a: scan 9 has the same stamp as a: scan 8" in warnings
    assert "out of order, skipped." in warnings
    assert "holds no points" in warnings
    assert metrics["scans"] == COUNT
    assert metrics["ate"]["rmse"] < 0.05


def test_output_on_a_full_or_forbidden_disk(folder, cli, tmp_path, monkeypatch):
    from lio_jax.run import logs as trajectory_log

    def refuse(file, **arrays):
        raise OSError(28, "No space left on device", str(file))

    monkeypatch.setattr(trajectory_log.np, "savez_compressed", refuse)
    done = cli("run", folder, "--scans", 2, *PLAIN, "--out", tmp_path / "out")
    # what was computed is written and summed up; the command fails all the same
    assert done.status == 1
    sentence = done.err.splitlines()[-1]
    assert ".npz" in sentence
    assert (tmp_path / "out" / "trajectory.tum").exists()
    assert "No space left on device; check the path, its permissions and the free space." in sentence
    assert not [path for path in (tmp_path / "out").iterdir() if path.name.startswith(".")]
