"""Every kind of recording runs through ``lio-jax run``."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.data.trajectory import write_tum
from tests.commands.conftest import PLAIN
from tests.data import bags
from tests.run.small_drive import (
    COUNT,
    bag_messages,
    extrinsics,
    moving,
    standing,
    truth,
    write_kitti,
    write_kitti_raw,
)
from tests.shared_data import SHARED_DATA, needs_shared


def _metrics(out):
    return json.loads((out / "metrics.json").read_text())


@pytest.mark.parametrize("name", ["a.bag", "a.db3", "a.mcap"])
def test_bag_gives_the_trajectory_of_the_native_folder(folder, cli, tmp_path, name):
    bag = bags.write_bag(tmp_path / name, bag_messages(moving(), bags.is_ros2(tmp_path / name)))
    write_tum(tmp_path / "truth.tum", truth())
    done = cli(
        *("run", bag, *PLAIN, *extrinsics(), "--gt", tmp_path / "truth.tum", "--out", tmp_path / "out")
    )
    assert done.status == 0, done.err
    assert "note: per-point time: field 'time', float32 s relative" in done.err
    assert _metrics(tmp_path / "out")["scans"] == COUNT
    # measured: 0.013 m
    assert _metrics(tmp_path / "out")["ate"]["rmse"] < 0.026
    positions = np.loadtxt(tmp_path / "out" / "trajectory.tum")[:, 1:4]
    assert cli("run", folder, *PLAIN, "--out", tmp_path / "native").status == 0
    native = np.loadtxt(tmp_path / "native" / "trajectory.tum")[:, 1:4]
    np.testing.assert_allclose(positions, native, atol=0.01)


@pytest.mark.parametrize("write", [write_kitti, write_kitti_raw])
def test_kitti_layouts(cli, tmp_path, write):
    data = write(tmp_path / "drive", standing())
    done = cli("run", data, *PLAIN, "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert _metrics(tmp_path / "out")["scans"] == COUNT
    positions = np.loadtxt(tmp_path / "out" / "trajectory.tum")[:, 1:4]
    # the vehicle stands; measured: 0.01 m
    assert np.linalg.norm(positions, axis=1).max() < 0.03


@needs_shared
def test_real_kitti_odometry(cli, tmp_path):
    data = SHARED_DATA / "kitti_odometry" / "sequences" / "04"
    done = cli("run", data, "--scans", 6, *PLAIN, "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert "elevation angles raised by 0.205 deg" in done.err
    metrics = _metrics(tmp_path / "out")
    assert metrics["scans"] == 6
    assert metrics["failures"] == metrics["warnings"] == []
    assert metrics["path_length_m"] > 6
    # measured: 0.007 m
    assert metrics["ate"]["rmse"] < 0.015


@needs_shared
def test_real_kitti_raw_of_a_standing_car(cli, tmp_path):
    data = SHARED_DATA / "kitti_raw" / "2011_09_26" / "2011_09_26_drive_0060_sync"
    done = cli("run", data, *PLAIN, "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert "T_imu_lidar: from the recording's calibration." in done.err
    rows = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    assert len(rows) == 10
    assert np.linalg.norm(rows[-1, 1:4] - rows[0, 1:4]) < 0.015
    turn = Rotation.from_quat(rows[0, 4:]).inv() * Rotation.from_quat(rows[-1, 4:])
    assert np.degrees(turn.magnitude()) < 0.05


@needs_shared
def test_real_ouster_bag(cli, tmp_path):
    done = cli("run", SHARED_DATA / "ouster" / "os1_128_3scans.bag", *PLAIN, "--out", tmp_path / "out")
    assert done.status == 0, done.err
    assert "field 't', uint32 ns relative" in done.err
    rows = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    # the sensor moves at about 2.5 m/s
    assert 0.3 < np.linalg.norm(rows[-1, 1:4] - rows[0, 1:4]) < 0.8
