import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.config import DataConfig
from lio_jax.data.kitti_raw import KittiRawSequence
from tests.shared_data import SHARED_DATA, needs_shared

DATE = SHARED_DATA / "kitti_raw" / "2011_09_26"
TURNING = DATE / "2011_09_26_drive_0005_sync"
STANDING = DATE / "2011_09_26_drive_0060_sync"
SECOND = 1_317_042_272  # 2011-09-26 13:04:32 UTC


def cloud(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.c_[rng.normal(0.0, 10.0, (200, 3)), rng.uniform(size=200)].astype(np.float32).round(3)


def stamps(*seconds: float) -> str:
    return "".join(f"2011-09-26 13:04:{32 + s:012.9f}\n" for s in seconds)


def packet(latitude: float = 49.0, yaw: float = 0.3, sigma: float = 0.5) -> list[float]:
    values = [float(index) for index in range(30)]
    values[:6] = [latitude, 8.4, 110.0, 0.02, -0.03, yaw]
    values[23] = sigma
    return values


def write_drive(root: Path, count: int = 4, kind: str = "sync") -> Path:
    """Make a small drive folder below ``root``."""
    folder = root / f"2011_09_26_drive_0001_{kind}"
    for part in ("velodyne_points", "oxts"):
        (folder / part / "data").mkdir(parents=True)
    velodyne, oxts = folder / "velodyne_points", folder / "oxts"
    for number in range(count):
        if kind == "sync":
            cloud(number).tofile(velodyne / "data" / f"{number:010d}.bin")
        else:
            np.savetxt(velodyne / "data" / f"{number:010d}.txt", cloud(number), fmt="%.3f")
        np.savetxt(oxts / "data" / f"{number:010d}.txt", [packet(49.0 + 1e-5 * number)], fmt="%.15g")
    starts = [0.1 * number for number in range(count)]
    (velodyne / "timestamps_start.txt").write_text(stamps(*starts))
    (velodyne / "timestamps.txt").write_text(stamps(*(s + 0.05 for s in starts)))
    (velodyne / "timestamps_end.txt").write_text(stamps(*(s + 0.098 for s in starts)))
    (oxts / "timestamps.txt").write_text(stamps(*(s + 0.02 for s in starts)))
    return folder


def opened(folder: Path, **config: object) -> KittiRawSequence:
    """Open a drive, by default without the correction of the elevation angles."""
    return KittiRawSequence(folder, DataConfig(**({"vertical_correction_deg": 0.0} | config)))  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["sync", "extract"])
def test_both_kinds_hold_the_same_points(tmp_path: Path, kind: str) -> None:
    scans = list(opened(write_drive(tmp_path, kind=kind)).scans())
    assert len(scans) == 4
    np.testing.assert_array_equal(scans[2].points, cloud(2)[:, :3])
    np.testing.assert_array_equal(scans[2].intensity, cloud(2)[:, 3])


@pytest.mark.parametrize("kind", ["sync", "extract"])
def test_elevation_angles_are_raised_and_the_notes_say_so(tmp_path: Path, kind: str) -> None:
    sequence = KittiRawSequence(write_drive(tmp_path, kind=kind), DataConfig())
    points, recorded = next(sequence.scans()).points, cloud(0)[:, :3]
    elevation, before = (np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (points, recorded))
    np.testing.assert_allclose(np.degrees(elevation - before), 0.205, atol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), np.linalg.norm(recorded, axis=1), rtol=1e-5)
    assert any("raised by 0.205 deg" in note for note in sequence.info.notes)


def test_an_unsynchronised_drive_has_its_samples_at_their_own_rate(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, count=3, kind="extract")
    shutil.rmtree(folder / "oxts" / "data")
    (folder / "oxts" / "data").mkdir()
    seconds = [0.01 * number + 0.003 for number in range(30)]
    for number in range(30):
        np.savetxt(folder / "oxts" / "data" / f"{number:010d}.txt", [packet(49.0 + 1e-6 * number)])
    # as published: some samples carry the stamp of the one before, or an earlier one
    seconds[7] = seconds[6]
    seconds[20] = seconds[18] + 0.001
    (folder / "oxts" / "timestamps.txt").write_text(stamps(*seconds))
    (folder / "velodyne_points" / "data" / "0000000001.txt").unlink()
    sequence = opened(folder)
    imu = sequence.imu()
    assert imu is not None
    assert len(imu.stamp_ns) == 28
    assert (np.diff(imu.stamp_ns) > 0).all()
    assert [scan.stamp_ns for scan in sequence.scans()] == [SECOND * 10**9, SECOND * 10**9 + 200_000_000]
    assert any("0000000001" in sentence for sentence in sequence.warnings_so_far)


