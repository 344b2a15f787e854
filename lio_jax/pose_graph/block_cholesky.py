"""Sparse Cholesky factorisation of symmetric block matrices: chains first, then the multifrontal method.

The graph of a matrix has a node for each block on the diagonal and an edge for each block below it. Pose
graphs have long chains of nodes with two neighbours. :func:`chains_of` finds them, :func:`chain_reduction`
eliminates every second node of all chains at once, level by level (cyclic reduction), and
:mod:`~lio_jax.pose_graph.multifrontal` eliminates the nodes that are left. The order and the plan depend on
the graph only; :func:`factorise` and :func:`solve` work on the numbers.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components, depth_first_order

from lio_jax.pose_graph import multifrontal
from lio_jax.pose_graph.multifrontal import EliminationTree, NotPositiveDefiniteError, elimination_tree

_Numbers = NDArray[np.int64]
_Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Chains:
    """Chains in one array, one after the other, each between the two nodes at its ends."""

    nodes: _Numbers
    """(s,) number of each node; the count of all nodes where a chain has no neighbour at its end."""
    place: _Numbers
    """(s,) place of each node within its chain, from 0."""
    outside: _Flags
    """(s,) True for the neighbours at the ends of a chain, which are not part of it."""
    link: _Numbers
    """(s,) number of the pair of a node and the next one; -1 where there is none."""


def chains_of(count: int, pairs: _Numbers) -> Chains:
    """Return the chains of a graph.

    One node of each connected part is in no chain, so that a ring has ends as well. One node is also left out
    of each chain whose two ends have the same neighbour.

    Args:
        count: number of nodes.
        pairs: (m, 2) coupled nodes; no pair occurs twice.
    """
    inside = np.bincount(pairs.ravel(), minlength=count) <= 2
    inside[_first_of_each_part(count, pairs)] = False
    chains = _chains_among(inside, pairs)
    first, last = np.flatnonzero(chains.place == 0), np.flatnonzero(chains.place == 0) - 1
    last = np.append(last[1:], len(chains.place) - 1) if len(first) else last
    closed = (chains.nodes[first] == chains.nodes[last]) & (chains.nodes[first] < count)
    if np.any(closed):
        inside[chains.nodes[last[closed] - 1]] = False
        chains = _chains_among(inside, pairs)
    return chains


def _first_of_each_part(count: int, pairs: _Numbers) -> _Numbers:
    ones = np.ones(len(pairs), np.int8)
    graph = sparse.coo_array((ones, (pairs[:, 0], pairs[:, 1])), (count, count))
    return np.unique(connected_components(graph, directed=False)[1], return_index=True)[1]


def _chains_among(inside: _Flags, pairs: _Numbers) -> Chains:
    count = len(inside)
    a, b = pairs.T
    inner, outer = inside[a] & inside[b], inside[a] != inside[b]
    order, begins = _end_to_end(inside, pairs[inner])

    chain = np.cumsum(begins) - 1
    at = np.arange(len(order)) + 2 * chain + 1
    length = np.bincount(chain) + 2
    position = np.full(count, -1)
    position[order] = at
    nodes = np.full(length.sum(), count)
    nodes[at] = order
    place = np.arange(len(nodes)) - np.repeat(np.cumsum(length) - length, length)
    outside = np.ones(len(nodes), bool)
    outside[at] = False
    link = np.full(len(nodes), -1)
    link[np.minimum(position[a], position[b])[inner]] = np.flatnonzero(inner)

    own, other = np.where(inside[a], a, b)[outer], np.where(inside[a], b, a)[outer]
    again = np.ones(len(own), bool)
    again[np.unique(own, return_index=True)[1]] = False
    before = (place[position[own]] == 1) & ~again
    adjacent = position[own] + np.where(before, -1, 1)
    nodes[adjacent] = other
    link[np.minimum(adjacent, position[own])] = np.flatnonzero(outer)
    return Chains(nodes, place, outside, link)


def _end_to_end(inside: _Flags, inner: _Numbers) -> tuple[_Numbers, _Flags]:
    """Return the nodes of all chains in their order, and which of them begin a chain.

    A depth-first search from an extra node, which is coupled to all ends, visits one chain after the other.
    """
    root = len(inside)
    ends = np.flatnonzero(inside & (np.bincount(inner.ravel(), minlength=root) < 2))
    a, b = np.concatenate([inner, np.stack([np.full(len(ends), root), ends], -1)]).T
    graph = sparse.coo_array((np.ones(len(a), np.int8), (a, b)), (root + 1, root + 1))
    order, before = depth_first_order(graph.tocsr(), root, directed=False)
    return order[1:].astype(np.int64), before[order[1:]] == root


WORTH_A_LEVEL = 48
"""Least number of nodes in a level. Fewer nodes are eliminated as fast with the rest of the graph."""
_AT_ONCE = 1024
"""Largest number of nodes in a level. For more nodes, new memory costs more time than the arithmetic."""


@dataclass(frozen=True)
class Level:
    """Nodes that are eliminated at once, because none is coupled to another one.

    Blocks are numbered from those on the diagonal on; then follow those of the pairs, whose rows belong to
    the greater node. After the elimination the place of a node's first coupling holds the block that couples
    its two neighbours.
    """

    nodes: _Numbers
    """(k,) nodes to eliminate."""
    neighbours: _Numbers
    """(k, 2) neighbours of each node, the smaller first; the count of all nodes where there is none."""
    couplings: _Numbers
    """(k, 2) numbers of the blocks of a node with its neighbours; -1, the last block, which is zero, where
    there is none."""
    touched: _Numbers
    """(t,) all neighbours, each once."""
    sums: sparse.csr_array
    """(t, 2 k) matrix that sums what each node of ``touched`` receives from the level's nodes: from those
    whose first neighbour it is, then from those whose second neighbour it is."""


@dataclass(frozen=True)
class Reduction:
    """The elimination of a graph's chains, and the graph that is left."""

    levels: tuple[Level, ...]
    """Levels in the order of elimination."""
    kept: _Numbers
    """(c,) nodes that are left, ascending."""
    pairs: _Numbers
    """(p, 2) coupled nodes of the graph that is left, as places in ``kept``, the greater first."""
    sums: sparse.csr_array
    """(c + p, n + m + 1) matrix that maps all blocks, the last of which is zero, to those of the graph that
    is left."""


