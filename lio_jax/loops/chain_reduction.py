"""The elimination of a graph's chains, every other node of them at once.

Odd-even (cyclic) reduction: half of a chain's nodes are eliminated together, each of them couples the
neighbours that it leaves behind, and what is left is a chain again (Heller, "Some aspects of the cyclic
reduction algorithm for block tridiagonal linear systems", SIAM J. Numer. Anal. 1976).
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from lio_jax.loops.chains import Chains, chains_of

_Numbers = NDArray[np.int64]

WORTH_A_LEVEL = 48
"""Fewer nodes are eliminated as fast with the rest of the graph."""
_AT_ONCE = 1024
"""More nodes make two levels of one: fresh memory for all of them costs more than their arithmetic."""


@dataclass(frozen=True)
class Level:
    """Nodes that are eliminated at once: none is coupled to another one.

    Blocks count from those on the diagonal on, then come those of the pairs, whose rows are the greater
    node's. The first coupling's place then takes the block that couples the neighbours.
    """

    nodes: _Numbers
    """(k,)."""
    neighbours: _Numbers
    """(k, 2) the smaller first; the number of all nodes where there is none."""
    couplings: _Numbers
    """(k, 2) blocks of a node with its neighbours; -1, the last one, of zeros, where there is none."""
    touched: _Numbers
    """(t,) the neighbours, each once."""
    sums: sparse.csr_array
    """(t, 2 k) adds up what each of ``touched`` gets from the levels' nodes, whose first neighbours count
    before their second ones."""


@dataclass(frozen=True)
class Reduction:
    """What is eliminated of a graph's chains, and the graph that is left."""

    levels: tuple[Level, ...]
    kept: _Numbers
    """(c,) nodes that are left, ascending."""
    pairs: _Numbers
    """(p, 2) of places in ``kept``, the greater first, none twice."""
    sums: sparse.csr_array
    """(c + p, n + m + 1) makes the blocks of the graph that is left from all, the last one of zeros."""


def chain_reduction(count: int, pairs: _Numbers, worth_a_level: int = WORTH_A_LEVEL) -> Reduction:
    """Return which nodes are eliminated in levels.

    Args:
        count: of nodes.
        pairs: (m, 2) nodes that are coupled, the greater first, none twice.
        worth_a_level: fewer nodes make no level.
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
