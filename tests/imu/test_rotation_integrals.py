"""The integrals of a rotation against matrix exponentials, and their derivative at zero."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from lio_jax.imu.rotation_integrals import (
    SERIES_LIMIT,
    integral_derivatives,
    rotation_coefficients,
    rotation_exponential,
    rotation_integrals,
    rotation_series,
)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 0.3, 1.99, 2.01, 3.14, 6.0])
def test_integrals_are_those_of_the_matrix_exponential(angle: float) -> None:
    rotvec = angle * np.array([0.6, -0.48, 0.64])
    # exp of this block matrix holds the exponential, its integral and the integral of that in its first row
    block = np.zeros((9, 9))
    block[:3, :3] = np.cross(np.eye(3), rotvec)
    block[:3, 3:6] = block[3:6, 6:] = np.eye(3)
    expected = expm(block)
    first, second = rotation_integrals(jnp.asarray(rotvec))
    np.testing.assert_allclose(rotation_exponential(jnp.asarray(rotvec)), expected[:3, :3], atol=1e-14)
    np.testing.assert_allclose(first, expected[:3, 3:6], atol=1e-14)
    np.testing.assert_allclose(second, expected[:3, 6:], atol=1e-14)


def test_the_series_holds_to_float32_up_to_its_limit() -> None:
    squares = jnp.linspace(0, SERIES_LIMIT, 200)
    for near, exact in zip(rotation_series(squares), rotation_coefficients(squares).T[:4], strict=True):
        np.testing.assert_allclose(near, exact, atol=2e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 0.5, 1.99, 2.01, 5.0])
def test_derivatives_are_finite_differences(angle: float) -> None:
    vector = jnp.asarray([1.0, -2.0, 0.5])
    rotvec = angle * jnp.asarray([0.6, -0.48, 0.64])
    h = 1e-5
    for order in (0, 1):
        columns = [
            (rotation_integrals(rotvec + h * axis)[order] - rotation_integrals(rotvec - h * axis)[order])
            @ vector
            / (2 * h)
            for axis in jnp.eye(3)
        ]
        got = integral_derivatives(rotvec, vector)[order]
        np.testing.assert_allclose(got, np.stack(columns, axis=1), atol=1e-9)


def test_the_derivative_at_zero_is_finite_and_right() -> None:
    jacobian = jax.jacrev(lambda v: rotation_integrals(v)[0])(jnp.zeros(3))
    expected = np.stack([np.cross(np.eye(3), axis) / 2 for axis in np.eye(3)], axis=-1)
    np.testing.assert_allclose(jacobian, expected, atol=1e-15)
