"""Multifrontal Cholesky factorisation of sparse block matrices along an elimination tree."""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.linalg import blas, lapack
from scipy.sparse.linalg import splu
from threadpoolctl import ThreadpoolController

_TOGETHER = 16
"""Number of nodes up to which a child and its parent are always joined, to save the overhead of a front."""
_ZEROS = 0.2
"""Largest share of zeros in a larger front that is joined of a child and its parent."""


@dataclass(frozen=True)
class Front:
    """Nodes that are eliminated together, in one dense matrix.

    Nodes are numbered by their position in the order of elimination.
    """

    start: int
    """First node that is eliminated here."""
    stop: int
    """First node after those that are eliminated here."""
    rows: NDArray[np.int64]
    """Nodes of later fronts that are coupled to the front's own nodes, ascending."""
    parent: int
    """Number of the front to which this one's Schur complement is added; -1: none."""


@dataclass(frozen=True)
class EliminationTree:
    """The order of elimination of n nodes, and their fronts."""

    position: NDArray[np.int64]
    """(n,) position of each node in the order of elimination."""
    fronts: tuple[Front, ...]
    """Fronts in the order of elimination; children are before their parents."""


def elimination_tree(count: int, pairs: NDArray[np.int64]) -> EliminationTree:
    """Return an order of elimination with little fill-in, and its fronts.

    The order is SuperLU's minimum degree (Liu, "Modification of the minimum-degree algorithm by multiple
    elimination", 1985). SuperLU's factor of the graph's Laplacian has the pattern of the Cholesky factor.
    Nodes whose columns have the same pattern are joined into supernodes, and small supernodes are joined with
    their parents (Ashcraft & Grimes, "The influence of relaxed supernode partitions on the multifrontal
    method", 1989).

    Args:
        count: number of nodes.
        pairs: (m, 2) coupled nodes.
    """
    if count == 0:
        return EliminationTree(np.zeros(0, np.int64), ())
    minimum_degree = splu(
        _laplacian(count, pairs),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        relax=1,
        panel_size=1,
        options={"SymmetricMode": True},
    )
    lower = minimum_degree.L.tocsc()
    lower.sort_indices()
    column_start = lower.indptr.astype(np.int64)
    below = np.diff(column_start) - 1
    parent = np.full(count, -1)
    parent[below > 0] = lower.indices[column_start[:-1][below > 0] + 1]

    first = _supernodes(parent, below)
    last = np.append(first[1:], count) - 1
    supernode = np.repeat(np.arange(len(first)), last - first + 1)
    parent_supernode = np.where(parent[last] >= 0, supernode[parent[last]], -1)
    kept_in = _amalgamated(last - first + 1, below[last], parent_supernode)
    order, kept = _postorder(kept_in, parent_supernode)

    widths = (last - first + 1)[order]
    renumbered = np.empty(count, np.int64)
    starts = np.cumsum(widths) - widths
    renumbered[np.repeat(first[order] - starts, widths) + np.arange(count)] = np.arange(count)
    number = np.full(len(first), -1)
    number[kept] = np.arange(len(kept))
    stops = np.cumsum(np.bincount(number[kept_in], weights=last - first + 1, minlength=len(kept)).astype(int))
    fronts = []
    for index, top in enumerate(kept):
        column = slice(column_start[last[top]] + 1, column_start[last[top] + 1])
        above = parent_supernode[top]
        fronts.append(
            Front(
                start=int(stops[index - 1]) if index else 0,
                stop=int(stops[index]),
                rows=np.sort(renumbered[lower.indices[column]]),
                parent=int(number[kept_in[above]]) if above >= 0 else -1,
            )
        )
    return EliminationTree(renumbered[minimum_degree.perm_c], tuple(fronts))


def _laplacian(count: int, pairs: NDArray[np.int64]) -> sparse.csc_matrix:
    """Return the graph's Laplacian plus the identity: its factor exists, and no entry cancels to zero."""
    ones = np.ones(len(pairs))
    coupled = sparse.coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), (count, count)).tocsr()
    coupled = coupled + coupled.T
    degrees = np.asarray(coupled.sum(1)).ravel()
    return (sparse.diags(degrees + 1) - coupled).tocsc()


