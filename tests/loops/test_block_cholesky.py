"""Sparse factorisation against dense algebra."""

import numpy as np
import pytest

from lio_jax.pose_graph.block_cholesky import factorise, order_of, plan_of, solve
from lio_jax.pose_graph.multifrontal import NotPositiveDefiniteError, elimination_tree

CHAIN = [(k + 1, k) for k in range(59)]
GRAPHS = {
    "chain": CHAIN,
    "chain in any order": [(7 * a % 60, 7 * b % 60) for a, b in CHAIN],
    "ring": [*CHAIN, (59, 0)],
    "two rings and a chain": [*CHAIN, (19, 0), (39, 20)],
    "chain with loops": [*CHAIN, (20, 3), (41, 5), (41, 20), (59, 30), (52, 50)],
    "chains between the same two": [
        *[(a, b) for a, b in CHAIN if a not in (20, 40)],
        (19, 0),
        (20, 0),
        (40, 0),
        (59, 19),
        (39, 19),
    ],
    "ring on a stalk": [*CHAIN, (59, 40)],
    "segments of one": [*CHAIN, *[(k + 2, k) for k in range(0, 56, 4)]],
    "loops everywhere": [*CHAIN, *[((k * 17 + 31) % 60, k) for k in range(60) if (k * 17 + 31) % 60 != k]],
    "star": [(k, 0) for k in range(1, 60)],
    "star of chains": [(k, k - 1 if k % 6 != 1 else 0) for k in range(1, 60)],
    "grid": [*CHAIN, *[(k + 8, k) for k in range(52)]],
    "two parts and loners": [(k + 1, k) for k in range(20)] + [(k + 1, k) for k in range(30, 50)],
    "random": [(int(a), int(b)) for a, b in np.random.default_rng(5).integers(0, 60, (150, 2)) if a != b],
    "random and sparse": [
        (int(a), int(b)) for a, b in np.random.default_rng(6).integers(0, 60, (55, 2)) if a != b
    ],
    "no pairs": [],
}


def pairs_of(name):
    """Return the pairs, the greater first, none twice."""
    return np.unique(np.sort(np.array(GRAPHS[name], np.int64).reshape(-1, 2))[:, ::-1], axis=0)


def system(name, size):
    """Return pairs, blocks and the dense matrix."""
    rng = np.random.default_rng(1)
    pairs = pairs_of(name)
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


def split(blocks):
    return blocks[:60], blocks[60:]


@pytest.mark.parametrize("worth_a_level", [1, 4, 1000])
@pytest.mark.parametrize("size", [2, 3, 6])
@pytest.mark.parametrize("name", GRAPHS)
def test_solution_is_that_of_the_dense_matrix(name, size, worth_a_level):
    pairs, blocks, dense = system(name, size)
    factor = factorise(plan_of(order_of(60, pairs, worth_a_level), size), *split(blocks))
    right = np.random.default_rng(2).normal(size=(60, size, 4))
    expected = np.linalg.solve(dense, right.reshape(60 * size, 4)).reshape(right.shape)
    np.testing.assert_allclose(solve(factor, right), expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(solve(factor, right[..., 0]), expected[..., 0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("worth_a_level", [1, 1000])
@pytest.mark.parametrize("at", [16, 17, 20, 59])
def test_what_is_not_positive_definite_is_refused(at, worth_a_level):
    pairs, blocks, _ = system("chain with loops", 3)
    blocks[at] -= 10 * np.eye(3)
    with pytest.raises(NotPositiveDefiniteError):
        factorise(plan_of(order_of(60, pairs, worth_a_level), 3), *split(blocks))


def test_what_is_not_a_number_is_refused():
    pairs, blocks, _ = system("chain", 3)
    blocks[16, 0, 0] = np.nan
    with pytest.raises(NotPositiveDefiniteError):
        factorise(plan_of(order_of(60, pairs, 1), 3), *split(blocks))


@pytest.mark.parametrize("name", GRAPHS)
def test_nodes_that_are_eliminated_at_once_are_not_coupled(name):
    pairs = pairs_of(name)
    for level in order_of(60, pairs, 1).reduction.levels:
        among_each_other = np.isin(pairs, level.nodes).all(axis=1)
        assert not np.any(among_each_other)
        assert not np.intersect1d(level.nodes, level.neighbours).size


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("chain", 1),
        ("ring", 2),
        ("chain with loops", 8),
        ("ring on a stalk", 3),
        ("grid", 59),
        ("no pairs", 60),
    ],
)
def test_chains_leave_only_what_they_hang_on(name, kept):
    assert len(order_of(60, pairs_of(name), 1).reduction.kept) == kept


def test_a_grid_has_no_levels():
    count, across = 400, 20
    number = np.arange(count)
    along = np.stack([number[1:], number[:-1]], -1)
    pairs = np.concatenate([along, np.stack([number[across:], number[:-across]], -1)])
    reduction = order_of(count, pairs).reduction
    assert reduction.levels == ()
    assert len(reduction.kept) == count


def test_chains_that_the_tree_takes_make_no_fill():
    chain = pairs_of("chain")
    assert all(len(front.rows) <= 2 for front in elimination_tree(60, chain).fronts)
