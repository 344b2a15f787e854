"""Chains of a graph: nodes one behind the other that have two neighbours at most."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components, depth_first_order

_Numbers = NDArray[np.int64]
_Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Chains:
    """Chains one behind the other, each between the two nodes that it hangs on."""

    nodes: _Numbers
    """(s,); the number of all nodes where a chain hangs on nothing."""
    place: _Numbers
    """(s,) within the chain, from 0."""
    outside: _Flags
    """(s,) True of what a chain hangs on: it is no part of it."""
    link: _Numbers
    """(s,) the pair of a node and the one behind it; -1 where there is none."""


def chains_of(count: int, pairs: _Numbers) -> Chains:
    """Return the chains of a graph.

    A node of each part of the graph is in none of them, so that a ring has ends too, nor is one of each chain
    that would hang on one node with both ends.

    Args:
        count: of nodes.
        pairs: (m, 2) nodes that are coupled, none twice.
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
    beside = position[own] + np.where(before, -1, 1)
    nodes[beside] = other
    link[np.minimum(beside, position[own])] = np.flatnonzero(outer)
    return Chains(nodes, place, outside, link)


def _end_to_end(inside: _Flags, inner: _Numbers) -> tuple[_Numbers, _Flags]:
    """Return the nodes of all chains in their order, and which of them begin a chain.

    Depth first from a node that is coupled to all ends, one chain is walked through after the other.
    """
    root = len(inside)
    ends = np.flatnonzero(inside & (np.bincount(inner.ravel(), minlength=root) < 2))
    a, b = np.concatenate([inner, np.stack([np.full(len(ends), root), ends], -1)]).T
    graph = sparse.coo_array((np.ones(len(a), np.int8), (a, b)), (root + 1, root + 1))
    order, before = depth_first_order(graph.tocsr(), root, directed=False)
    return order[1:].astype(np.int64), before[order[1:]] == root