def chain_reduction(count: int, pairs: _Numbers, worth_a_level: int = WORTH_A_LEVEL) -> Reduction:
    """Return the levels in which the nodes of chains are eliminated, and the graph that is left.

    Args:
        count: number of nodes.
        pairs: (m, 2) coupled nodes, the greater first; no pair occurs twice.
        worth_a_level: least number of nodes in a level.
    """
    levels: list[Level] = []
    chains = chains_of(count, pairs)
    chains = replace(chains, link=np.where(chains.link < 0, -1, chains.link + count))
    in_chains = np.zeros(len(pairs), bool)
    in_chains[chains.link[chains.link >= 0] - count] = True
    left = np.ones(count, bool)
    while True:
        out = (chains.place % 2 == 1) & ~chains.outside
        at = np.flatnonzero(out)
        if len(at) < worth_a_level:
            break
        parts = np.array_split(at, -(-len(at) // _AT_ONCE))
        of_parts = [_level(count, chains, part) for part in parts]
        levels += of_parts
        left[chains.nodes[at]] = False
        link = chains.link.copy()
        link[at - 1] = np.concatenate([level.couplings[:, 0] for level in of_parts])
        chains = Chains(chains.nodes[~out], (chains.place[~out] + 1) // 2, chains.outside[~out], link[~out])
    following = np.append(chains.nodes[1:], count)
    couples = (chains.link >= 0) & (chains.nodes < count) & (following < count)
    ends = np.stack([chains.nodes[couples], following[couples]], -1)
    ends = np.concatenate([pairs[~in_chains], np.sort(ends, axis=-1)[:, ::-1]])
    block = np.concatenate([count + np.flatnonzero(~in_chains), chains.link[couples]])

    kept = np.flatnonzero(left)
    places = (np.cumsum(left) - 1)[ends]
    key, number = np.unique(places[:, 0] * len(kept) + places[:, 1], return_inverse=True)
    row = np.concatenate([np.arange(len(kept)), len(kept) + number])
    column = np.concatenate([kept, block])
    size = max(len(kept), 1)
    return Reduction(
        tuple(levels),
        kept,
        np.stack([key // size, key % size], -1),
        sparse.csr_array((np.ones(len(row)), (row, column)), (len(kept) + len(key), count + len(pairs) + 1)),
    )


def _level(count: int, chains: Chains, at: _Numbers) -> Level:
    neighbours = np.stack([chains.nodes[at - 1], chains.nodes[at + 1]], -1)
    couplings = np.stack([chains.link[at - 1], chains.link[at]], -1)
    turned = neighbours[:, 0] > neighbours[:, 1]
    neighbours[turned] = neighbours[turned, ::-1]
    couplings[turned] = couplings[turned, ::-1]
    both = neighbours.T.ravel()
    there = np.flatnonzero(both < count)
    touched, number = np.unique(both[there], return_inverse=True)
    sums = sparse.csr_array((np.ones(len(there)), (number, there)), (len(touched), len(both)))
    return Level(chains.nodes[at], neighbours, couplings, touched, sums)


_Array = NDArray[np.float64]


@dataclass(frozen=True)
class Order:
    """The order of elimination of a graph, for blocks of any size."""

    reduction: Reduction
    """Elimination of the chains."""
    tree: EliminationTree
    """Elimination of the graph that the reduction leaves."""


@dataclass(frozen=True)
class ChainPlan:
    """The plan of a factorisation, for all matrices of d by d blocks with one pattern."""

    order: Order
    """Order of elimination."""
    fronts: multifrontal.Plan
    """Plan for the graph that the reduction leaves."""

    @property
    def size(self) -> int:
        """Return d, the number of rows of a block."""
        return self.fronts.size


@dataclass(frozen=True)
class ChainFactor:
    """The Cholesky factor of a matrix."""

    plan: ChainPlan
    """Plan of the matrix's pattern."""
    levels: tuple["_Columns", ...]
    """Columns of the nodes of each level."""
    fronts: multifrontal.Factor
    """Factor of the matrix that the reduction leaves."""


@dataclass(frozen=True)
class _Columns:
    """Columns of the Cholesky factor for the k nodes of a level."""

    root: _Array
    """(k, d, d) L^-T of the factors L of the nodes' own blocks."""
    adjacent: _Array
    """(k, 2 d, d) rows of the nodes' two neighbours."""


def order_of(count: int, pairs: NDArray[np.int64], worth_a_level: int = WORTH_A_LEVEL) -> Order:
    """Return an order of elimination with little fill-in.

    Args:
        count: number of nodes.
        pairs: (m, 2) coupled nodes, the greater first; no pair occurs twice.
        worth_a_level: least number of nodes of chains that are eliminated at once.
    """
    reduction = chain_reduction(count, pairs, worth_a_level)
    return Order(reduction, elimination_tree(len(reduction.kept), reduction.pairs))


def plan_of(order: Order, size: int) -> ChainPlan:
    """Return the plan of a factorisation.

    Args:
        order: order of elimination.
        size: number of rows of a block.
    """
    reduction = order.reduction
    return ChainPlan(order, multifrontal.plan_of(reduction.pairs, size, order.tree))


def factorise(plan: ChainPlan, diagonal: _Array, pairs: _Array) -> ChainFactor:
    """Return the Cholesky factor of a symmetric matrix.

    Args:
        plan: plan of the matrix's pattern.
        diagonal: (n, d, d) blocks on the diagonal.
        pairs: (m, d, d) blocks of the pairs; their rows belong to the greater node.

    Raises:
        NotPositiveDefiniteError: the matrix is not positive definite.
    """
    reduction = plan.order.reduction
    if not reduction.levels:
        return ChainFactor(plan, (), multifrontal.factorise(plan.fronts, np.concatenate([diagonal, pairs])))
    size = plan.size
    # the last block stays zero: it stands for neighbours that do not exist
    blocks = np.concatenate([diagonal, pairs, np.zeros((1, size, size))])
    columns = tuple(_eliminated(level, blocks) for level in reduction.levels)
    left = (reduction.sums @ blocks.reshape(len(blocks), -1)).reshape(-1, size, size)
    return ChainFactor(plan, columns, multifrontal.factorise(plan.fronts, left))


def _eliminated(level: Level, blocks: _Array) -> _Columns:
    """Return the columns of a level's nodes, and reduce their neighbours' blocks to the Schur complement."""
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
        # the rows of the identity below this one are still zero, and stay zero
        stop = 3 * size + k + 1
        panel[k:stop, k] *= 1 / np.sqrt(panel[k, k])
        panel[k + 1 : stop, k + 1 :] -= panel[k + 1 : stop, k, None] * panel[k + 1 : size, k]
    adjacent = np.ascontiguousarray(panel[size : 3 * size].transpose(2, 0, 1))
    root = np.ascontiguousarray(panel[3 * size :].transpose(2, 0, 1))
    # a product with a copy of the transpose takes half the time of a product with its view
    explained = adjacent @ np.ascontiguousarray(adjacent.transpose(0, 2, 1))
    blocks[level.couplings[:, 0]] = -explained[:, size:, :size]
    own = np.concatenate([explained[:, :size, :size], explained[:, size:, size:]])
    blocks[level.touched] -= (level.sums @ own.reshape(2 * count, -1)).reshape(-1, size, size)
    return _Columns(root, adjacent)


def solve(factor: ChainFactor, right: _Array) -> _Array:
    """Return the solution x of A x = right.

    Args:
        factor: Cholesky factor of A.
        right: (n, d) right-hand side, or (n, d, k) for k of them.

    Returns:
        x, of the shape of ``right``.
    """
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
        onto = (columns.adjacent @ solved).reshape(len(solved), 2, -1).swapaxes(0, 1)
        x[level.touched] -= (level.sums @ onto.reshape(2 * len(solved), -1)).reshape(-1, *x.shape[1:])
    x[reduction.kept] = multifrontal.solve(factor.fronts, x[reduction.kept])
    for level, columns in reversed(steps):
        neighbours = x[level.neighbours].reshape(len(level.nodes), 2 * size, -1)
        left = x[level.nodes] - columns.adjacent.transpose(0, 2, 1) @ neighbours
        x[level.nodes] = columns.root @ left
    return x[:count].reshape(right.shape)
