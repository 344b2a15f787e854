import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.data.trajectory import Trajectory, pose_matrices
from lio_jax.evaluation.association import match_by_index, match_by_time
from tests.evaluation.scenes import EPOCH_NS, PERIOD_NS, stamped, straight_drive


def test_reference_is_interpolated_at_the_estimates_stamps():
    turn = Rotation.from_euler("z", [[0.0], [0.4]])
    reference = Trajectory(
        np.array([0, 1_000_000_000]), pose_matrices(np.array([[0, 0, 0], [4.0, 8, 0]]), turn.as_quat())
    )
    estimate = Trajectory(np.array([250_000_000]), np.eye(4)[None])
    matched = match_by_time(estimate, reference)
    np.testing.assert_allclose(matched.reference.positions, [[1.0, 2.0, 0.0]], atol=1e-12)
    angle = Rotation.from_matrix(matched.reference.poses[0, :3, :3]).as_euler("zyx")[0]
    assert angle == pytest.approx(0.1)
    assert matched.notes == ()


def test_poses_outside_the_span_are_left_out_and_counted():
    estimate = stamped(straight_drive(20))
    reference = stamped(straight_drive(10), EPOCH_NS + 5 * PERIOD_NS)
    matched = match_by_time(estimate, reference)
    assert len(matched) == 10
    assert matched.estimate.stamp_ns[0] == reference.stamp_ns[0]
    assert "10 of 20" in matched.notes[0]


def test_end_pose_survives_rounded_stamps():
    reference = stamped(straight_drive(10))
    shifted = Trajectory(reference.stamp_ns + 40_000, reference.poses)
    matched = match_by_time(shifted, reference)
    assert len(matched) == 10
    assert matched.estimate.stamp_ns[-1] == shifted.stamp_ns[-1]


def test_no_overlap_names_both_spans():
    estimate = stamped(straight_drive(5), 1_000_000_000)
    reference = stamped(straight_drive(5), 7_000_000_000)
    with pytest.raises(LioJaxError, match=r"run\.tum.*truth\.tum.*1\.000000000.*1\.4.*7\.000000000"):
        match_by_time(estimate, reference, "run.tum", "truth.tum")


def test_no_truth_is_invented_in_a_hole_of_the_reference():
    estimate = stamped(straight_drive(100))
    keep = np.r_[0:20, 60:100]
    reference = Trajectory(estimate.stamp_ns[keep], estimate.poses[keep])
    matched = match_by_time(estimate, reference)
    assert len(matched) == 60
    assert "40 estimated poses lie in holes" in matched.notes[0]


def test_sparse_reference_is_no_hole():
    estimate = stamped(straight_drive(101))
    reference = Trajectory(estimate.stamp_ns[::20], estimate.poses[::20])
    assert len(match_by_time(estimate, reference)) == 101


def test_estimate_wholly_within_a_hole_is_an_error():
    dense = stamped(straight_drive(40))
    reference = Trajectory(dense.stamp_ns[[0, 1, 2, 3, 39]], dense.poses[[0, 1, 2, 3, 39]])
    estimate = Trajectory(dense.stamp_ns[10:20], dense.poses[10:20])
    with pytest.raises(LioJaxError, match="hole"):
        match_by_time(estimate, reference)


def test_poses_that_are_not_finite_are_left_out_and_counted():
    poses = straight_drive(10)
    poses[3, 0, 3] = np.nan
    poses[7, 0, 0] = np.inf
    matched = match_by_time(stamped(poses), stamped(straight_drive(10)))
    assert len(matched) == 8
    assert "2 of 10" in matched.notes[0]


def test_estimate_without_a_finite_pose_is_an_error():
    with pytest.raises(LioJaxError, match=r"run\.tum holds no pose with finite"):
        match_by_time(stamped(np.full((3, 4, 4), np.nan)), stamped(straight_drive(3)), "run.tum")


def test_index_pairs_equal_lengths():
    estimate, reference = stamped(straight_drive(5), 0), stamped(straight_drive(5), 10**15)
    matched = match_by_index(estimate, reference)
    assert len(matched) == 5
    assert "index" in matched.notes[0]


def test_index_refuses_different_lengths():
    with pytest.raises(LioJaxError, match=r"a\.txt holds 5 poses and b\.txt 6"):
        match_by_index(stamped(straight_drive(5)), stamped(straight_drive(6)), "a.txt", "b.txt")
