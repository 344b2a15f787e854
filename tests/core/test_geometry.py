"""Closed forms on 3x3 symmetric matrices against LAPACK in double precision, and slopes of the inverse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.geometry import eigenvalues_and_normal3, inverse

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


def decomposed(full: np.ndarray, dtype) -> tuple[np.ndarray, np.ndarray]:
    """Return eigenvalues and normals as computed in ``dtype``."""
    values, normals = jax.jit(eigenvalues_and_normal3)(*parts(full, dtype))
    assert values.dtype == normals.dtype == dtype
    return np.asarray(values, np.float64), np.asarray(normals, np.float64)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("name", SPECTRA)
def test_eigenvalues_are_lapacks(name, dtype):
    full = matrices(SPECTRA[name])
    values, _ = decomposed(full, dtype)
    expected = np.linalg.eigvalsh(as_stored(full, dtype))
    eps = float(np.finfo(dtype).eps)
    largest = SPECTRA[name][0]
    # arccos loses half of the digits where two eigenvalues meet
    meet = len(set(SPECTRA[name])) < 3
    np.testing.assert_allclose(values, expected, atol=largest * (2 * eps**0.5 if meet else 100 * eps))


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("name", ["random", "flat", "two equal large", "large", "nearly coincident points"])
def test_normal_and_its_variance_are_lapacks(name, dtype):
    full = matrices(SPECTRA[name])
    values, normals = decomposed(full, dtype)
    expected_values, vectors = np.linalg.eigh(as_stored(full, dtype))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)
    smallest, middle, largest = SPECTRA[name][2], SPECTRA[name][1], SPECTRA[name][0]
    # a rounding of the matrix turns its eigenvectors by (rounding) / (gap of the eigenvalues)
    eps = float(np.finfo(dtype).eps)
    allowed = 50 * eps * largest / (middle - smallest)
    misaligned = np.linalg.norm(np.cross(normals, vectors[:, :, 0]), axis=1)
    assert misaligned.max() < max(allowed, 4 * eps**0.5 if name == "two equal large" else 0)
    # the variance along the normal survives float32 although it is far below the matrix's entries
    np.testing.assert_allclose(values[:, 0], expected_values[:, 0], atol=20 * eps * largest)


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_diagonal_matrices_are_exact(dtype):
    diagonal = jnp.asarray([[1.0, 2.0, 3.0], [3.0, 2.0, 1.0], [7.0, 0.0, 3.0]], dtype)
    values, normals = eigenvalues_and_normal3(diagonal, jnp.zeros_like(diagonal))
    np.testing.assert_allclose(values, np.sort(diagonal, -1), atol=20 * np.finfo(dtype).eps)
    np.testing.assert_allclose(np.abs(normals), [[1, 0, 0], [0, 0, 1], [0, 1, 0]], atol=1e-3)


@pytest.mark.parametrize("dtype", PRECISIONS)
@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-20, 1e-12, 1e-6, 1.0, 1e6])
def test_everything_is_finite_at_any_scale(scale, dtype):
    full = scale * matrices((1.0, 0.5, 0.1), count=50)
    values, normals = decomposed(full, dtype)
    assert np.isfinite(values).all()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, rtol=1e-5)


@pytest.mark.parametrize("dtype", PRECISIONS)
def test_coincident_points_have_an_upright_normal(dtype):
    diagonal = jnp.full((4, 3), 0.25, dtype)
    values, normals = eigenvalues_and_normal3(diagonal, jnp.zeros_like(diagonal))
    np.testing.assert_allclose(values, 0.25, rtol=1e-6)
    np.testing.assert_allclose(normals, np.tile([0, 0, 1], (4, 1)), atol=1e-15)


def test_any_batch_shape():
    full = matrices((3.0, 2.0, 1.0), count=6).reshape(2, 3, 3, 3)
    values, normals = eigenvalues_and_normal3(*parts(full, jnp.float64))
    assert values.shape == normals.shape == (2, 3, 3)


def test_derivatives_of_the_inverse_are_finite_differences():
    rng = np.random.default_rng(5)
    matrix, direction = rng.normal(size=(2, 6, 6))
    matrix += 6 * np.eye(6)
    h = 1e-6
    difference = (np.linalg.inv(matrix + h * direction) - np.linalg.inv(matrix - h * direction)) / (2 * h)
    _, forward = jax.jit(lambda a, b: jax.jvp(inverse, (a,), (b,)))(matrix, direction)
    np.testing.assert_allclose(forward, difference, rtol=1e-7, atol=1e-9)
    weights = rng.normal(size=(6, 6))
    slope = jax.jit(jax.grad(lambda matrix: jnp.sum(weights * inverse(matrix))))(matrix)
    np.testing.assert_allclose(np.sum(slope * direction), np.sum(weights * difference), rtol=1e-7)
