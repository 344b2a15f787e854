import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.evaluation.trajectory_error import align, position_errors
from tests.evaluation.scenes import straight_drive, transform, winding_drive

MOVED = transform((0.2, -0.5, 1.5), (10.0, -4.0, 2.0))


def test_recovers_the_transform_between_two_worlds():
    reference = winding_drive()
    alignment = align(np.linalg.inv(MOVED) @ reference, reference)
    np.testing.assert_allclose(alignment.T_reference_estimate, MOVED, atol=1e-9)
    assert alignment.method == "umeyama"
    assert alignment.notes == ()


def test_is_the_least_squares_rotation_of_scipy():
    generator = np.random.default_rng(0)
    reference = winding_drive()
    estimate = np.linalg.inv(MOVED) @ reference
    estimate[:, :3, 3] += generator.normal(scale=0.5, size=(len(estimate), 3))
    alignment = align(estimate, reference)
    ours, theirs = estimate[:, :3, 3], reference[:, :3, 3]
    expected, _ = Rotation.align_vectors(theirs - theirs.mean(axis=0), ours - ours.mean(axis=0))
    np.testing.assert_allclose(alignment.T_reference_estimate[:3, :3], expected.as_matrix(), atol=1e-9)


def test_scale_is_not_aligned_away():
    reference = winding_drive()
    estimate = reference.copy()
    estimate[:, :3, 3] *= 1.1
    alignment = align(estimate, reference)
    errors = position_errors(alignment, estimate, reference)
    centred = reference[:, :3, 3] - reference[:, :3, 3].mean(axis=0)
    np.testing.assert_allclose(errors, 0.1 * np.linalg.norm(centred, axis=1), atol=1e-9)


def test_standing_vehicle_is_aligned_by_the_first_pose():
    generator = np.random.default_rng(1)
    reference = np.tile(MOVED, (50, 1, 1))
    reference[:, :3, 3] += generator.normal(scale=0.005, size=(50, 3))
    estimate = np.tile(np.eye(4), (50, 1, 1))
    alignment = align(estimate, reference)
    assert alignment.method == "first_pose"
    np.testing.assert_allclose(alignment.T_reference_estimate, reference[0])
    assert "hardly moves" in alignment.notes[0]


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_than_three_poses_are_aligned_by_the_first(count):
    reference = winding_drive(count)
    alignment = align(np.linalg.inv(MOVED) @ reference, reference)
    assert alignment.method == "first_pose"
    np.testing.assert_allclose(alignment.T_reference_estimate, MOVED, atol=1e-9)
    assert "fewer than three" in alignment.notes[0]


def test_exactly_straight_path_is_aligned_by_least_squares():
    reference = straight_drive(100)
    alignment = align(np.linalg.inv(MOVED) @ reference, reference)
    assert alignment.method == "umeyama"
    assert position_errors(alignment, np.linalg.inv(MOVED) @ reference, reference).max() < 1e-9
    np.testing.assert_allclose(alignment.T_reference_estimate_attitude, MOVED, atol=1e-9)
    assert "rotation about the path" in alignment.notes[0]


def test_nearly_straight_path_does_not_twist_the_attitude():
    generator = np.random.default_rng(2)
    reference = straight_drive(200)
    reference[:, 1, 3] = 0.01 * np.sin(np.arange(200))
    estimate = reference.copy()
    estimate[:, :3, 3] += generator.normal(scale=0.02, size=(200, 3))
    alignment = align(estimate, reference)
    np.testing.assert_allclose(alignment.T_reference_estimate_attitude[:3, :3], np.eye(3), atol=1e-9)
    assert position_errors(alignment, estimate, reference).mean() < 0.05
