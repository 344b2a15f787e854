"""An inspection finds the faults that were put into a recording, and none in a healthy one."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.inspection import settings_text
from lio_jax.settings.settings import load_settings
from tests.inspection.walk import Change, inspected, turned, walk, with_imu, with_scans


def _without_points(number, scan):
    none = slice(0, 12 if number == 9 else None)
    names = ("points", "time", "ring", "intensity")
    return replace(scan, **{name: getattr(scan, name)[none] for name in names})


def _with_nan(gyro):
    return np.where(np.arange(len(gyro))[:, None] == 50, np.nan, gyro)


_BIT = 200
"""Samples in a second."""

CORRUPTED: dict[str, tuple[Change, str]] = {
    "accelerometer in g": (
        with_imu(lambda imu: replace(imu, accel=imu.accel / 9.80665)),
        "the accelerometer is in g",
    ),
    "gyroscope in deg/s": (
        with_imu(lambda imu: replace(imu, gyro=np.degrees(imu.gyro))),
        "57 times as fast as the scans: it is in deg/s",
    ),
    "gyroscope at half its rates": (
        with_imu(lambda imu: replace(imu, gyro=imu.gyro / 2)),
        "the gyroscope's rates are 0.50 times those of the scans",
    ),
    "axes rotated": (
        with_imu(lambda imu: replace(imu, gyro=imu.gyro[:, [1, 2, 0]], accel=imu.accel[:, [1, 2, 0]])),
        "the recording's T_imu_lidar is wrong by 120 deg",
    ),
    "one axis of the wrong sign": (
        with_imu(lambda imu: replace(imu, gyro=imu.gyro * [1, -1, 1])),
        "mirror image of the lidar's: one axis has the wrong sign",
    ),
    "extrinsic a quarter turn off": (
        lambda walk: turned(walk, 90.0, "z"),
        "the recording's T_imu_lidar is wrong by 90 deg",
    ),
    "extrinsic 10 deg off": (
        lambda walk: turned(walk, 10.0, "x"),
        "the recording's T_imu_lidar is wrong by 10 deg",
    ),
    "clock late by 80 ms": (
        with_imu(lambda imu: replace(imu, stamp_ns=imu.stamp_ns + 80_000_000)),
        "the gyroscope's clock differs from the scans' by +0.0",
    ),
    "another clock": (
        with_imu(lambda imu: replace(imu, stamp_ns=imu.stamp_ns + 10**12)),
        "do not overlap in time, the first sample is 1000.000 s after",
    ),
    "a hole in the samples": (
        with_imu(
            lambda imu: replace(
                imu,
                stamp_ns=np.delete(imu.stamp_ns, np.s_[_BIT : _BIT + 60]),
                gyro=np.delete(imu.gyro, np.s_[_BIT : _BIT + 60], axis=0),
                accel=np.delete(imu.accel, np.s_[_BIT : _BIT + 60], axis=0),
            )
        ),
        "1 gap(s) without IMU samples (usually one every 5.0 ms): 0.305 s",
    ),
    "samples that are not numbers": (
        with_imu(lambda imu: replace(imu, gyro=_with_nan(imu.gyro))),
        "1 IMU sample(s) held NaN or infinity, the first at 0.250 s",
    ),
    "accelerometer of the opposite sign": (
        with_imu(lambda imu: replace(imu, accel=-imu.accel)),
        "the specific force points down",
    ),
    "a scan missing": (
        with_scans(lambda number, scan: None if number == 12 else scan),
        "1 step(s) between consecutive scans are too long, the longest 0.200 s",
    ),
    "a scan of 12 points": (
        with_scans(_without_points),
        "1 of 32 sampled scans hold fewer than 1000 points (first: scan 9)",
    ),
    "one ring for all": (
        with_scans(lambda number, scan: replace(scan, ring=np.zeros_like(scan.ring))),
        "all points carry the same ring",
    ),
    "one time for all": (
        with_scans(lambda number, scan: replace(scan, time=np.zeros_like(scan.time))),
        "all points of a scan carry one time although a sweep takes 0.100 s",
    ),
}


def test_a_healthy_recording_gives_no_suspicion(tmp_path):
    found = inspected(tmp_path, walk())
    assert found.problems == []
    assert found.suggested_config == ["--recipe default"]
    assert found.missing == {"default": [], "fast_lio2": [], "lio_sam": [], "loam": []}
    turns = found.turns
    assert turns is not None
    # measured: 0.998, 0.3 deg of sigma 0.8, -2 ms of sigma 2.4
    assert turns["correlation"] > 0.99
    assert turns["off_deg"] < 3 * turns["rotation_sigma_deg"] < 6.0
    assert abs(turns["time_offset"]) < 4 * turns["time_offset_sigma"] < 0.02
    assert turns["scale"] == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("name", CORRUPTED)
def test_every_corruption_of_a_recording_is_reported(name, tmp_path):
    change, sentence = CORRUPTED[name]
    problems = inspected(tmp_path, change(walk())).problems
    assert any(sentence in problem for problem in problems), problems


def test_the_rotation_between_unknown_axes_is_found(tmp_path):
    true = walk().T_imu_lidar[:3, :3]
    mounted = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    axes = with_imu(lambda imu: replace(imu, gyro=imu.gyro @ mounted.T, accel=imu.accel @ mounted.T))
    found = inspected(tmp_path, replace(axes(walk()), T_imu_lidar=None))
    settings_file = tmp_path / "fits.yaml"
    settings_file.write_text(settings_text(found))
    settings = load_settings(settings_file)
    suggested = Rotation.from_quat(settings.values["extrinsics"]["rotation"])
    apart = np.degrees((suggested.inv() * Rotation.from_matrix(mounted @ true)).magnitude())
    # quarter turns are taken where they are near: the sensor itself is tilted by 3.1 deg
    assert apart < 3.5
    assert "#    translation: [X,Y,Z]" in settings_file.read_text()


def test_the_offset_between_clocks_is_found(tmp_path):
    late = with_imu(lambda imu: replace(imu, stamp_ns=imu.stamp_ns + 80_000_000))
    found = inspected(tmp_path, late(walk()))
    (tmp_path / "fits.yaml").write_text(settings_text(found))
    settings = load_settings(tmp_path / "fits.yaml")
    # measured: 0.079 s
    assert settings.values["extrinsics"]["time_offset"] == pytest.approx(0.08, abs=0.008)


def test_a_stamp_at_the_other_end_is_named(tmp_path):
    late = with_scans(lambda number, scan: replace(scan, stamp_ns=scan.stamp_ns + 100_000_000))
    problems = inspected(tmp_path, late(walk())).problems
    assert any("is a sweep: the stamp may mark the scan's end" in problem for problem in problems), problems
