import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.trajectory import Trajectory, write_kitti_poses, write_tum
from lio_jax.evaluation.load import load_trajectory
from tests.evaluation.scenes import stamped, winding_drive
from tests.shared_data import SHARED_DATA, needs_shared


@pytest.fixture
def drive() -> Trajectory:
    return stamped(winding_drive(12))


def assert_same(loaded, trajectory):
    np.testing.assert_array_equal(loaded.trajectory.stamp_ns, trajectory.stamp_ns)
    np.testing.assert_allclose(loaded.trajectory.poses, trajectory.poses, atol=1e-7)


def test_tum_file(tmp_path, drive):
    path = tmp_path / "any_name.txt"
    write_tum(path, drive)
    loaded = load_trajectory(path)
    assert_same(loaded, drive)
    assert loaded.stamped


def test_tum_file_with_comments_and_commas(tmp_path):
    path = tmp_path / "truth.csv"
    path.write_text("# t x y z qx qy qz qw\n1.5,1,2,3,0,0,0,1\n")
    loaded = load_trajectory(path)
    np.testing.assert_array_equal(loaded.trajectory.stamp_ns, [1_500_000_000])
    np.testing.assert_allclose(loaded.trajectory.positions, [[1, 2, 3]])


def test_run_folder_gives_its_trajectory(tmp_path, drive):
    write_tum(tmp_path / "trajectory.tum", drive)
    loaded = load_trajectory(tmp_path)
    assert_same(loaded, drive)
    assert loaded.source.endswith("trajectory.tum")


def test_kitti_file_without_stamps_counts(tmp_path, drive):
    path = tmp_path / "poses.txt"
    write_kitti_poses(path, drive.poses)
    loaded = load_trajectory(path)
    assert not loaded.stamped
    np.testing.assert_array_equal(loaded.trajectory.stamp_ns, np.arange(12))


def test_kitti_file_takes_times_beside_it(tmp_path, drive):
    write_kitti_poses(tmp_path / "poses.txt", drive.poses)
    (tmp_path / "times.txt").write_text("".join(f"{0.25 * i:e}\n" for i in range(12)))
    loaded = load_trajectory(tmp_path / "poses.txt")
    assert loaded.stamped
    np.testing.assert_array_equal(loaded.trajectory.stamp_ns, 250_000_000 * np.arange(12))


def test_kitti_file_ignores_times_of_another_length(tmp_path, drive):
    write_kitti_poses(tmp_path / "poses.txt", drive.poses)
    (tmp_path / "times.txt").write_text("0.0\n0.1\n")
    assert not load_trajectory(tmp_path / "poses.txt").stamped


def test_kitti_file_of_a_run_takes_the_runs_stamps(tmp_path, drive):
    write_tum(tmp_path / "trajectory.tum", drive)
    write_kitti_poses(tmp_path / "trajectory_kitti.txt", drive.poses)
    assert_same(load_trajectory(tmp_path / "trajectory_kitti.txt"), drive)


@needs_shared
def test_published_kitti_poses_take_the_sequences_times():
    loaded = load_trajectory(SHARED_DATA / "kitti_odometry" / "poses" / "04.txt")
    assert loaded.stamped
    assert len(loaded.trajectory) == 271
    assert loaded.trajectory.stamp_ns[1] == 104_128_400


@needs_shared
def test_recording_gives_its_truth():
    loaded = load_trajectory(SHARED_DATA / "kitti_odometry" / "sequences" / "04")
    assert loaded.stamped
    assert len(loaded.trajectory) >= 20


@needs_shared
def test_recording_without_truth_is_an_error():
    with pytest.raises(LioJaxError, match=r"os1_128_3scans\.bag.*no ground truth"):
        load_trajectory(SHARED_DATA / "ouster" / "os1_128_3scans.bag")


def test_missing_file_is_an_error(tmp_path):
    with pytest.raises(LioJaxError, match=r"nothing_here\.tum: there is no such file"):
        load_trajectory(tmp_path / "nothing_here.tum")


def test_empty_file_is_an_error(tmp_path):
    (tmp_path / "trajectory.tum").write_text("")
    with pytest.raises(LioJaxError, match=r"trajectory\.tum: holds no poses"):
        load_trajectory(tmp_path)


def test_folder_without_a_trajectory_is_an_error(tmp_path):
    with pytest.raises(LioJaxError, match=str(tmp_path)):
        load_trajectory(tmp_path)


def test_wrong_number_of_columns_is_an_error(tmp_path):
    path = tmp_path / "odd.txt"
    path.write_text("1 2 3\n")
    with pytest.raises(LioJaxError, match=r"odd\.txt: 3 numbers"):
        load_trajectory(path)


def test_binary_file_is_an_error(tmp_path):
    path = tmp_path / "scan.bin"
    path.write_bytes(bytes(range(128, 256)))
    with pytest.raises(LioJaxError, match=r"scan\.bin: is not a text file; give a TUM or KITTI"):
        load_trajectory(path)


def test_zero_quaternion_is_an_error(tmp_path):
    path = tmp_path / "zero.tum"
    path.write_text("0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 0\n")
    with pytest.raises(LioJaxError, match=r"zero\.tum: line 2 is not .* no zero quaternion"):
        load_trajectory(path)


@pytest.mark.parametrize("time", ["inf", "nan", "1e999"])
def test_a_time_that_is_not_finite_is_an_error(tmp_path, time):
    (tmp_path / "a.tum").write_text(f"{time} 1 2 3 0 0 0 1\n")
    with pytest.raises(LioJaxError, match=r"a\.tum: line 1 is not 't x y z qx qy qz qw'"):
        load_trajectory(tmp_path / "a.tum")
    write_kitti_poses(tmp_path / "poses.txt", np.eye(4)[None])
    (tmp_path / "times.txt").write_text(time)
    with pytest.raises(LioJaxError, match=rf"times\.txt: entry 1 \('{time}'\) is not a time in seconds"):
        load_trajectory(tmp_path / "poses.txt")