def test_stamp_is_the_start_and_duration_reaches_the_end(tmp_path: Path) -> None:
    scan = list(opened(write_drive(tmp_path)).scans())[1]
    assert scan.stamp_ns == SECOND * 10**9 + 100_000_000
    assert scan.end_ns == SECOND * 10**9 + 198_000_000
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    np.testing.assert_allclose(scan.time, 0.098 * (0.5 - azimuth / (2 * np.pi)), atol=1e-6)


def test_config_can_say_that_points_are_compensated(tmp_path: Path) -> None:
    scan = next(opened(write_drive(tmp_path), compensated="yes").scans())
    assert scan.duration == 0.0
    assert not scan.time.any()


def test_stamps_keep_every_nanosecond(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, 1)
    (folder / "velodyne_points" / "timestamps_start.txt").write_text("2011-09-26 13:04:32.335337762\n")
    (folder / "velodyne_points" / "timestamps_end.txt").write_text("2011-09-26 13:04:32.435337763\n")
    scan = next(opened(folder).scans())
    assert scan.stamp_ns == SECOND * 10**9 + 335_337_762
    assert scan.end_ns == SECOND * 10**9 + 435_337_763


def test_without_start_and_end_stamps_the_scan_period_serves(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    (folder / "velodyne_points" / "timestamps_start.txt").unlink()
    (folder / "velodyne_points" / "timestamps_end.txt").unlink()
    sequence = opened(folder)
    scan = next(sequence.scans())
    assert (scan.stamp_ns, scan.end_ns) == (SECOND * 10**9, SECOND * 10**9 + 100_000_000)
    assert sum("timestamps_" in note for note in sequence.info.notes) == 2


def test_a_sweep_of_impossible_length_takes_the_scan_period(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, 2)
    (folder / "velodyne_points" / "timestamps_end.txt").write_text(stamps(0.098, 0.05))
    sequence = opened(folder)
    assert [round(scan.duration, 6) for scan in sequence.scans()] == [0.098, 0.1]
    assert "0000000001.bin: its sweep would last -0.050 s" in sequence.warnings_so_far[0]


def test_missing_scans_in_the_middle_are_named_and_at_the_end_noted(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, 8)
    for number in (2, 3, 7):
        (folder / "velodyne_points" / "data" / f"{number:010d}.bin").unlink()
    sequence = opened(folder)
    offsets = [round((scan.stamp_ns - SECOND * 10**9) * 1e-8) for scan in sequence.scans()]
    assert offsets == [0, 1, 4, 5, 6]
    assert len(sequence.warnings_so_far) == 1
    assert "0000000002-0000000003 are missing" in sequence.warnings_so_far[0]
    assert any("8 timestamps" in note for note in sequence.info.notes)


@pytest.mark.parametrize("stamped", ["start and end", "middle alone"])
def test_empty_lines_where_scans_were_lost(tmp_path: Path, stamped: str) -> None:
    """Public drives have an empty line in each file of stamps, and no file, where the recording lost a
    scan."""
    folder = write_drive(tmp_path, 8)
    velodyne = folder / "velodyne_points"
    for path in velodyne.glob("timestamps*.txt"):
        lines = path.read_text().splitlines()
        lines[2] = lines[3] = lines[5] = ""
        path.write_text("\n".join(lines) + "\n")
    if stamped == "middle alone":
        (velodyne / "timestamps_start.txt").unlink()
        (velodyne / "timestamps_end.txt").unlink()
    for number in (2, 3):
        (velodyne / "data" / f"{number:010d}.bin").unlink()
    sequence = opened(folder)
    found = list(sequence.scans())
    assert [round((scan.stamp_ns - SECOND * 10**9) * 1e-8) for scan in found] == [0, 1, 4, 6, 7]
    assert all(0.09 < scan.duration < 0.11 for scan in found)
    missing, empty = sequence.warnings_so_far
    assert "0000000002-0000000003 are missing" in missing
    assert "scan(s) 0000000005 are empty" in empty


def test_a_sweep_without_an_end_stamp_lasts_a_scan_period(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, 3)
    ends = folder / "velodyne_points" / "timestamps_end.txt"
    first, _, last = ends.read_text().splitlines()
    ends.write_text(f"{first}\n\n{last}\n")
    sequence = opened(folder)
    assert [round(scan.duration, 6) for scan in sequence.scans()] == [0.098, 0.1, 0.098]
    assert not any("its sweep would last" in warning for warning in sequence.warnings_so_far)


def test_packets_without_a_stamp_are_left_out(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, 4)
    path = folder / "oxts" / "timestamps.txt"
    lines = path.read_text().splitlines()
    lines[1] = ""
    path.write_text("\n".join(lines) + "\n")
    sequence = opened(folder)
    assert len(sequence.imu().stamp_ns) == 3
    assert (
        "1 packet(s) unreadable or without timestamp, left out: 0000000001.txt" in sequence.warnings_so_far[0]
    )


def test_duplicate_and_backward_stamps_are_left_out_and_named(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, 5)
    (folder / "velodyne_points" / "timestamps_start.txt").write_text(stamps(0.0, 0.1, 0.1, 0.02, 0.4))
    sequence = opened(folder)
    assert [round((scan.stamp_ns - SECOND * 10**9) * 1e-8) for scan in sequence.scans()] == [0, 1, 4]
    duplicate, backward = (w for w in sequence.warnings_so_far if "sweep" not in w)
    assert "0000000002.bin has the same stamp" in duplicate
    assert "0000000003.bin" in backward
    assert "out of order" in backward


@pytest.mark.parametrize(("kind", "suffix"), [("sync", "bin"), ("extract", "txt")])
def test_an_empty_file_is_an_empty_scan_and_named(tmp_path: Path, kind: str, suffix: str) -> None:
    folder = write_drive(tmp_path, kind=kind)
    (folder / "velodyne_points" / "data" / f"0000000001.{suffix}").write_bytes(b"")
    sequence = opened(folder)
    assert [len(scan.points) for scan in sequence.scans()] == [200, 0, 200, 200]
    assert len(sequence.warnings_so_far) == 1
    assert f"0000000001.{suffix}: the file is empty" in sequence.warnings_so_far[0]


def test_a_truncated_text_file_gives_its_whole_points(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, kind="extract")
    path = folder / "velodyne_points" / "data" / "0000000001.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:50]) + "\n1.0 2.0")
    sequence = opened(folder)
    assert [len(scan.points) for scan in sequence.scans()] == [200, 50, 200, 200]
    assert "0000000001.txt: truncated" in sequence.warnings_so_far[0]


def test_a_garbled_text_file_is_skipped_and_named(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, kind="extract")
    (folder / "velodyne_points" / "data" / "0000000001.txt").write_text("1 2 x 4\n1 2 3 4\n")
    sequence = opened(folder)
    assert len(list(sequence.scans())) == 3
    assert "0000000001.txt: cannot be read" in sequence.warnings_so_far[0]


def test_nan_infinite_and_zero_points_are_dropped(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    rows = cloud(0)
    rows[3, 0], rows[5, 2], rows[9, :3] = np.nan, np.inf, 0.0
    rows.tofile(folder / "velodyne_points" / "data" / "0000000000.bin")
    scan = next(opened(folder).scans())
    np.testing.assert_array_equal(scan.points, np.delete(rows, [3, 5, 9], axis=0)[:, :3])


def test_a_broken_timestamp_is_an_error(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    (folder / "velodyne_points" / "timestamps_start.txt").write_text(
        stamps(0.0) + "yesterday\n" + stamps(0.2)
    )
    with pytest.raises(LioJaxError, match=r"timestamps_start\.txt: line 2 \('yesterday'\)"):
        opened(folder)


def test_missing_timestamps_are_an_error(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    for path in (folder / "velodyne_points").glob("timestamps*.txt"):
        path.unlink()
    with pytest.raises(LioJaxError, match=r"timestamps\.txt: missing"):
        opened(folder)


def test_a_drive_without_scans_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LioJaxError, match="holds no scans"):
        opened(write_drive(tmp_path, 0))


def test_oxts_fields_become_imu_gps_and_truth(tmp_path: Path) -> None:
    sequence = opened(write_drive(tmp_path))
    imu, gps, truth = sequence.imu(), sequence.gps(), sequence.truth()
    assert imu is not None
    assert gps is not None
    assert truth is not None
    np.testing.assert_array_equal(imu.accel[0], [11.0, 12.0, 13.0])
    np.testing.assert_array_equal(imu.gyro[0], [17.0, 18.0, 19.0])
    assert imu.orientation is None
    assert imu.stamp_ns[1] == SECOND * 10**9 + 120_000_000
    np.testing.assert_allclose(gps.covariance[0], 0.25 * np.eye(3))
    assert gps.origin == (49.0, 8.4, 110.0)
    assert 3.3 < gps.position[3, 1] < 3.4  # 3e-5 deg of latitude
    cr, sr, cp, sp, cy, sy = (f(a) for a in (0.02, -0.03, 0.3) for f in (math.cos, math.sin))
    rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    ry = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    np.testing.assert_allclose(truth.poses[2, :3, :3], rz @ ry @ rx, atol=1e-12)
    np.testing.assert_array_equal(truth.positions[0], np.zeros(3))


def test_broken_and_repeated_packets_are_left_out_with_a_warning(tmp_path: Path) -> None:
    folder = write_drive(tmp_path, 6)
    (folder / "oxts" / "data" / "0000000001.txt").write_text("49.0 8.4")
    (folder / "oxts" / "timestamps.txt").write_text(stamps(0.0, 0.1, 0.2, 0.2, 0.15, 0.5))
    sequence = opened(folder)
    imu = sequence.imu()
    assert imu is not None
    assert ((imu.stamp_ns - SECOND * 10**9) // 10**8).tolist() == [0, 2, 5]
    broken, repeated = sequence.warnings_so_far
    assert "1 packet(s) unreadable" in broken
    assert "0000000001.txt" in broken
    assert "2 packet(s) whose stamp does not ascend" in repeated


def test_a_drive_without_oxts_has_no_samples(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    shutil.rmtree(folder / "oxts")
    sequence = opened(folder)
    assert sequence.imu() is None
    assert sequence.gps() is None
    assert sequence.truth() is None


def test_the_calibration_is_inverted(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    assert opened(folder).info.T_imu_lidar is None
    (tmp_path / "calib_imu_to_velo.txt").write_text("calib_time: x\nR: 0 -1 0 1 0 0 0 0 1\nT: 1 2 3\n")
    T_imu_lidar = opened(folder).info.T_imu_lidar
    assert T_imu_lidar is not None
    np.testing.assert_allclose(T_imu_lidar @ [1.0, 2.0, 3.0, 1.0], [0.0, 0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(T_imu_lidar @ [1.0, 3.0, 3.0, 1.0], [1.0, 0.0, 0.0, 1.0], atol=1e-12)


def test_a_broken_calibration_is_an_error(tmp_path: Path) -> None:
    folder = write_drive(tmp_path)
    (tmp_path / "calib_imu_to_velo.txt").write_text("R: 1 2 3\n")
    with pytest.raises(LioJaxError, match=r"calib_imu_to_velo\.txt: needs the entries R"):
        opened(folder)


@needs_shared
def test_the_real_turning_drive_is_read_whole() -> None:
    sequence = opened(TURNING)
    scans = list(sequence.scans())
    assert len(scans) == sequence.info.scan_count == 60
    assert sequence.warnings_so_far == ()
    assert scans[0].stamp_ns == SECOND * 10**9 + 283_701_593
    assert all(scan.ring.max() == 63 and 0.1 < scan.duration < 0.107 for scan in scans)
    assert all(scan.time.min() >= 0.0 and scan.time.max() <= scan.duration + 1e-8 for scan in scans)
    imu, truth = sequence.imu(), sequence.truth()
    assert imu is not None
    assert truth is not None
    assert abs(np.linalg.norm(imu.accel, axis=1).mean() - 9.81) < 0.15
    forward = np.gradient(truth.positions, axis=0) * 10.0
    heading = truth.poses[:, :3, 0]
    assert (
        np.einsum("ij,ij->i", forward, heading)[10:50] > 1.5
    ).all()  # the car drives where its x axis points


@needs_shared
def test_the_standing_car_stands() -> None:
    sequence = opened(STANDING)
    truth = sequence.truth()
    assert truth is not None
    at_scans = truth.at(np.array([scan.end_ns for scan in sequence.scans()]))
    assert np.linalg.norm(at_scans.positions - at_scans.positions[0], axis=1).max() < 0.02
    imu = sequence.imu()
    assert imu is not None
    assert np.abs(imu.gyro[:10]).max() < 0.01
