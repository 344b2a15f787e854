from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.data.config import DataConfig
from lio_jax.data.kitti import KittiSequence
from lio_jax.data.velodyne_file import raise_elevation
from tests.shared_data import SHARED_DATA, needs_shared

REAL = SHARED_DATA / "kitti_odometry" / "sequences" / "04"
IDENTITY_LINE = "1 0 0 0 0 1 0 0 0 0 1 0"


def cloud(seed: int = 0, count: int = 200) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.c_[rng.normal(0.0, 10.0, (count, 3)), rng.uniform(size=count)].astype(np.float32)


def write_sequence(root: Path, count: int = 5, times: str | None = None) -> Path:
    """Make a small sequences/07 folder below ``root``."""
    folder = root / "sequences" / "07"
    (folder / "velodyne").mkdir(parents=True)
    for number in range(count):
        cloud(number).tofile(folder / "velodyne" / f"{number:06d}.bin")
    lines = times if times is not None else "".join(f"{0.1 * number:e}\n" for number in range(count))
    (folder / "times.txt").write_text(lines)
    (folder / "calib.txt").write_text(f"P0: {IDENTITY_LINE}\nTr: 0 -1 0 0.1 0 0 -1 0.2 1 0 0 0.3\n")
    return folder


def test_elevation_is_raised_as_by_a_rotation_about_the_cross_product() -> None:
    points = cloud()[:, :3]
    axis = np.cross(points, [0.0, 0.0, 1.0])
    axis *= np.radians(0.205) / np.linalg.norm(axis, axis=1, keepdims=True)
    expected = Rotation.from_rotvec(axis).apply(points)
    np.testing.assert_allclose(raise_elevation(points, 0.205), expected, atol=1e-5)
    before, after = (
        np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])) for p in (points, raise_elevation(points, 0.205))
    )
    np.testing.assert_allclose(np.degrees(after - before), 0.205, atol=1e-4)


def test_elevation_is_raised_as_kiss_icp_does() -> None:
    kiss = pytest.importorskip("kiss_icp.pybind.kiss_icp_pybind", reason="kiss-icp is in the bench extra")
    points = cloud()[:, :3]
    expected = np.asarray(kiss._correct_kitti_scan(kiss._Vector3dVector(points.astype(float))))
    np.testing.assert_allclose(raise_elevation(points, 0.205), expected, atol=1e-5)


def test_points_straight_above_and_no_correction_stay() -> None:
    above = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 0.0]], np.float32)
    np.testing.assert_array_equal(raise_elevation(above, 0.205)[0], above[0])
    assert raise_elevation(above, 0.0) is above


def test_stamps_points_and_intensity_are_the_files(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path, 3, "0.000000e+00\n1.036224e-01\n2.072345e-01\n")
    scans = list(KittiSequence(folder, DataConfig(vertical_correction_deg=0.0)).scans())
    assert [scan.stamp_ns for scan in scans] == [0, 103_622_400, 207_234_500]
    np.testing.assert_array_equal(scans[1].points, cloud(1)[:, :3])
    np.testing.assert_array_equal(scans[1].intensity, cloud(1)[:, 3])
    assert scans[1].duration == 0.0
    assert not scans[1].time.any()
    assert scans[1].end_ns == scans[1].stamp_ns


def test_uncompensated_scans_are_centred_on_the_camera_stamp(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path)
    sequence = KittiSequence(folder, DataConfig(compensated="no", vertical_correction_deg=0.0))
    scan = list(sequence.scans())[2]
    assert (scan.stamp_ns, scan.end_ns) == (150_000_000, 250_000_000)
    azimuth = np.arctan2(scan.points[:, 1], scan.points[:, 0])
    np.testing.assert_allclose(scan.time, 0.1 * (0.5 - azimuth / (2 * np.pi)), atol=1e-6)


def test_start_and_count_choose_scans(tmp_path: Path) -> None:
    sequence = KittiSequence(write_sequence(tmp_path, 6), DataConfig())
    assert [round(scan.stamp_ns * 1e-8) for scan in sequence.scans(2, 3)] == [2, 3, 4]
    assert [round(scan.stamp_ns * 1e-8) for scan in sequence.scans(4)] == [4, 5]


def test_a_missing_scan_is_named_and_the_others_keep_their_stamps(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path, 8)
    for number in (2, 4, 5):
        (folder / "velodyne" / f"{number:06d}.bin").unlink()
    sequence = KittiSequence(folder, DataConfig())
    assert [round(scan.stamp_ns * 1e-8) for scan in sequence.scans()] == [0, 1, 3, 6, 7]
    assert sequence.info.scan_count == 5
    assert len(sequence.warnings_so_far) == 1
    assert "000002, 000004-000005 are missing" in sequence.warnings_so_far[0]


def test_more_times_than_scans_is_a_note(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path, 2, "0.0\n0.1\n0.2\n0.3\n")
    sequence = KittiSequence(folder, DataConfig())
    assert any("cut-out: times.txt has 4 entries" in note for note in sequence.info.notes)
    assert sequence.warnings_so_far == ()


def test_scans_beyond_times_are_skipped_and_named(tmp_path: Path) -> None:
    sequence = KittiSequence(write_sequence(tmp_path, 4, "0.0\n0.1\n"), DataConfig())
    assert sequence.info.scan_count == 2
    assert "000002-000003" in sequence.warnings_so_far[0]


