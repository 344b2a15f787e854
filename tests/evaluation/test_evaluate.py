import dataclasses
import json

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.trajectory import Trajectory, write_kitti_poses, write_tum
from lio_jax.evaluation.evaluate import evaluate, evaluate_files, format_evaluation
from tests.evaluation.scenes import EPOCH_NS, PERIOD_NS, stamped, straight_drive, transform, winding_drive
from tests.shared_data import SHARED_DATA, needs_shared

KISS_ICP_00 = SHARED_DATA / "kiss_icp_kitti_00"
CAMERA_AXES = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


@needs_shared
def test_kitti_00_by_its_files():
    result = evaluate_files(KISS_ICP_00 / "00_poses_kitti.txt", KISS_ICP_00 / "00_gt_kitti.txt").as_dict()
    assert result["matched"] == 4541
    assert f"{result['kitti']['translation_percent']:.3f}" == "0.527"
    assert f"{result['kitti']['rotation_deg_per_m']:.3f}" == "0.002"
    assert result["ate"]["rmse"] == pytest.approx(3.515636, abs=1e-6)
    assert result["path_length_m"] == pytest.approx(3724.187, abs=1e-3)
    assert result["duration_s"] is None
    assert set(result["kitti_short_10_80m"]) == {"translation_percent", "rotation_deg_per_m", "segments"}


def test_perfect_estimate_in_another_world_has_no_error():
    reference = stamped(winding_drive())
    moved = transform((0.3, 0.1, -2.0), (50.0, 0.0, 3.0)) @ reference.poses
    result = evaluate(Trajectory(reference.stamp_ns, moved), reference, (10.0,))
    assert result.ate.max < 1e-9
    assert result.ate.rotation_max < 1e-7
    assert result.rpe.max < 1e-9
    assert result.rpe_by_distance["10 m"].max < 1e-9
    assert result.kitti.translation_percent < 1e-9
    assert result.notes == ()


def test_estimate_at_other_stamps_than_the_truth():
    # A straight, even drive: interpolation is exact, so only the matching can go wrong.
    reference = stamped(straight_drive(100))
    estimate = Trajectory(reference.stamp_ns[:-1] + PERIOD_NS // 2, reference.poses[:-1].copy())
    estimate.poses[:, 0, 3] += 0.5
    result = evaluate(estimate, reference)
    assert result.matched == result.poses == 99
    assert result.ate.max < 1e-9
    assert result.path_length_m == pytest.approx(98.0)
    assert result.duration_s == pytest.approx(9.8)


def test_result_is_plain_json_without_nan():
    poses = np.tile(np.eye(4), (1, 1, 1))
    result = evaluate(stamped(poses), stamped(poses), (10.0,)).as_dict()
    text = json.dumps(result, allow_nan=False)
    assert json.loads(text) == result
    assert result["rpe"] is None
    assert result["kitti"] is None
    assert result["rpe_by_distance"] == {"10 m": None}


def test_numbers_that_are_not_finite_become_null():
    result = evaluate(stamped(straight_drive(10)), stamped(straight_drive(10)))
    broken = dataclasses.replace(
        result, path_length_m=float("nan"), rpe_by_distance={"1 m": float("inf")}
    ).as_dict()
    assert broken["path_length_m"] is None
    assert broken["rpe_by_distance"] == {"1 m": None}
    json.dumps(broken, allow_nan=False)


def test_diverged_poses_are_left_out_and_counted():
    poses = straight_drive(10)
    poses[8, 0, 3], poses[9, 0, 3] = 1e200, np.nan
    result = evaluate(stamped(poses), stamped(straight_drive(10)))
    assert (result.matched, result.poses) == (8, 10)
    assert result.ate.max < 1e-9
    assert any("2 of 10" in note for note in result.notes)


def test_standing_vehicle_measures_its_wander():
    still = np.tile(np.eye(4), (30, 1, 1))
    wandering = still.copy()
    wandering[:, 0, 3] = np.linspace(0.0, 0.008, 30)
    result = evaluate(stamped(wandering), stamped(still))
    assert result.ate.max == pytest.approx(0.008)
    assert result.ate.rotation_max == pytest.approx(0.0, abs=1e-9)
    assert result.alignment == "first_pose"
    assert any("hardly moves" in note for note in result.notes)


def test_poses_of_another_sensor_are_called_out():
    imu = winding_drive()
    camera = Trajectory(stamped(imu).stamp_ns, imu @ np.linalg.inv(CAMERA_AXES))
    notes = evaluate(stamped(imu), camera).notes
    assert any("different sensors" in note and "(1.00, 0.00, 0.00)" in note for note in notes)


def test_poses_of_another_sensor_on_a_straight_path_are_called_out():
    imu = straight_drive()
    camera = Trajectory(stamped(imu).stamp_ns, imu @ np.linalg.inv(CAMERA_AXES))
    assert any("different sensors" in note for note in evaluate(stamped(imu), camera).notes)


def test_files_without_stamps_and_of_unequal_length_are_refused(tmp_path):
    write_kitti_poses(tmp_path / "a.txt", straight_drive(5))
    write_kitti_poses(tmp_path / "b.txt", straight_drive(6))
    with pytest.raises(LioJaxError, match=r"a\.txt holds 5 poses and .*b\.txt 6"):
        evaluate_files(tmp_path / "a.txt", tmp_path / "b.txt")


def test_stamped_against_unstamped_of_equal_length_is_paired_by_index(tmp_path):
    write_tum(tmp_path / "a.tum", stamped(winding_drive(50)))
    write_kitti_poses(tmp_path / "b.txt", winding_drive(50))
    result = evaluate_files(tmp_path / "a.tum", tmp_path / "b.txt")
    assert result.ate.max < 1e-6
    assert any("index" in note for note in result.notes)


def test_files_of_other_times_are_refused(tmp_path):
    write_tum(tmp_path / "a.tum", stamped(winding_drive(5), 0))
    write_tum(tmp_path / "b.tum", stamped(winding_drive(5), EPOCH_NS))
    with pytest.raises(LioJaxError, match=r"a\.tum.*b\.tum"):
        evaluate_files(tmp_path / "a.tum", tmp_path / "b.tum")


def test_table_holds_every_number_with_its_unit():
    reference = winding_drive()
    estimate = reference.copy()
    estimate[:, :3, 3] *= 1.01
    text = format_evaluation(evaluate(stamped(estimate), stamped(reference), (10.0,)))
    rows = {line[:30].strip(): line[30:].split() for line in text.splitlines() if line.strip()}
    assert rows["RPE, pose to pose translation"] == ["0.0100", "0.0100", "0.0100", "m"]
    assert rows["RPE, per 10 m translation"][-1] == "m"
    assert rows["ATE rotation"][-1] == "rad"
    assert float(rows["short run, 10 to 80 m"][0]) == pytest.approx(1.0, abs=0.1)
    assert len({len(line) for line in text.splitlines() if line.endswith("  m")}) == 1


def test_table_of_a_single_pose_has_no_numbers_where_there_are_none():
    pose = stamped(np.eye(4)[None])
    text = format_evaluation(evaluate(pose, pose))
    assert "too few poses" in text
    assert "note: Aligned by the first pose" in text


def test_the_truth_of_a_recording_without_one_is_refused():
    with pytest.raises(UsageError, match=r"no trajectory to compare with.* lio_jax\.read_tum"):
        evaluate(straight_drive(), None)
