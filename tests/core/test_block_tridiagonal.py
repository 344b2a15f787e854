"""Block-tridiagonal systems against dense matrices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.estimation.block_tridiagonal import (
    BlockTridiagonal,
    factorise,
    inverse_blocks,
    log_determinant,
    solve,
)

COUNT, SIZE = 6, 4


def blocks(seed: int) -> BlockTridiagonal:
    rng = np.random.default_rng(seed)
    diagonal = rng.normal(size=(COUNT, SIZE, 2 * SIZE))
    diagonal = diagonal @ diagonal.swapaxes(1, 2) + 4 * np.eye(SIZE)
    return BlockTridiagonal(jnp.asarray(diagonal), jnp.asarray(rng.normal(size=(COUNT - 1, SIZE, SIZE))))


def dense(matrix: BlockTridiagonal) -> np.ndarray:
    full = np.zeros((COUNT, SIZE, COUNT, SIZE))
    for k in range(COUNT):
        full[k, :, k] = matrix.diagonal[k]
    for k in range(COUNT - 1):
        full[k + 1, :, k] = matrix.coupling[k]
        full[k, :, k + 1] = matrix.coupling[k].T
    return full.reshape(COUNT * SIZE, COUNT * SIZE)


@pytest.mark.parametrize("seed", range(3))
def test_solution_determinant_and_inverse_are_the_dense_ones(seed):
    matrix = blocks(seed)
    full = dense(matrix)
    assert np.linalg.eigvalsh(full).min() > 0
    right = np.random.default_rng(9).normal(size=(COUNT, SIZE))
    factor = factorise(matrix)
    np.testing.assert_allclose(
        solve(factor, jnp.asarray(right)).ravel(), np.linalg.solve(full, right.ravel()), rtol=1e-10
    )
    assert float(log_determinant(matrix)) == pytest.approx(np.linalg.slogdet(full)[1], rel=1e-12)
    inverse = np.linalg.inv(full).reshape(COUNT, SIZE, COUNT, SIZE)
    found = inverse_blocks(factor)
    for k in range(COUNT):
        np.testing.assert_allclose(found.diagonal[k], inverse[k, :, k], atol=1e-12)
    for k in range(COUNT - 1):
        np.testing.assert_allclose(found.coupling[k], inverse[k + 1, :, k], atol=1e-12)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_the_determinants_derivative_is_a_central_difference(mode):
    matrix, along = blocks(0), blocks(1)
    along = BlockTridiagonal(along.diagonal + jnp.swapaxes(along.diagonal, 1, 2), along.coupling)

    def value(x):
        return log_determinant(jax.tree.map(lambda a, b: a + x * b, matrix, along))

    slope = (jax.grad if mode == "reverse" else jax.jacfwd)(value)(jnp.array(0.0))
    step = 1e-5
    assert float(slope) == pytest.approx(float(value(step) - value(-step)) / (2 * step), rel=1e-8)


def test_a_matrix_that_is_not_positive_definite_gives_no_number():
    matrix = blocks(0)
    broken = BlockTridiagonal(matrix.diagonal.at[3].multiply(-1), matrix.coupling)
    assert not np.isfinite(float(log_determinant(broken)))
