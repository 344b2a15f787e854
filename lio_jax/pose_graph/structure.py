"""What a pose graph's edges connect: its parts, its unknowns, and the pairs of unknowns that are coupled."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from lio_jax.pose_graph.block_cholesky import Order, Plan, order_of, plan_of
from lio_jax.pose_graph.graph import POSITION, PRIOR, PoseGraph


@dataclass(frozen=True, eq=False)
class Structure:
    """The host's view of a graph's connections; it holds for any poses, measurements and weights."""

    i: NDArray[np.int64]
    j: NDArray[np.int64]
    kind: NDArray[np.int64]
    used: NDArray[np.bool_]
    """(e,) edges that count; the others, of weight 0, are not there."""
    part: NDArray[np.int64]
    """(n,) which connected part of the graph each vertex is in, counted from 0."""
    held: NDArray[np.bool_]
    """(n,) vertices that keep their pose: the fixed ones, and the first of each part that nothing ties to the
    world."""
    tangent_size: int

    @property
    def parts(self) -> int:
        """How many parts the graph falls into."""
        return int(self.part.max(initial=-1)) + 1

    @cached_property
    def unknown(self) -> NDArray[np.int64]:
        """(n,) number of each vertex among the unknowns; their count where it is held."""
        numbers = np.cumsum(~self.held) - 1
        return np.where(self.held, self.count, numbers)

    @property
    def count(self) -> int:
        """How many vertices are unknown."""
        return int(np.sum(~self.held))

    @cached_property
    def _pairs(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        a, b = self.unknown[self.i], self.unknown[self.j]
        couples = self.used & (a != b) & (a < self.count) & (b < self.count)
        key = np.maximum(a, b) * self.count + np.minimum(a, b)
        unique, number = np.unique(key[couples], return_inverse=True)
        pair_of = np.full(len(a), len(unique))
        pair_of[couples] = number
        return np.stack([unique // max(self.count, 1), unique % max(self.count, 1)], -1), pair_of

    @property
    def pairs(self) -> NDArray[np.int64]:
        """(m, 2) unknowns that an edge couples, the greater number first, none twice."""
        return self._pairs[0]

    @property
    def pair_of(self) -> NDArray[np.int64]:
        """(e,) the pair that each edge couples; m where it couples none."""
        return self._pairs[1]

    @cached_property
    def order(self) -> Order:
        """Order of elimination."""
        return order_of(self.count, self.pairs)

    @cached_property
    def plan(self) -> Plan:
        """For matrices with one row per unknown tangent."""
        return plan_of(self.order, self.tangent_size)

    @cached_property
    def plan_of_coordinates(self) -> Plan:
        """For matrices with 3 rows per unknown in space, 2 in the plane."""
        return plan_of(self.order, 3 if self.tangent_size == 6 else 2)


def structure_of(graph: PoseGraph, used: NDArray[np.bool_] | None = None) -> Structure:
    """Return the structure of a graph; it may be kept while edges, kinds and fixed vertices stay the same.

    Args:
        graph: whose connections are asked for.
        used: (e,) edges that count; None: all.
    """
    return structure_from(
        np.asarray(graph.i, np.int64),
        np.asarray(graph.j, np.int64),
        np.asarray(graph.kind, np.int64),
        np.asarray(graph.fixed),
        graph.information.shape[-1],
        used,
    )


def structure_from(
    i: NDArray[np.int64],
    j: NDArray[np.int64],
    kind: NDArray[np.int64],
    fixed: NDArray[np.bool_],
    tangent_size: int,
    used: NDArray[np.bool_] | None = None,
) -> Structure:
    """Return the structure of a graph whose fields these are."""
    used = np.ones(len(i), bool) if used is None else used
    part = parts_of(len(fixed), i[used], j[used])
    tied = np.zeros(part.max(initial=-1) + 1, bool)
    tied[part[fixed]] = True
    tied[part[j[used & ((kind == PRIOR) | (kind == POSITION))]]] = True
    first = np.unique(part, return_index=True)[1]
    held = fixed.copy()
    held[first[~tied]] = True
    return Structure(i, j, kind, used, part, held, tangent_size)


def parts_of(count: int, i: NDArray[np.int64], j: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return which connected part each vertex belongs to; parts are counted by their first vertex."""
    ones = np.ones(len(i), np.int8)
    _, label = connected_components(sparse.coo_matrix((ones, (i, j)), (count, count)), directed=False)
    _, first, part = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[part]
