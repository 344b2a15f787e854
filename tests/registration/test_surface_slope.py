"""The derivative of a voxel's plane by its moments, against differences of LAPACK's decomposition."""

import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.registration.voxel_planes import surface_slope

RNG = np.random.default_rng(7)


def moments_of(points):
    x, y, z = points.T
    columns = [np.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z]
    return np.stack(columns).sum(1)


def distribution(moments):
    """Return mean, normal and the two smaller variances."""
    mean = moments[1:4] / moments[0]
    xx, yy, zz, xy, xz, yz = moments[4:] / moments[0]
    second = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    values, vectors = np.linalg.eigh(second - np.outer(mean, mean))
    return mean, vectors[:, 0], values[:2]


@pytest.mark.parametrize("sizes", [(0.3, 0.2, 0.01), (0.4, 0.02, 0.01), (0.3, 0.29, 0.28)])
def test_the_slope_is_that_of_the_eigendecomposition(sizes):
    turn = np.linalg.qr(RNG.normal(size=(3, 3)))[0]
    moments = moments_of(0.1 + (RNG.normal(size=(40, 3)) * sizes) @ turn.T)
    change = np.concatenate([[0.0], RNG.normal(size=9)])
    normal = distribution(moments)[1]
    step = 1e-7
    ends = [distribution(moments + sign * step * change) for sign in (1, -1)]
    signs = [np.sign(end[1] @ normal) for end in ends]
    found = surface_slope(*(jnp.asarray(one)[None] for one in (moments, normal, change)))
    high, low = ends
    np.testing.assert_allclose(found.mean[0], (high[0] - low[0]) / (2 * step), rtol=1e-6)
    turned = (signs[0] * high[1] - signs[1] * low[1]) / (2 * step)
    np.testing.assert_allclose(found.normal[0], turned, rtol=1e-3, atol=1e-3 * np.abs(turned).max())
    np.testing.assert_allclose(found.variances[0], (high[2] - low[2]) / (2 * step), rtol=1e-4)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "moments",
    [
        np.zeros(10),
        np.array([6, 0, 0, 0, 0.5, 0.5, 0.5, 0, 0, 0]),
        np.array([6, 0, 0, 0, 0.5, 1e-9, 1e-9, 0, 0, 0]),
        moments_of(np.full((5, 3), 0.2)),
    ],
    ids=["empty", "round", "a line", "coincident points"],
)
def test_the_slope_is_finite_where_variances_meet(moments, dtype):
    parts = moments, np.array([0.0, 0.0, 1.0]), np.arange(10.0)
    found = surface_slope(*(jnp.asarray(one, dtype)[None] for one in parts))
    assert all(np.isfinite(part).all() for part in found)
