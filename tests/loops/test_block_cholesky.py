"""Sparse factorisation against dense algebra."""

import numpy as np
import pytest

from lio_jax.loops.block_cholesky import NotPositiveDefiniteError, factorise, plan_of, solve

GRAPHS = {
    "chain": [(k + 1, k) for k in range(59)],
    "star": [(k, 0) for k in range(1, 60)],
    "grid": [(k + 1, k) for k in range(59)] + [(k + 8, k) for k in range(52)],
    "two parts and loners": [(k + 1, k) for k in range(20)] + [(k + 1, k) for k in range(30, 50)],
    "random": [(int(a), int(b)) for a, b in np.random.default_rng(5).integers(0, 60, (150, 2)) if a > b],
    "no pairs": [],
}


def system(name, size):
    """Return pairs, blocks and the dense matrix."""
    rng = np.random.default_rng(1)
    pairs = np.unique(np.array(GRAPHS[name], np.int64).reshape(-1, 2), axis=0)
    dense = np.zeros((60, size, 60, size))
    for a, b in pairs:
        left, right = rng.normal(size=(2, size, size))
        dense[a, :, a] += left.T @ left
        dense[b, :, b] += right.T @ right
        dense[a, :, b] += left.T @ right
        dense[b, :, a] += right.T @ left
    for k in range(60):
        dense[k, :, k] += 0.1 * np.eye(size)
    diagonal = np.stack([dense[k, :, k] for k in range(60)])
    off = np.array([dense[a, :, b] for a, b in pairs]).reshape(-1, size, size)
    return pairs, np.concatenate([diagonal, off]), dense.reshape(60 * size, 60 * size)


@pytest.mark.parametrize("size", [2, 3, 6])
@pytest.mark.parametrize("name", GRAPHS)
def test_solution_is_that_of_the_dense_matrix(name, size):
    pairs, blocks, dense = system(name, size)
    factor = factorise(plan_of(60, pairs, size), blocks)
    right = np.random.default_rng(2).normal(size=(60, size, 4))
    expected = np.linalg.solve(dense, right.reshape(60 * size, 4)).reshape(right.shape)
    np.testing.assert_allclose(solve(factor, right), expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(solve(factor, right[..., 0]), expected[..., 0], rtol=1e-9, atol=1e-9)


def test_pairs_may_lie_on_either_side_of_the_diagonal():
    pairs, blocks, dense = system("grid", 3)
    turned = np.where(np.arange(len(pairs)) % 2 == 0)[0]
    pairs[turned] = pairs[turned, ::-1]
    blocks[60 + turned] = blocks[60 + turned].transpose(0, 2, 1)
    right = np.ones((60, 3))
    expected = np.linalg.solve(dense, right.ravel()).reshape(60, 3)
    np.testing.assert_allclose(solve(factorise(plan_of(60, pairs, 3), blocks), right), expected, rtol=1e-9)


def test_what_is_not_positive_definite_is_refused():
    pairs, blocks, _ = system("grid", 3)
    blocks[17] -= 10 * np.eye(3)
    with pytest.raises(NotPositiveDefiniteError):
        factorise(plan_of(60, pairs, 3), blocks)


def test_a_chain_makes_no_fill():
    chain = np.array(GRAPHS["chain"])
    assert all(len(front.rows) <= 2 for front in plan_of(60, chain, 6).tree.fronts)
