"""``lio-jax fuse`` on files, and what it says of wrong ones."""

import json

import numpy as np
import pytest

from lio_jax.cli import main
from lio_jax.data.trajectory import read_tum, write_tum
from tests.fusion import made_drive as made

HEADER = "t,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z"


def write_imu(path, imu, gyro=1.0, accel=1.0, order=None):
    table = np.column_stack([imu.stamp_ns * 1e-9, imu.gyro * gyro, imu.accel * accel])
    table = table if order is None else table[order]
    np.savetxt(path, table, delimiter=",", fmt="%.9f", header=HEADER, comments="")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    drive = made.made_drive(seed=1, seconds=12.0)
    folder = tmp_path_factory.mktemp("fuse")
    write_tum(folder / "odometry.tum", drive.odometry)
    write_tum(folder / "truth.tum", drive.truth)
    write_imu(folder / "imu.csv", drive.imu)
    sigma = np.full(len(drive.gps.position), made.GPS_SIGMA)
    np.savetxt(folder / "gps.txt", np.column_stack([drive.gps.stamp_ns * 1e-9, drive.gps.position, sigma]))
    return folder


def test_a_run_folder_is_written(folder, capsys):
    out = folder / "out"
    words = ["fuse", folder / "odometry.tum", "--imu", folder / "imu.csv", "--gps", folder / "gps.txt"]
    words += ["--truth", folder / "truth.tum", "--out", out, "--set", "params.odometry.rotation_noise=0.002"]
    assert main([str(word) for word in words]) == 0
    assert "KITTI" in capsys.readouterr().out
    fused, odometry = read_tum(out / "trajectory.tum"), read_tum(folder / "odometry.tum")
    # the frames of the input: the same first pose, but for its white noise
    assert len(fused) == len(odometry) - 1 or len(fused) == len(odometry)
    np.testing.assert_allclose(fused.poses[0], odometry.poses[0], atol=1e-3)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["status"] == "converged"
    assert metrics["ate"]["rmse"] < 0.3
    states = np.load(out / "states.npz")
    assert states["covariance"].shape == (len(fused), 6, 6)
    truth = read_tum(folder / "truth.tum")
    level = read_tum(out / "trajectory_gps.tum")
    assert np.linalg.norm(level.positions - truth.positions[: len(level)], axis=1).max() < 1.0
    assert {"config.yaml", "trajectory_imu.tum", "trajectory.png"} <= {path.name for path in out.iterdir()}


def lines(path, change):
    path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


BAD = {
    "unsorted poses": (
        "odometry.tum",
        lambda rows: [rows[1], rows[0], *rows[2:]],
        "does not ascend at pose 2",
    ),
    "a column less in the poses": ("odometry.tum", lambda rows: [*rows[:5], rows[5][:-12]], "line 6"),
    "unsorted samples": (
        "imu.csv",
        lambda rows: [*rows[:9], rows[10], rows[9], *rows[11:]],
        "ascend at sample",
    ),
    "NaN in the samples": ("imu.csv", lambda rows: [*rows[:9], "1.5,nan,0,0,0,0,9.8", *rows[9:]], "imu.csv"),
    "a column less in the samples": ("imu.csv", lambda rows: [*rows[:9], "1.5,0,0,0,0,0"], "line 10"),
    "unsorted fixes": ("gps.txt", lambda rows: rows[::-1], "ascend at line 2"),
    "NaN in the fixes": ("gps.txt", lambda rows: [rows[0], "3 nan 0 0 1", *rows[1:]], "line 2"),
    "six columns of fixes": ("gps.txt", lambda rows: [f"{row} 1" for row in rows], "6 columns"),
    "fixes of another clock": ("gps.txt", lambda rows: [f"9{row}" for row in rows], "no GPS fix lies within"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_wrong_file_is_named_in_one_sentence(folder, tmp_path, capsys, kind):
    name, change, expected = BAD[kind]
    for file in ("odometry.tum", "imu.csv", "gps.txt"):
        (tmp_path / file).write_text((folder / file).read_text())
    lines(tmp_path / name, change)
    words = [tmp_path / "odometry.tum", "--imu", tmp_path / "imu.csv", "--gps", tmp_path / "gps.txt"]
    assert main(["fuse", *map(str, words), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert expected in said
    assert said.endswith(".")
    assert not (tmp_path / "out").exists()


def test_other_units_and_another_clock_are_named(folder, tmp_path, capsys):
    drive = made.made_drive(seed=1, seconds=12.0)
    for factors, expected in (((60.0, 1.0), "deg/s"), ((1.0, 100.0), "gravity is 9.8")):
        write_imu(tmp_path / "imu.csv", drive.imu, *factors)
        words = ["fuse", str(folder / "odometry.tum"), "--imu", str(tmp_path / "imu.csv")]
        assert main([*words, "--out", str(tmp_path / "out")]) == 1
        assert expected in capsys.readouterr().err
    lines(tmp_path / "imu.csv", lambda rows: [rows[0], *(f"9{row}" for row in rows[1:])])
    assert main([*words, "--out", str(tmp_path / "out")]) == 1
    assert "gravity" in capsys.readouterr().err
    write_imu(tmp_path / "imu.csv", drive.imu)
    lines(tmp_path / "imu.csv", lambda rows: [rows[0], *(f"9{row}" for row in rows[1:])])
    assert main([*words, "--out", str(tmp_path / "out")]) == 1
    assert "same clock" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("assignment", "expected"),
    [
        ("params.imu.gyro_nose=1", "is no setting"),
        ("params.imu.gyro_noise=-1", "greater than zero"),
        ("params.gps.lever_arm=1", "list"),
        ("params.extrinsics.rotation=[1,1,0,0]", "unit quaternion"),
    ],
)
def test_a_wrong_setting_is_wrong_usage(folder, tmp_path, capsys, assignment, expected):
    words = ["fuse", str(folder / "odometry.tum"), "--imu", str(folder / "imu.csv"), "--set", assignment]
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert expected in capsys.readouterr().err
