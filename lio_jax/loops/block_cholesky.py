"""Sparse Cholesky factorisation of matrices made of small square blocks: chains first, then front by front.

On the host. Of a chain many nodes are eliminated at once, in arrays that have them along their last axis;
what is left is for dense linear algebra.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lio_jax.loops import multifrontal
from lio_jax.loops.chain_reduction import WORTH_A_LEVEL, Level, Reduction, chain_reduction
from lio_jax.loops.elimination_tree import EliminationTree, elimination_tree
from lio_jax.loops.multifrontal import NotPositiveDefiniteError

_Array = NDArray[np.float64]


@dataclass(frozen=True)
class Order:
    """The order of elimination, for blocks of any size."""

    reduction: Reduction
    tree: EliminationTree
    """Of what the reduction leaves."""


@dataclass(frozen=True)
class Plan:
    """All that does not depend on the numbers of a matrix of d by d blocks."""

    order: Order
    fronts: multifrontal.Plan

    @property
    def size(self) -> int:
        """d."""
        return self.fronts.size


@dataclass(frozen=True)
class Factor:
    """The Cholesky factor of a matrix."""

    plan: Plan
    levels: tuple["_Columns", ...]
    fronts: multifrontal.Factor


@dataclass(frozen=True)
class _Columns:
    """Of the k nodes of a level."""

    root: _Array
    """(k, d, d) L^-T of their own blocks' factors L."""
    beside: _Array
    """(k, 2 d, d) rows of their neighbours."""


def order_of(count: int, pairs: NDArray[np.int64], worth_a_level: int = WORTH_A_LEVEL) -> Order:
    """Return an order of little fill.

    Args:
        count: of nodes.
        pairs: (m, 2) nodes that are coupled, the greater first, none twice.
        worth_a_level: so many nodes of chains are eliminated at once, or none.
    """
    reduction = chain_reduction(count, pairs, worth_a_level)
    return Order(reduction, elimination_tree(len(reduction.kept), reduction.pairs))


def plan_of(order: Order, size: int) -> Plan:
    """Return the plan of matrices of size by size blocks."""
    reduction = order.reduction
    return Plan(order, multifrontal.plan_of(reduction.pairs, size, order.tree))


def factorise(plan: Plan, diagonal: _Array, pairs: _Array) -> Factor:
    """Return the factor of a symmetric matrix.

    Args:
        plan: of its pattern.
        diagonal: (n, d, d) blocks.
        pairs: (m, d, d) blocks, whose rows are the greater node's.

    Raises:
        NotPositiveDefiniteError: it is not positive definite.
    """
    reduction = plan.order.reduction
    if not reduction.levels:
        return Factor(plan, (), multifrontal.factorise(plan.fronts, np.concatenate([diagonal, pairs])))
    size = plan.size
    # the last one stays zero: of neighbours that aren't there
    blocks = np.concatenate([diagonal, pairs, np.zeros((1, size, size))])
    columns = tuple(_eliminated(level, blocks) for level in reduction.levels)
    left = (reduction.sums @ blocks.reshape(len(blocks), -1)).reshape(-1, size, size)
    return Factor(plan, columns, multifrontal.factorise(plan.fronts, left))


def _eliminated(level: Level, blocks: _Array) -> _Columns:
    """Return the columns of a level's nodes, and take what they explain from their neighbours' blocks."""
    count, size = len(level.nodes), blocks.shape[-1]
    couplings = blocks[level.couplings]
    turned = level.neighbours < level.nodes[:, None]
    couplings[turned] = couplings[turned].transpose(0, 2, 1)
    panel = np.empty((4 * size, size, count))
    panel[:size] = blocks[level.nodes].transpose(1, 2, 0)
    panel[size : 3 * size] = couplings.transpose(1, 2, 3, 0).reshape(2 * size, size, count)
    panel[3 * size :] = np.eye(size)[:, :, None]
    for k in range(size):
        if not np.all(panel[k, k] > 0):
            raise NotPositiveDefiniteError
        # of the identity's rows those that are still zero here stay so
        stop = 3 * size + k + 1
        panel[k:stop, k] *= 1 / np.sqrt(panel[k, k])
        panel[k + 1 : stop, k + 1 :] -= panel[k + 1 : stop, k, None] * panel[k + 1 : size, k]
    beside = np.ascontiguousarray(panel[size : 3 * size].transpose(2, 0, 1))
    root = np.ascontiguousarray(panel[3 * size :].transpose(2, 0, 1))
    # a product with a copy of the transpose takes half the time of one with its view
    explained = beside @ np.ascontiguousarray(beside.transpose(0, 2, 1))
    blocks[level.couplings[:, 0]] = -explained[:, size:, :size]
    own = np.concatenate([explained[:, :size, :size], explained[:, size:, size:]])
    blocks[level.touched] -= (level.sums @ own.reshape(2 * count, -1)).reshape(-1, size, size)
    return _Columns(root, beside)


def solve(factor: Factor, right: _Array) -> _Array:
    """Return the solution of A x = right for (n, d) or (n, d, k) right-hand sides."""
    reduction = factor.plan.order.reduction
    if not reduction.levels:
        return multifrontal.solve(factor.fronts, right)
    count, size = right.shape[:2]
    x = np.zeros((count + 1, size, int(np.prod(right.shape[2:]))))
    x[:count] = right.reshape(count, size, -1)
    steps = list(zip(reduction.levels, factor.levels, strict=True))
    for level, columns in steps:
        solved = columns.root.transpose(0, 2, 1) @ x[level.nodes]
        x[level.nodes] = solved
        onto = (columns.beside @ solved).reshape(len(solved), 2, -1).swapaxes(0, 1)
        x[level.touched] -= (level.sums @ onto.reshape(2 * len(solved), -1)).reshape(-1, *x.shape[1:])
    x[reduction.kept] = multifrontal.solve(factor.fronts, x[reduction.kept])
    for level, columns in reversed(steps):
        neighbours = x[level.neighbours].reshape(len(level.nodes), 2 * size, -1)
        left = x[level.nodes] - columns.beside.transpose(0, 2, 1) @ neighbours
        x[level.nodes] = columns.root @ left
    return x[:count].reshape(right.shape)
