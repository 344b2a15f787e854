import json
from pathlib import Path

import numpy as np
import pytest

from lio_jax.data import open_sequence, write_native
from lio_jax.data.sequence import ImuData, LidarScan
from lio_jax.data.trajectory import Trajectory
from lio_jax.inspection import Inspection, format_inspection, inspect_sequence
from tests.shared_data import SHARED_DATA, needs_shared

START_NS = 1_700_000_000_000_000_000


def ring_scan(number: int, points: int = 2000) -> LidarScan:
    """A level sweep of 16 rings over 0.1 s, 5 m to 50 m away."""
    azimuth = np.linspace(np.pi, -np.pi, points, endpoint=False)
    reach = np.linspace(5.0, 50.0, points)
    return LidarScan(
        START_NS + number * 100_000_000,
        np.c_[reach * np.cos(azimuth), reach * np.sin(azimuth), np.zeros(points)].astype(np.float32),
        np.linspace(0.0, 0.1, points).astype(np.float32),
        (np.arange(points) % 16).astype(np.int32),
        np.zeros(points, np.float32),
        0.1,
    )


def steady_imu(scale: float = 9.81, rate: float = 200.0, skip: slice | None = None) -> ImuData:
    stamps = START_NS + (np.arange(int(4 * rate)) * (1e9 / rate)).astype(np.int64)
    if skip is not None:
        stamps = np.delete(stamps, skip)
    accel = np.tile([0.0, 0.0, scale], (len(stamps), 1))
    return ImuData(stamps, np.zeros((len(stamps), 3)), accel)


def inspected(path: Path, imu: ImuData | None = None, scans: list[LidarScan] | None = None) -> Inspection:
    recorded = [ring_scan(number) for number in range(40)] if scans is None else scans
    truth = Trajectory(np.array([START_NS], np.int64), np.eye(4)[None])
    write_native(path / "r", recorded, sensor="VLP-16", T_imu_lidar=np.eye(4), imu=imu, truth=truth)
    return inspect_sequence(open_sequence(path / "r"))


def test_a_healthy_recording_is_described(tmp_path: Path) -> None:
    found = inspected(tmp_path, steady_imu())
    assert (found.format, found.sensor, found.scans, found.rings) == ("native", "VLP-16", 40, 16)
    assert found.duration == pytest.approx(4.0)
    assert found.scan_rate == pytest.approx(10.0)
    assert found.points_per_scan == {"min": 2000, "median": 2000.0, "max": 2000}
    assert found.scan_duration == pytest.approx(0.1)
    assert found.range_min == pytest.approx(5.0, abs=1e-4)
    assert found.range_max == pytest.approx(50.0, abs=1e-4)
    assert (found.imu_samples, found.imu_gaps, found.imu_longest_gap) == (800, 0, None)
    assert found.imu_rate == pytest.approx(200.0)
    assert found.accel_magnitude == pytest.approx(9.81)
    assert (found.gps_fixes, found.truth_poses, found.calibration) == (0, 1, True)
    assert found.point_time == "2000 different times over 100.0 ms"
    assert found.problems == []
    assert found.suggested_config == ["--recipe default"]


def test_an_accelerometer_in_g_is_a_problem_with_its_remedy(tmp_path: Path) -> None:
    found = inspected(tmp_path, steady_imu(scale=1.0))
    assert any("accelerometer is in g" in problem for problem in found.problems)
    assert any(option.startswith("--set config.data.accel_unit=g") for option in found.suggested_config)


def test_an_accelerometer_in_no_known_unit_is_a_problem(tmp_path: Path) -> None:
    assert any("check its unit" in problem for problem in inspected(tmp_path, steady_imu(scale=4.0)).problems)


def test_imu_gaps_are_counted_and_measured(tmp_path: Path) -> None:
    found = inspected(tmp_path, steady_imu(skip=slice(100, 140)))
    assert found.imu_gaps == 1
    assert found.imu_longest_gap == pytest.approx(0.205)
    assert any("0.205 s at 0.495 s" in problem for problem in found.problems)