def _supernodes(parent: NDArray[np.int64], below: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the first column of each run of columns that have the same pattern below them."""
    children = np.bincount(parent[parent >= 0], minlength=len(parent))
    goes_on = (parent[:-1] == np.arange(1, len(parent))) & (below[:-1] == below[1:] + 1) & (children[1:] == 1)
    return np.flatnonzero(np.append(True, ~goes_on))


def _amalgamated(
    width: NDArray[np.int64], below: NDArray[np.int64], parent: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return for each supernode the one in whose front it is eliminated: itself or an ancestor."""
    widths, rows, above = width.tolist(), below.tolist(), parent.tolist()
    zeros = [0] * len(widths)
    joined = list(range(len(widths)))
    for child, up in enumerate(above):
        if up < 0:
            continue
        together = widths[child] + widths[up]
        filled = zeros[child] + zeros[up] + widths[child] * (widths[up] + rows[up] - rows[child])
        if together <= _TOGETHER or filled < _ZEROS * together * ((together + 1) / 2 + rows[up]):
            joined[child], widths[up], zeros[up] = up, together, filled
    for child in reversed(range(len(joined))):
        joined[child] = joined[joined[child]]
    return np.array(joined)


def _postorder(kept_in: NDArray[np.int64], parent: NDArray[np.int64]) -> tuple[list[int], list[int]]:
    """Return the supernodes, front by front and children first, and the topmost one of each front."""
    members: list[list[int]] = [[] for _ in kept_in]
    children: list[list[int]] = [[] for _ in kept_in]
    for supernode, top in enumerate(kept_in.tolist()):
        members[top].append(supernode)
    roots: list[int] = []
    kept = np.unique(kept_in).tolist()
    for top in kept:
        above = parent[top]
        (children[kept_in[above]] if above >= 0 else roots).append(top)
    order: list[int] = []
    fronts: list[int] = []
    stack = [(root, False) for root in reversed(roots)]
    while stack:
        top, ready = stack.pop()
        if ready:
            order += members[top]
            fronts.append(top)
        else:
            stack.append((top, True))
            stack += [(child, False) for child in reversed(children[top])]
    return order, fronts


_Run = tuple[slice, slice]
_Runs = tuple[_Run, ...]


@dataclass(frozen=True)
class _Share:
    """Where the rows of a child's Schur complement lie in its parent, as runs (rows of child, of parent)."""

    in_panel: _Runs
    """Runs in the parent's panel."""
    in_rest: _Runs
    """Runs in the parent's own Schur complement."""


@dataclass(frozen=True)
class Plan:
    """The plan of a factorisation, for all matrices of d by d blocks with one pattern.

    A front's panel holds its columns: first the rows of its own nodes, then those of its ``rows``.
    """

    tree: EliminationTree
    """Order of elimination."""
    size: int
    """Number d of rows of a block."""
    places: NDArray[np.int64]
    """(n + m, d, d) places of the blocks' entries in one array of all panels."""
    offsets: tuple[int, ...]
    """Place where each front's panel begins, and where the last one ends."""
    shares: tuple[_Share | None, ...]
    """Places of each front's Schur complement in its parent; None without a parent."""
    own: tuple[slice, ...]
    """Places of each front's own nodes in a vector in the order of elimination."""
    rows: tuple[NDArray[np.int64], ...]
    """Places of the nodes to which each front's own nodes are coupled."""


def plan_of(pairs: NDArray[np.int64], size: int, tree: EliminationTree) -> Plan:
    """Return the plan of a matrix with n diagonal blocks and m blocks at (pairs[k, 0], pairs[k, 1]).

    Args:
        pairs: (m, 2) row and column of each block, below or above the diagonal; no pair occurs twice.
        size: number of rows of a block.
        tree: elimination tree of the same pairs.
    """
    fronts = tree.fronts
    widths = np.array([front.stop - front.start for front in fronts], np.int64)
    heights = widths + np.array([len(front.rows) for front in fronts], np.int64)
    offsets = np.concatenate([[0], np.cumsum(widths * heights * size**2)])
    return Plan(
        tree,
        size,
        _places(tree, pairs, size, widths, offsets),
        tuple(offsets.tolist()),
        _shares(tree, size),
        tuple(slice(front.start * size, front.stop * size) for front in fronts),
        tuple((front.rows[:, None] * size + np.arange(size)).ravel() for front in fronts),
    )


def _places(
    tree: EliminationTree,
    pairs: NDArray[np.int64],
    size: int,
    widths: NDArray[np.int64],
    offsets: NDArray[np.int64],
) -> NDArray[np.int64]:
    count = len(tree.position)
    row = np.concatenate([tree.position, tree.position[pairs[:, 0]]])
    column = np.concatenate([tree.position, tree.position[pairs[:, 1]]])
    turned = (row < column)[:, None, None]
    row, column = np.maximum(row, column), np.minimum(row, column)
    front_of = np.repeat(np.arange(len(widths)), widths)
    starts = np.cumsum(widths) - widths
    front = front_of[column]
    within = row - starts[front]
    lengths = np.array([len(front.rows) for front in tree.fronts], np.int64)
    keys = np.repeat(np.arange(len(widths)), lengths) * count
    keys = keys + np.concatenate([front.rows for front in tree.fronts] + [np.zeros(0, np.int64)])
    found = np.searchsorted(keys, front * count + row) - (np.cumsum(lengths) - lengths)[front]
    within = np.where(within < widths[front], within, widths[front] + found)
    entry = np.arange(size)
    across, down = np.where(turned, entry[:, None], entry), np.where(turned, entry, entry[:, None])
    line = within[:, None, None] * size + down
    return (
        offsets[front][:, None, None]
        + line * (widths[front] * size)[:, None, None]
        + (column - starts[front])[:, None, None] * size
        + across
    )


def _shares(tree: EliminationTree, size: int) -> tuple[_Share | None, ...]:
    """Return where each front's Schur complement lies in its parent, as runs of consecutive rows."""
    fronts, count = tree.fronts, len(tree.position)
    rows = np.concatenate([front.rows for front in fronts] + [np.zeros(0, np.int64)])
    lengths = np.array([len(front.rows) for front in fronts], np.int64)
    begins = np.cumsum(lengths) - lengths
    child = np.repeat(np.arange(len(fronts)), lengths)
    parent = np.array([front.parent for front in fronts], np.int64)[child]
    starts = np.array([front.start for front in fronts], np.int64)[parent]
    in_panel = rows < np.array([front.stop for front in fronts], np.int64)[parent]
    found = np.searchsorted(child * count + rows, parent * count + rows) - begins[parent]
    place = np.where(in_panel, rows - starts, found)
    new = np.ones(len(rows), bool)
    new[1:] = (np.diff(child) != 0) | np.diff(in_panel) | (np.diff(place) != 1)
    first = np.flatnonzero(new)
    stop = np.append(first[1:], len(rows))
    within = first - begins[child[first]]
    runs = zip(
        child[first].tolist(),
        in_panel[first].tolist(),
        (within * size).tolist(),
        (place[first] * size).tolist(),
        ((stop - first) * size).tolist(),
        strict=True,
    )
    panel: list[list[_Run]] = [[] for _ in fronts]
    rest: list[list[_Run]] = [[] for _ in fronts]
    for number, own, at, to, length in runs:
        (panel if own else rest)[number].append((slice(at, at + length), slice(to, to + length)))
    return tuple(
        _Share(tuple(own), tuple(others)) if front.parent >= 0 else None
        for front, own, others in zip(fronts, panel, rest, strict=True)
    )


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix has no Cholesky factor."""


@dataclass(frozen=True)
class Factor:
    """The Cholesky factor of a matrix, as one panel per front."""

    plan: Plan
    """Plan of the matrix's pattern."""
    panels: tuple[NDArray[np.float64], ...]
    """Columns of the factor for each front."""


@cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()


def one_thread() -> AbstractContextManager:
    """Return a context in which BLAS runs on one thread.

    The fronts are small, so the threads of BLAS would wait for each other. Where other programs use the
    processor as well, they would wait hundreds of times as long.
    """
    return _libraries().limit(limits=1, user_api="blas")


def factorise(plan: Plan, blocks: NDArray[np.float64]) -> Factor:
    """Return the factor of a symmetric matrix.

    Args:
        plan: plan of the matrix's pattern.
        blocks: (n + m, d, d) blocks on the diagonal, then those of the pairs.

    Raises:
        NotPositiveDefiniteError: the matrix is not positive definite.
    """
    size = plan.size
    numbers = np.zeros(plan.offsets[-1])
    numbers[plan.places.ravel()] = blocks.ravel()
    panels = []
    waiting: list[list[tuple[_Share, NDArray[np.float64]]]] = [[] for _ in plan.tree.fronts]
    for index, front in enumerate(plan.tree.fronts):
        width, rest = (front.stop - front.start) * size, len(front.rows) * size
        panel = numbers[plan.offsets[index] : plan.offsets[index + 1]].reshape(width + rest, width)
        left = np.zeros((rest, rest))
        for share, update in waiting[index]:
            _extend_add(share, update, panel, left, width)
        waiting[index].clear()
        # LAPACK stores columns first: its upper triangle is the lower one here
        _, failed = lapack.dpotrf(panel[:width].T, lower=0, clean=0, overwrite_a=1)
        if failed:
            raise NotPositiveDefiniteError
        if rest:
            blas.dtrsm(1.0, panel[:width].T, panel[width:].T, lower=0, trans_a=1, overwrite_b=1)
            blas.dsyrk(-1.0, panel[width:].T, 1.0, left.T, trans=1, lower=0, overwrite_c=1)
            to_parent = plan.shares[index]
            assert to_parent is not None
            waiting[front.parent].append((to_parent, left))
        panels.append(panel)
    return Factor(plan, tuple(panels))


def _extend_add(
    share: _Share,
    update: NDArray[np.float64],
    panel: NDArray[np.float64],
    left: NDArray[np.float64],
    width: int,
) -> None:
    """Add the lower triangle of a child's Schur complement to its parent."""
    for number, (column, to_column) in enumerate(share.in_panel):
        for row, to_row in share.in_panel[number:]:
            panel[to_row, to_column] += update[row, column]
        for row, to_row in share.in_rest:
            panel[to_row.start + width : to_row.stop + width, to_column] += update[row, column]
    for number, (column, to_column) in enumerate(share.in_rest):
        for row, to_row in share.in_rest[number:]:
            left[to_row, to_column] += update[row, column]


def solve(factor: Factor, right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the solution x of A x = right.

    Args:
        factor: Cholesky factor of A.
        right: (n, d) right-hand side, or (n, d, k) for k of them.

    Returns:
        x, of the shape of ``right``.
    """
    plan = factor.plan
    position = plan.tree.position
    ordered = np.empty((len(position), plan.size, *right.shape[2:]))
    ordered[position] = right
    x = ordered.reshape(len(position) * plan.size, -1)
    parts = list(zip(factor.panels, plan.own, plan.rows, strict=True))
    for panel, own, rows in parts:
        width = panel.shape[1]
        solved = blas.dtrsm(1.0, panel[:width].T, x[own], lower=0, trans_a=1)
        x[own] = solved
        if len(rows):
            x[rows] -= panel[width:] @ solved
    for panel, own, rows in reversed(parts):
        width = panel.shape[1]
        left = x[own] - panel[width:].T @ x[rows] if len(rows) else x[own]
        x[own] = blas.dtrsm(1.0, panel[:width].T, left, lower=0)
    return ordered[position]
