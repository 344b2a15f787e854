"""Rows that are masked out have no effect for any content, NaN and infinity included."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.mapping.frame import Frame
from lio_jax.mapping.voxel_map import anchor_of
from lio_jax.registration.scan_match import NormalEquations
from lio_jax.registration.voxel_planes import associate, linearise
from tests.registration.scenes import ROOM, map_of, params_with, pose, sample, seen_from

PARAMS = params_with()
TRUTH = pose([0.4, -0.3, 0.2], [0.02, -0.03, 0.3])
MAP = map_of(sample(ROOM, 4000, 0.005, seed=1), PARAMS)
POINTS = np.asarray(seen_from(TRUTH, sample(ROOM, 256, 0.005, seed=2)))
MASK = np.arange(len(POINTS)) % 3 != 0


@jax.jit
def normal_equations(points: jax.Array, mask: jax.Array) -> NormalEquations:
    frame = Frame(*anchor_of(TRUTH.translation(), PARAMS.map.voxel_size))
    matches = associate(MAP, points, mask, TRUTH, frame, PARAMS.map)
    return linearise(matches, points, TRUTH, frame, jnp.float64(0.5), PARAMS.lidar)


def spoilt(value: float) -> np.ndarray:
    points = POINTS.copy()
    points[~MASK] = value
    return points


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30])
def test_the_normal_equations_are_those_without_the_masked_rows(value: float) -> None:
    expected, found = normal_equations(POINTS, MASK), normal_equations(spoilt(value), MASK)
    assert int(expected.matches) > 100
    for left, right in zip(jax.tree.leaves(expected), jax.tree.leaves(found), strict=True):
        assert np.isfinite(right).all()
        np.testing.assert_array_equal(left, right)


def cost_at(points: jax.Array, move: jax.Array) -> jax.Array:
    T = pose([0.4, -0.3, 0.2], [0.02, -0.03, 0.3])
    T = jaxlie.SE3.from_rotation_and_translation(T.rotation() @ jaxlie.SO3.exp(move[:3]), move[3:])
    frame = Frame(*anchor_of(T.translation(), PARAMS.map.voxel_size))
    matches = associate(MAP, points, jnp.asarray(MASK), T, frame, PARAMS.map)
    return linearise(matches, points, T, frame, jnp.float64(0.5), PARAMS.lidar).squared_error


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_gradients_are_those_without_the_masked_rows(value: float) -> None:
    gradient = jax.jit(jax.grad(cost_at, argnums=1))
    move = jnp.array([0.01, 0.0, 0.0, 0.4, -0.3, 0.2])
    expected, found = gradient(POINTS, move), gradient(spoilt(value), move)
    assert np.linalg.norm(expected) > 1
    np.testing.assert_allclose(found, expected)
