"""The connections of a pose graph: its parts, its unknowns, and the pairs of unknowns that are coupled."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from lio_jax.pose_graph.block_cholesky import ChainPlan, Order, order_of, plan_of
from lio_jax.pose_graph.graph import POSITION, PRIOR, PoseGraph


@dataclass(frozen=True, eq=False)
class Structure:
    """A graph's connections on the host; they do not depend on poses, measurements and weights."""

    i: NDArray[np.int64]
    """(e,) first vertex of each edge."""
    j: NDArray[np.int64]
    """(e,) second vertex of each edge."""
    kind: NDArray[np.int64]
    """(e,) kind of each edge."""
    used: NDArray[np.bool_]
    """(e,) True for edges that are used; the others have weight 0 and connect nothing."""
    part: NDArray[np.int64]
    """(n,) number of the connected part of each vertex, from 0."""
    held: NDArray[np.bool_]
    """(n,) True for vertices that keep their pose: the fixed ones, and the first one of each part without a
    fixed vertex, a prior or a position."""
    tangent_size: int
    """Size of a tangent vector: 6 in space, 3 in the plane."""

    @property
    def parts(self) -> int:
        """Return the number of connected parts of the graph."""
        return int(self.part.max(initial=-1)) + 1

    @cached_property
    def unknown(self) -> NDArray[np.int64]:
        """Return the (n,) number of each vertex among the unknowns; their count for held vertices."""
        numbers = np.cumsum(~self.held) - 1
        return np.where(self.held, self.count, numbers)

    @property
    def count(self) -> int:
        """Return the number of unknown vertices."""
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
        """Return the (m, 2) pairs of unknowns that an edge couples, the greater number first, none twice."""
        return self._pairs[0]

    @property
    def pair_of(self) -> NDArray[np.int64]:
        """Return the (e,) number of the pair that each edge couples; m where it couples none."""
        return self._pairs[1]

    @cached_property
    def order(self) -> Order:
        """Return the order of elimination."""
        return order_of(self.count, self.pairs)

    @cached_property
    def plan(self) -> ChainPlan:
        """Return the plan for matrices with blocks of a tangent vector's size."""
        return plan_of(self.order, self.tangent_size)

    @cached_property
    def plan_of_coordinates(self) -> ChainPlan:
        """Return the plan for matrices with blocks of 3 rows in space, 2 in the plane."""
        return plan_of(self.order, 3 if self.tangent_size == 6 else 2)


def structure_of(graph: PoseGraph, used: NDArray[np.bool_] | None = None) -> Structure:
    """Return the structure of a graph; it is valid while edges, kinds and fixed vertices stay the same.

    Args:
        graph: vertices and edges.
        used: (e,) True for edges that are used; None: all.
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
    """Return the structure of a graph from its fields.

    Args:
        i: (e,) first vertex of each edge.
        j: (e,) second vertex of each edge.
        kind: (e,) kind of each edge.
        fixed: (n,) True for vertices that keep their pose.
        tangent_size: 6 in space, 3 in the plane.
        used: (e,) True for edges that are used; None: all.
    """
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
    """Return the (count,) number of each vertex's connected part; parts are ordered by their first vertex."""
    ones = np.ones(len(i), np.int8)
    _, label = connected_components(sparse.coo_matrix((ones, (i, j)), (count, count)), directed=False)
    _, first, part = np.unique(label, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[part]