def test_duplicate_and_backward_times_are_left_out_and_named(tmp_path: Path) -> None:
    sequence = KittiSequence(write_sequence(tmp_path, 5, "0.0\n0.1\n0.1\n0.05\n0.4\n"), DataConfig())
    assert [scan.stamp_ns for scan in sequence.scans()] == [0, 100_000_000, 400_000_000]
    duplicate, backward = sequence.warnings_so_far
    assert "000002.bin has the same stamp" in duplicate
    assert "000003.bin" in backward
    assert "out of order" in backward


def test_an_empty_file_is_an_empty_scan_and_named(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path)
    (folder / "velodyne" / "000001.bin").write_bytes(b"")
    sequence = KittiSequence(folder, DataConfig())
    assert [len(scan.points) for scan in sequence.scans()] == [200, 0, 200, 200, 200]
    assert len(sequence.warnings_so_far) == 1
    assert "000001.bin: the file is empty" in sequence.warnings_so_far[0]


def test_a_truncated_file_gives_its_whole_points_and_is_named_once(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path)
    path = folder / "velodyne" / "000001.bin"
    path.write_bytes(path.read_bytes()[: 100 * 16 + 7])
    sequence = KittiSequence(folder, DataConfig())
    for _ in range(2):
        assert [len(scan.points) for scan in sequence.scans()] == [200, 100, 200, 200, 200]
    assert len(sequence.warnings_so_far) == 1
    assert "000001.bin: truncated" in sequence.warnings_so_far[0]


def test_an_unreadable_file_is_skipped_and_named(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path)
    path = folder / "velodyne" / "000001.bin"
    path.unlink()
    path.mkdir()
    sequence = KittiSequence(folder, DataConfig())
    assert len(list(sequence.scans())) == 4
    assert any("000001.bin: cannot be read" in warning for warning in sequence.warnings_so_far)


def test_nan_infinite_and_zero_points_are_dropped(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path)
    rows = cloud(0)
    rows[3, 0], rows[5, 2], rows[7, 1], rows[9, :3] = np.nan, np.inf, -np.inf, 0.0
    rows.tofile(folder / "velodyne" / "000000.bin")
    scan = next(KittiSequence(folder, DataConfig(vertical_correction_deg=0.0)).scans())
    np.testing.assert_array_equal(scan.points, np.delete(rows, [3, 5, 7, 9], axis=0)[:, :3])
    assert len(scan.time) == len(scan.ring) == len(scan.intensity) == 196


def test_a_broken_time_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LioJaxError, match=r"times\.txt: entry 2 \('soon'\)"):
        KittiSequence(write_sequence(tmp_path, 2, "0.0\nsoon\n"), DataConfig())


def test_a_folder_without_scans_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(LioJaxError, match="velodyne: holds no scans"):
        KittiSequence(write_sequence(tmp_path, 0), DataConfig())


def test_a_broken_calibration_is_an_error(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path)
    (folder / "calib.txt").write_text("Tr: 1 2 3\n")
    with pytest.raises(LioJaxError, match=r"calib\.txt: 'Tr' does not hold 12 numbers"):
        KittiSequence(folder, DataConfig())


def test_without_times_scans_are_one_period_apart_and_it_says_so(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path, 3)
    (folder / "times.txt").unlink()
    sequence = KittiSequence(folder, DataConfig(scan_period=0.2))
    assert [scan.stamp_ns for scan in sequence.scans()] == [0, 200_000_000, 400_000_000]
    assert any("no times.txt" in note for note in sequence.info.notes)


def test_truth_turns_camera_poses_into_lidar_poses(tmp_path: Path) -> None:
    """A camera that moves 2 m along its z moves 2 m along the lidar's x."""
    folder = write_sequence(tmp_path, 2)
    (folder / "poses.txt").write_text("1 0 0 5 0 1 0 6 0 0 1 7\n1 0 0 5 0 1 0 6 0 0 1 9\n")
    truth = KittiSequence(folder, DataConfig()).truth()
    assert truth is not None
    np.testing.assert_allclose(truth.poses[0], np.eye(4), atol=1e-12)
    np.testing.assert_allclose(truth.positions[1], [2.0, 0.0, 0.0], atol=1e-12)


def test_truth_is_found_beside_the_sequences_folder(tmp_path: Path) -> None:
    folder = write_sequence(tmp_path, 2)
    assert KittiSequence(folder, DataConfig()).truth() is None
    (tmp_path / "poses").mkdir()
    (tmp_path / "poses" / "07.txt").write_text(f"{IDENTITY_LINE}\n{IDENTITY_LINE}\n")
    truth = KittiSequence(folder, DataConfig()).truth()
    assert truth is not None
    assert truth.stamp_ns.tolist() == [0, 100_000_000]


@needs_shared
def test_the_real_sequence_is_read_whole() -> None:
    sequence = KittiSequence(REAL, DataConfig())
    scans = list(sequence.scans())
    assert len(scans) == sequence.info.scan_count == 20
    assert all(120_000 < len(scan.points) < 126_000 and scan.ring.max() == 63 for scan in scans)
    assert sequence.warnings_so_far == ()
    assert sequence.imu() is None
    assert sequence.gps() is None
    truth = sequence.truth()
    assert truth is not None
    assert len(truth) == 271
    distance = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1).sum()
    assert abs(distance - 393.6) < 1.0  # sequence 04's published length
    assert truth.positions[-1][0] > 390.0  # straight ahead is the lidar's x
