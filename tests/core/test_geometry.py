"""Closed forms on 3x3 symmetric matrices against LAPACK in double precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.geometry import inverse3, largest_eigenvalue3, symmetric3

PRECISIONS = [jnp.float32, jnp.float64]

SPECTRA = {
    "random": (1.0, 0.4, 0.05),
    "flat": (0.3, 0.2, 1e-3),
    "line": (0.3, 1e-3, 5e-4),
    "isotropic": (0.25, 0.25, 0.25),
    "two equal large": (0.4, 0.4, 1e-3),
    "two equal small": (0.4, 1e-3, 1e-3),
    "large": (1e6, 4e5, 2e4),
    "nearly coincident points": (1e-9, 4e-10, 2e-11),
}
"""Eigenvalues, m^2, as voxels have them."""


def matrices(spectrum, count=500) -> np.ndarray:
    """Return (count, 3, 3) with the given eigenvalues and random axes."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    full = axes @ (np.asarray(spectrum)[:, None] * axes.transpose(0, 2, 1))
    return (full + full.transpose(0, 2, 1)) / 2


def parts(full: np.ndarray, dtype) -> tuple[jax.Array, jax.Array]:
    """Return diagonal xx yy zz and off-diagonal xy xz yz."""
    diagonal = full[..., [0, 1, 2], [0, 1, 2]]
    off_diagonal = full[..., [0, 0, 1], [1, 2, 2]]
    return jnp.asarray(diagonal, dtype), jnp.asarray(off_diagonal, dtype)


def as_stored(full: np.ndarray, dtype) -> np.ndarray:
    """Return the matrices after rounding to ``dtype``, so that only the algorithm's error is measured."""
    return full.astype(dtype).astype(np.float64)


def tolerance(name: str, dtype) -> float:
    """Return the relative error allowed: arccos loses half of the digits where the two largest meet."""
    eps = float(np.finfo(dtype).eps)
    return eps**0.5 if name == "two equal large" else 20 * eps


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("name", SPECTRA)
def test_largest_eigenvalue_is_lapacks(name, dtype):
    full = matrices(SPECTRA[name])
    found = np.asarray(jax.jit(largest_eigenvalue3)(*parts(full, dtype)), np.float64)
    expected = np.linalg.eigvalsh(as_stored(full, dtype))[:, -1]
    np.testing.assert_allclose(found, expected, rtol=tolerance(name, dtype))


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("name", SPECTRA)
def test_inverse_is_lapacks(name, dtype):
    full = matrices(SPECTRA[name])
    diagonal, off_diagonal = jax.jit(inverse3)(*parts(full, dtype))
    found = np.asarray(symmetric3(diagonal, off_diagonal), np.float64)
    expected = np.linalg.inv(as_stored(full, dtype))
    condition = SPECTRA[name][0] / SPECTRA[name][-1]
    error = np.abs(found - expected).max((1, 2)) / np.abs(expected).max((1, 2))
    assert error.max() < 20 * condition * np.finfo(dtype).eps


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_largest_eigenvalue_of_diagonal_matrices_is_exact(dtype):
    diagonal = jnp.asarray([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0], [5.0, 5.0, 5.0], [7.0, 0.0, 0.0]], dtype)
    found = largest_eigenvalue3(diagonal, jnp.zeros_like(diagonal))
    np.testing.assert_allclose(found, [3, 3, 5, 7], rtol=10 * np.finfo(dtype).eps)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-20, 1e-12, 1e-6, 1.0, 1e6])
def test_largest_eigenvalue_is_finite_at_any_scale(scale, dtype):
    full = scale * matrices((1.0, 0.5, 0.1), count=50)
    found = np.asarray(largest_eigenvalue3(*parts(full, dtype)), np.float64)
    assert np.isfinite(found).all()
    # below the square root of the smallest float the spread is lost, the mean is not
    np.testing.assert_allclose(found, scale, rtol=1e-3, atol=1e-17 if dtype == jnp.float32 else 1e-150)


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_points_that_coincide_with_measurement_noise_have_a_finite_inverse(dtype):
    """A voxel whose points coincide has covariance zero; the range noise alone is inverted."""
    variance = 0.02**2
    diagonal = jnp.full((4, 3), variance, dtype)
    inverse, off_inverse = inverse3(diagonal, jnp.zeros_like(diagonal))
    np.testing.assert_allclose(inverse, 1 / variance, rtol=1e-5)
    np.testing.assert_array_equal(off_inverse, 0)
    np.testing.assert_allclose(
        largest_eigenvalue3(diagonal, jnp.zeros_like(diagonal)), variance, rtol=10 * np.finfo(dtype).eps
    )


def test_symmetric3_places_every_entry():
    full = matrices((3.0, 2.0, 1.0), count=7)
    np.testing.assert_array_equal(symmetric3(*parts(full, jnp.float64)), full)


def test_any_batch_shape():
    full = matrices((3.0, 2.0, 1.0), count=6).reshape(2, 3, 3, 3)
    diagonal, off_diagonal = parts(full, jnp.float64)
    assert largest_eigenvalue3(diagonal, off_diagonal).shape == (2, 3)
    assert largest_eigenvalue3(diagonal[0, 0], off_diagonal[0, 0]).shape == ()
    assert symmetric3(*inverse3(diagonal, off_diagonal)).shape == (2, 3, 3, 3)
