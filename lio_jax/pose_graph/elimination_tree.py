"""The order in which a graph's nodes are eliminated, and which of them are eliminated together.

It is found once for each graph: only the numbers change between iterations, not the structure.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

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