def test_a_slow_imu_is_a_problem(tmp_path: Path) -> None:
    assert any("10 Hz only" in problem for problem in inspected(tmp_path, steady_imu(rate=10.0)).problems)


def test_clocks_that_do_not_overlap_are_a_problem(tmp_path: Path) -> None:
    imu = steady_imu()
    late = ImuData(imu.stamp_ns + 3_600_000_000_000, imu.gyro, imu.accel)
    problems = inspected(tmp_path, late).problems
    assert any("do not overlap in time, the first sample is 3600.000 s after" in said for said in problems)


def test_empty_and_unreadable_scans_are_problems(tmp_path: Path) -> None:
    scans = [ring_scan(number, 0 if number == 2 else 2000) for number in range(5)]
    write_native(tmp_path / "r", scans)
    (tmp_path / "r" / "scans" / "000003.npz").write_bytes(b"")
    found = inspect_sequence(open_sequence(tmp_path / "r"))
    assert any("000003.npz: cannot be read" in problem for problem in found.problems)
    assert any("fewer than 1000 points (first: scan 2)" in problem for problem in found.problems)


def test_a_recording_without_a_readable_scan_is_still_described(tmp_path: Path) -> None:
    write_native(tmp_path / "r", [ring_scan(0)])
    (tmp_path / "r" / "scans" / "000000.npz").write_bytes(b"")
    found = inspect_sequence(open_sequence(tmp_path / "r"))
    assert "none of the 1 scan(s) could be decoded." in found.problems
    assert "unknown" in format_inspection(found)


def test_an_imu_without_calibration_asks_for_the_extrinsic(tmp_path: Path) -> None:
    write_native(tmp_path / "r", [ring_scan(0), ring_scan(1)], imu=steady_imu())
    found = inspect_sequence(open_sequence(tmp_path / "r"))
    assert not found.calibration
    assert any("no calibration" in problem for problem in found.problems)
    assert any("params.extrinsics.translation" in option for option in found.suggested_config)


def test_scans_beyond_the_largest_bucket_ask_for_a_larger_one(tmp_path: Path) -> None:
    found = inspected(tmp_path, scans=[ring_scan(0, 300_000)])
    assert any(
        "config.lidar.buckets=[4096," in option and ",327680]" in option for option in found.suggested_config
    )


def test_it_becomes_json_and_a_table(tmp_path: Path) -> None:
    found = inspected(tmp_path, steady_imu(skip=slice(100, 140)))
    assert json.loads(json.dumps(found.to_dict())) == found.to_dict()
    table = format_inspection(found)
    assert "VLP-16" in table
    assert "40 at 10.00 Hz" in table
    assert "1 gap(s)" in table
    assert max(map(len, _facts(table))) < 160


@needs_shared
def test_the_real_drive_is_described() -> None:
    found = inspect_sequence(open_sequence(SHARED_DATA / "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync"))
    assert (found.scans, found.rings, found.imu_samples, found.truth_poses) == (60, 64, 154, 154)
    assert found.scan_rate == pytest.approx(9.68, abs=0.02)
    assert found.imu_rate == pytest.approx(10.0, abs=0.1)
    assert found.calibration


@needs_shared
def test_the_real_bag_is_described() -> None:
    found = inspect_sequence(open_sequence(SHARED_DATA / "ouster/os1_128_3scans.bag"))
    assert (found.scans, found.rings, found.imu_samples) == (3, 128, 30)
    assert found.scan_rate == pytest.approx(10.0, abs=0.1)
    assert found.imu_rate == pytest.approx(100.0, abs=1.0)


def _facts(table: str) -> list[str]:
    """Return the table's rows, without the sentences below."""
    return table.split("\n\n")[0].splitlines()
