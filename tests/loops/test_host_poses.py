"""Rotations that are nearest to matrices, against scipy's solution of Wahba's problem."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.pose_graph.graph import nearest_rotations


@pytest.mark.parametrize("noise", [0.0, 1e-3, 0.3, 3.0])
def test_nearest_rotations_in_space_are_wahbas(noise):
    rng = np.random.default_rng(3)
    exact = Rotation.random(300, rng=rng).as_matrix()
    matrices = rng.uniform(1e-3, 20, (300, 1, 1)) * (exact + noise * rng.normal(size=exact.shape))
    found = nearest_rotations(matrices)
    expected = [Rotation.align_vectors(matrix.T, np.eye(3))[0].as_matrix() for matrix in matrices]
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(found @ found.transpose(0, 2, 1), np.tile(np.eye(3), (300, 1, 1)), atol=1e-14)


def test_nearest_rotations_in_the_plane_have_the_angle_of_the_matrix():
    matrices = np.random.default_rng(4).normal(size=(300, 2, 2))
    angles = np.arctan2(matrices[:, 1, 0] - matrices[:, 0, 1], matrices[:, 0, 0] + matrices[:, 1, 1])
    expected = np.stack([np.cos(angles), -np.sin(angles), np.sin(angles), np.cos(angles)], -1)
    np.testing.assert_allclose(nearest_rotations(matrices), expected.reshape(-1, 2, 2), atol=1e-12)


def test_reflections_and_singular_matrices_have_a_nearest_rotation_too():
    matrices = np.stack([-np.eye(3), np.diag([2.0, 1.0, -0.5]), np.diag([1.0, 1.0, 0.0]), np.zeros((3, 3))])
    found = nearest_rotations(matrices)
    np.testing.assert_allclose(np.linalg.det(found), 1.0)
    np.testing.assert_allclose(found[1:3], np.tile(np.eye(3), (2, 1, 1)), atol=1e-15)
