"""Innovation statistics against the dense formulas they avoid."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from lio_jax.estimation.innovation import innovation_of, square_root_information


def residuals(seed, rank=6, count=40):
    """Return m whitened and unwhitened rows of a 6-dof measurement, their noise, and a prior covariance."""
    rng = np.random.default_rng(seed)
    basis = np.linalg.qr(rng.normal(size=(6, 6)))[0][:, :rank]
    H = rng.normal(size=(count, rank)) @ basis.T * 10.0
    R = rng.uniform(0.01, 0.5, count) ** 2
    root = rng.normal(size=(6, 6)) * 10.0 ** rng.uniform(-3, 0, (6, 1))
    covariance = root @ root.T
    r = rng.multivariate_normal(np.zeros(count), H @ covariance @ H.T + np.diag(R))
    return H, R, r, covariance


@jax.jit
def innovation_and_likelihood(information, gradient, covariance):
    root, whitened, values = square_root_information(information, gradient)
    innovation = innovation_of(root.T @ covariance @ root, whitened, values)
    return innovation, innovation.log_likelihood()


@pytest.mark.parametrize("rank", [6, 3, 1])
@pytest.mark.parametrize("unknown", [True, False])
def test_the_likelihood_of_the_pose_is_the_dense_one_where_observed(rank, unknown) -> None:
    H, R, r, covariance = residuals(11, rank)
    if not unknown:
        covariance[:, 2] = covariance[2] = 0
    information, gradient = H.T @ (H / R[:, None]), H.T @ (r / R)
    innovation, likelihood = innovation_and_likelihood(information, gradient, covariance)
    kept, basis = np.linalg.eigh(information)
    basis = basis[:, kept > 1e-9 * kept[-1]]
    offset = -basis.T @ np.linalg.pinv(information, rcond=1e-9) @ gradient
    S = basis.T @ (np.linalg.pinv(information, rcond=1e-9) + covariance) @ basis
    dense = multivariate_normal(np.zeros(rank), S)
    assert int(innovation.dof) == rank
    np.testing.assert_allclose(innovation.nis, offset @ np.linalg.solve(S, offset), rtol=1e-9)
    np.testing.assert_allclose(innovation.log_det, np.linalg.slogdet(S)[1], rtol=1e-9)
    np.testing.assert_allclose(likelihood, dense.logpdf(offset), rtol=1e-9)


def test_the_square_root_restores_information_and_gradient() -> None:
    H, R, r, _ = residuals(5, rank=4)
    information, gradient = H.T @ (H / R[:, None]), H.T @ (r / R)
    # rounding may leave slightly negative eigenvalues
    information -= 1e-12 * np.linalg.norm(information) * np.eye(6)
    root, whitened, values = square_root_information(jnp.asarray(information), jnp.asarray(gradient))
    np.testing.assert_allclose(root @ root.T, information, atol=1e-9 * np.abs(information).max())
    np.testing.assert_allclose(root @ whitened, gradient, atol=1e-9 * np.abs(gradient).max())
    assert int((values > 0).sum()) == 4
