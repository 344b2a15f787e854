"""Covariances of poses against perturbed poses themselves."""

import numpy as np
from scipy.linalg import expm, logm
from scipy.spatial.transform import Rotation

from lio_jax.core.geometry import adjoint_of, carried, covariance_of


def _pose(rotation, position):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation).as_matrix()
    T[:3, 3] = position
    return T


def _hat(twist):
    (x, y, z), move = twist[:3], twist[3:]
    T = np.zeros((4, 4))
    T[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    T[:3, 3] = move
    return T


def _vee(T):
    return np.array([T[2, 1], T[0, 2], T[1, 0], *T[:3, 3]])


T_B_A = _pose([0.3, -0.5, 0.8], [1.5, -0.4, 0.7])
TWIST = np.array([0.2, -0.1, 0.15, 0.4, 0.5, -0.6])


def test_adjoint_moves_a_perturbation_to_the_other_side():
    np.testing.assert_allclose(
        T_B_A @ expm(_hat(TWIST)), expm(_hat(adjoint_of(T_B_A) @ TWIST)) @ T_B_A, atol=1e-12
    )


def test_carried_covariance_is_that_of_the_carried_pose():
    factor = np.random.default_rng(0).normal(size=(6, 6)) * 1e-4
    T_world_b = _pose([0.1, 0.2, -0.4], [10.0, 3.0, -1.0])
    T_world_a = T_world_b @ T_B_A
    spread = np.zeros((6, 6))
    for column in factor.T:
        perturbed_b = T_world_a @ expm(_hat(column)) @ np.linalg.inv(T_B_A)
        seen = _vee(np.real(logm(np.linalg.inv(T_world_b) @ perturbed_b)))
        spread += np.outer(seen, seen)
    np.testing.assert_allclose(carried(factor @ factor.T, T_B_A), spread, rtol=1e-6, atol=1e-12)


def test_information_is_inverted():
    factor = np.random.default_rng(1).normal(size=(6, 6))
    information = factor @ factor.T + np.eye(6)
    np.testing.assert_allclose(covariance_of(information) @ information, np.eye(6), atol=1e-10)


def test_unobserved_direction_is_nan():
    assert np.isnan(covariance_of(np.diag([1.0, 1.0, 1.0, 1.0, 1.0, 0.0]))).all()
