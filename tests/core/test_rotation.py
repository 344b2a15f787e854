"""Rotation matrices against scipy's, and their derivatives."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.geometry import rotation_matrix, skew


def test_skew_is_the_cross_product() -> None:
    v, w = np.random.default_rng(0).normal(size=(2, 5, 3))
    got = jnp.einsum("nij,nj->ni", skew(jnp.asarray(v)), w)
    np.testing.assert_allclose(got, np.cross(v, w), atol=1e-15)


@pytest.mark.parametrize("length", [1.0, 0.1, 30.0])
def test_matrices_of_quaternions_of_any_length(length: float) -> None:
    wxyz = np.random.default_rng(1).normal(size=(40, 4))
    wxyz *= length / np.linalg.norm(wxyz, axis=1, keepdims=True)
    expected = Rotation.from_quat(wxyz, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation_matrix(jaxlie.SO3(jnp.asarray(wxyz))), expected, atol=1e-15)
    np.testing.assert_allclose(rotation_matrix(jaxlie.SO3(jnp.asarray(wxyz[3]))), expected[3], atol=1e-15)


def test_the_identity_is_exact() -> None:
    np.testing.assert_array_equal(rotation_matrix(jaxlie.SO3(jnp.array([1.0, 0, 0, 0]))), np.eye(3))


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1.0, np.pi - 1e-6, np.pi])
def test_derivatives_are_finite_differences(angle: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    wxyz = np.array([np.cos(angle / 2), *(np.sin(angle / 2) * axis)])

    def matrix(wxyz):
        return rotation_matrix(jaxlie.SO3(jnp.asarray(wxyz)))

    h = 1e-6
    differences = [(matrix(wxyz + h * step) - matrix(wxyz - h * step)) / (2 * h) for step in np.eye(4)]
    expected = np.stack(differences, axis=-1)
    for jacobian in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(jacobian(matrix)(jnp.asarray(wxyz)), expected, atol=1e-9)
