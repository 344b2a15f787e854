"""Covariances of relative poses along the most certain path between two vertices.

The edges of a path add their errors. The other edges of the graph could only make the relative pose more
certain, so the covariance along one path is an upper bound, and it needs no factorisation.
"""

import jax
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from lio_jax.pose_graph.graph import PoseGraph, Poses, picked, rotation_first, translations
from lio_jax.pose_graph.structure import Structure

_Array = NDArray[np.float64]

_SOURCES_AT_ONCE = 256
"""Number of vertices whose paths are found at once; the table of predecessors has a row for each."""
_LONGEST = 1e100
"""Greatest length of an edge; a path may need an edge without information."""


@jax.jit
def _adjoints(poses: Poses) -> tuple[Float[Array, "k d d"], Float[Array, "k d d"]]:
    """Return Ad(T) and Ad(T)^-1, rotation before translation."""
    return rotation_first(poses.adjoint(), axes=2), rotation_first(poses.inverse().adjoint(), axes=2)


def path_covariances(
    graph: PoseGraph,
    structure: Structure,
    covariance: _Array,
    poses: Poses,
    used: NDArray[np.bool_],
    wanted: NDArray[np.int64],
) -> _Array:
    """Return the covariance of T_i^-1 T_j between the ends of some edges, along the best path of used edges.

    The path is the one with the least sum of variances of position, where a rotation counts with half of the
    graph's extent as its lever arm.

    Args:
        graph: vertices and edges, at a padded size or not.
        structure: structure of the graph without padding.
        covariance: (e, d, d) inverse information of each edge.
        poses: T_world_vertex at which the errors are added, m.
        used: (e,) edges that a path may use; they connect both ends of each wanted edge.
        wanted: (k,) edges between whose ends the covariance is returned.

    Returns:
        (k, d, d) covariances of the right perturbation, rotation (rad) before translation (m).
    """
    count = len(structure.held)
    position = translations(poses)
    offset = position[:count].mean(0)
    numbers = np.asarray(jax.tree.leaves(poses)[0]).copy()
    numbers[:, -len(offset) :] -= offset
    to_world, from_world = (
        np.asarray(each)[: len(structure.j)]
        for each in _adjoints(picked(type(poses)(jax.device_put(numbers)), graph.j))
    )
    in_world = to_world @ covariance @ to_world.transpose(0, 2, 1)
    turns = covariance.shape[-1] - len(offset)
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    arm = position[:count].var(0).sum() / 4
    length = variances[:, turns:].sum(1) + arm * variances[:, :turns].sum(1)
    length = np.nan_to_num(np.minimum(length, _LONGEST), nan=_LONGEST)
    total = _along_paths(structure, in_world, length, used, wanted)
    back = from_world[wanted]
    return back @ total @ back.transpose(0, 2, 1)


def _along_paths(
    structure: Structure,
    in_world: _Array,
    length: _Array,
    used: NDArray[np.bool_],
    wanted: NDArray[np.int64],
) -> _Array:
    """Return the sums of ``in_world`` over the edges of each shortest path, (k, d, d)."""
    count = len(structure.held)
    low, high = np.minimum(structure.i, structure.j), np.maximum(structure.i, structure.j)
    # the shortest of several edges between the same vertices
    edges = np.flatnonzero(used & (low < high))
    edges = edges[np.lexsort((length[edges], high[edges], low[edges]))]
    key = low[edges] * count + high[edges]
    key, first = np.unique(key, return_index=True)
    edges = edges[first]
    ways = sparse.csr_matrix((length[edges], (low[edges], high[edges])), (count, count))
    sources, row_of = np.unique(structure.i[wanted], return_inverse=True)
    total = np.zeros((len(wanted), *in_world.shape[1:]))
    for begin in range(0, len(sources), _SOURCES_AT_ONCE):
        some = sources[begin : begin + _SOURCES_AT_ONCE]
        before = dijkstra(ways, directed=False, indices=some, return_predecessors=True)[1]
        here = np.flatnonzero((row_of >= begin) & (row_of < begin + len(some)))
        row, at, to = row_of[here] - begin, structure.j[wanted[here]], structure.i[wanted[here]]
        while len(here := here[moving := at != to]):
            row, at, to = row[moving], at[moving], to[moving]
            previous = before[row, at].astype(np.int64)
            step = np.minimum(previous, at) * count + np.maximum(previous, at)
            total[here] += in_world[edges[np.searchsorted(key, step)]]
            at = previous
    return total
