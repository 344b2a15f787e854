"""Inspections of the real recordings, and of files that are not recordings."""

import json

import pytest

from lio_jax.cli import main
from tests.shared_data import SHARED_DATA, needs_shared

pytestmark = needs_shared

RECORDINGS = {
    "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync": {"scans": 60, "rings": 64, "imu_samples": 154},
    "kitti_raw/2011_09_26/2011_09_26_drive_0060_sync": {"scans": 10, "rings": 64, "imu_samples": 78},
    "kitti_odometry/sequences/04": {"scans": 20, "rings": 64, "imu_samples": 0, "truth_poses": 271},
    "ouster/os1_128_3scans.bag": {"scans": 3, "rings": 128, "imu_samples": 30, "turns": None},
}

TOLD = {
    "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync": "the IMU runs at 10 Hz only",
    "kitti_raw/2011_09_26/2011_09_26_drive_0060_sync": "the IMU runs at 10 Hz only",
    "ouster/os1_128_3scans.bag": "no calibration to the lidar",
}

NO_RECORDINGS = [
    "README.md",
    "g2o",
    "g2o/intel.g2o",
    "imu_static",
    "imu_static/adis16405_unit1.npz",
    "kiss_icp_kitti_00",
    "newer_college",
    "newer_college/raw_00.bin",
    "newer_college/imu_100hz.txt",
    "kitti_odometry/poses",
    "kitti_odometry/sequences/04/velodyne",
]


@pytest.mark.parametrize("path", RECORDINGS)
def test_recordings_are_described(path, capsys):
    assert main(["inspect", str(SHARED_DATA / path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {name: found[name] for name in RECORDINGS[path]} == RECORDINGS[path]
    said = " ".join(found["problems"])
    assert TOLD.get(path, "") in said
    # all are of upright sensors, read with the right units and times
    for wrong in ("deg/s", "check its unit", "points down", "mirror", "T_imu_lidar is wrong", "time_unit"):
        assert wrong not in said


def test_the_turning_drive_agrees_with_its_calibration(capsys):
    path = SHARED_DATA / "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync"
    assert main(["inspect", str(path), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    turns = found["turns"]
    # measured: 0.995 over 36 intervals, scale 1.00
    assert turns["correlation"] > 0.98
    assert turns["scale"] == pytest.approx(1.0, abs=0.05)
    assert not turns["mirrored"]
    # a car on a level road
    assert found["tilt_deg"] < 3.0


def test_the_real_bag_names_topics_and_fields(capsys):
    assert main(["inspect", str(SHARED_DATA / "ouster/os1_128_3scans.bag"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [(topic["name"], topic["messages"]) for topic in found["topics"]] == [
        ("/ouster/imu", 30),
        ("/ouster/points", 3),
    ]
    assert {"x f4", "t u4", "ring u1"} <= set(found["point_fields"])
    # 3 x 131,072 points, zeros where nothing returned
    assert found["dropped_share"] == pytest.approx(0.18, abs=0.005)
    assert sum(found["range_shares"].values()) == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("path", NO_RECORDINGS)
def test_what_is_no_recording_is_refused_in_one_sentence(path, capsys):
    assert main(["inspect", str(SHARED_DATA / path)]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"lio-jax: {SHARED_DATA / path}: ")
    assert said.count("\n") == 1
