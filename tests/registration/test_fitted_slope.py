"""Derivatives of fitted planes and lines by their points, against differences of LAPACK decompositions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.registration.knn_planes import FittedPlanes
from lio_jax.registration.lines_and_planes import line_through

RNG = np.random.default_rng(11)
COUNT = 40


def clouds(points, sizes):
    """Return (k, n, 3) points with the given spread along axes of any direction, away from the origin."""
    turns = np.linalg.qr(RNG.normal(size=(COUNT, 3, 3)))[0]
    spread = RNG.uniform(-1, 1, (COUNT, points, 3)) * sizes
    return spread @ turns + RNG.uniform(-20, 20, (COUNT, 1, 3))


def decomposed(points):
    """Return centres, directions of the largest variance, and of the smallest."""
    centre = points.mean(1)
    directions = np.linalg.svd(points - centre[:, None])[2]
    return centre, directions[:, 0], directions[:, 2]


def rows(points):
    return jnp.asarray(np.moveaxis(points, 1, 2).reshape(COUNT, -1))


def from_planes(points, queries):
    centre, _, normal = decomposed(points)
    return normal, np.sum(normal * (queries - centre), -1)


def squared_from_lines(points, queries):
    centre, direction, _ = decomposed(points)
    return np.sum(np.cross(queries - centre, direction) ** 2, -1)


def entries(points):
    return jnp.zeros((points.shape[1], COUNT), jnp.int32)


@pytest.mark.parametrize("count", [3, 5])
def test_planes_follow_their_points(count):
    points, change = clouds(count, [0.6, 0.4, 0.02]), RNG.normal(size=(COUNT, count, 3))
    queries = points.mean(1) + RNG.normal(0, 0.3, (COUNT, 3))
    centre, _, normal = decomposed(points)
    valid = jnp.ones(COUNT, bool)
    planes = FittedPlanes(
        jnp.asarray(normal), jnp.asarray(-np.sum(normal * centre, -1)), valid, entries(points)
    )

    def distance(moved):
        followed = planes.following(moved)
        return jnp.sum(followed.normal * queries, -1) + followed.offset

    value, slope = jax.jvp(distance, (rows(points),), (rows(change),))
    step = 1e-7
    high, low = (from_planes(points + sign * step * change, queries) for sign in (1, -1))
    along, back = (np.sign(np.sum(end[0] * normal, -1)) * end[1] for end in (high, low))
    expected = (along - back) / (2 * step)
    np.testing.assert_allclose(value, np.sum(normal * (queries - centre), -1), atol=1e-9)
    np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("count", [2, 5])
def test_lines_follow_their_points(count):
    points, change = clouds(count, [0.6, 0.05, 0.04]), RNG.normal(size=(COUNT, count, 3))
    queries = points.mean(1) + RNG.normal(0, 0.3, (COUNT, 3))
    centre, direction, _ = decomposed(points)
    lines = line_through(
        tuple(jnp.asarray(centre.T)), jnp.asarray(direction), jnp.ones(COUNT, bool), entries(points)
    )

    def squared(moved):
        followed = lines.following(moved)
        both = (followed.first, followed.second)
        return sum((jnp.sum(plane.normal * queries, -1) + plane.offset) ** 2 for plane in both)

    value, slope = jax.jvp(squared, (rows(points),), (rows(change),))
    step = 1e-7
    high, low = (squared_from_lines(points + sign * step * change, queries) for sign in (1, -1))
    expected = (high - low) / (2 * step)
    np.testing.assert_allclose(value, squared_from_lines(points, queries), rtol=1e-7)
    np.testing.assert_allclose(slope, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(
    "points",
    [np.zeros((5, 3)), np.full((5, 3), 7.0), np.outer(np.arange(5.0), [1, 2, 3])],
    ids=["no points", "coincident points", "a line"],
)
def test_the_derivative_is_finite_without_a_plane_or_a_line(points, dtype):
    held = jnp.asarray(points.T.reshape(1, -1), dtype)
    axis, one = jnp.asarray([[0, 0, 1]], dtype), jnp.ones(1, bool)
    entry = jnp.zeros((5, 1), jnp.int32)
    planes = FittedPlanes(axis, jnp.zeros(1, dtype), one, entry)
    lines = line_through(tuple(jnp.zeros((3, 1), dtype)), axis, one, entry)
    for fitted in (planes, lines):

        def normals(moved, fitted=fitted):
            return [leaf for leaf in jax.tree.leaves(fitted.following(moved)) if leaf.dtype == dtype]

        slopes = jax.jacfwd(normals)(held)
        assert all(np.isfinite(slope).all() for slope in slopes)
