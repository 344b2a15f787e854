"""Keyframes and the odometry chain between them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.geometry import adjoint_of
from lio_jax.run.keyframes import keyframe_indices, odometry_edges


def _poses(yaws, xs):
    poses = np.tile(np.eye(4), (len(yaws), 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec([[0.0, 0.0, yaw] for yaw in yaws]).as_matrix()
    poses[:, 0, 3] = xs
    return poses


def test_a_keyframe_when_moved_enough():
    assert keyframe_indices(_poses([0] * 5, [0, 0.6, 1.2, 1.8, 2.4]), 1.0, 0.2) == [0, 2, 4]


def test_a_keyframe_when_turned_enough():
    assert keyframe_indices(_poses([0, 0.15, 0.3, -3.1, 3.1], [0] * 5), 1.0, 0.2) == [0, 2, 3]


def test_one_pose_is_one_keyframe_without_edges():
    poses = _poses([0.0], [0.0])
    assert keyframe_indices(poses, 1.0, 0.2) == [0]
    assert odometry_edges(poses, np.zeros((1, 6, 6))) == []


def test_edges_restore_the_poses():
    poses = _poses([0.1, 0.5, 1.2], [0.0, 1.0, 3.0])
    walked = poses[0]
    for edge in odometry_edges(poses, np.tile(np.eye(6) * 1e-4, (3, 1, 1))):
        walked = walked @ edge.T_i_j
        assert edge.j == edge.i + 1
    np.testing.assert_allclose(walked, poses[-1], atol=1e-12)


def test_information_is_that_of_the_relative_pose():
    poses = _poses([0.1, 0.7], [0.0, 2.0])
    first, second = np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-4, np.diag([6.0, 5, 4, 3, 2, 1]) * 1e-4
    edge = odometry_edges(poses, np.stack([first, second]))[0]
    A = adjoint_of(np.linalg.inv(edge.T_i_j))
    np.testing.assert_allclose(edge.information @ (second + A @ first @ A.T), np.eye(6), atol=1e-9)


@pytest.mark.parametrize("second", [np.full((6, 6), np.nan), np.zeros((6, 6)), np.ones((6, 6))])
def test_unknown_or_singular_covariance_gives_a_loose_edge(second):
    edge = odometry_edges(_poses([0.0, 0.0], [0.0, 1.0]), np.stack([np.zeros((6, 6)), second]))[0]
    np.testing.assert_array_equal(edge.information, np.diag([100.0] * 3 + [1.0] * 3))
