"""Sparse Cholesky factorisation of matrices of small square blocks by the multifrontal method, on the host.

Every front is a dense matrix for LAPACK.

Source: Duff & Reid, "The multifrontal solution of indefinite sparse symmetric linear equations", 1983.
"""

from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack
from threadpoolctl import ThreadpoolController

from lio_jax.pose_graph.elimination_tree import EliminationTree

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
