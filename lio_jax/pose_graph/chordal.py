"""A first guess of a pose graph's poses from its edges alone (chordal initialisation).

The first step finds the rotations, with the constraint that they are rotations left out; the second step
finds the translations. Both are linear least squares with the order of elimination of the solve itself.

Source: Carlone, Tron, Daniilidis & Dellaert, "Initialization techniques for 3D SLAM: a survey on rotation
estimation and its use in pose graph optimization", ICRA 2015, section III-D.
"""

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

from lio_jax.pose_graph.block_cholesky import factorise, solve
from lio_jax.pose_graph.graph import (
    POSITION,
    PRIOR,
    PoseGraph,
    Poses,
    nearest_rotations,
    numbers_of,
    poses_from,
    rotation_matrices,
    translations,
)
from lio_jax.pose_graph.structure import Structure, structure_of

_Array = NDArray[np.float64]


def chordal_poses(graph: PoseGraph, structure: Structure, weights: _Array | None = None) -> Poses:
    """Return poses near the least cost. They do not depend on the graph's own poses of free vertices.

    Args:
        graph: its edges, and the poses of its held vertices.
        structure: structure of the graph.
        weights: (e,) factors of the edges' information; None: 1.

    Raises:
        NotPositiveDefiniteError: the edges do not determine all rotations and translations.
    """
    weights = np.ones(len(structure.i)) if weights is None else weights
    positions = np.flatnonzero(structure.kind == POSITION)
    if not len(positions):
        return _with_held(graph, structure, *_relative_poses(graph, structure, weights))
    others = np.flatnonzero(structure.kind != POSITION)
    without = edges_at(graph, others)
    among_themselves = structure_of(without)
    R, t = _relative_poses(without, among_themselves, weights[others])
    loose = among_themselves.held & ~structure.held
    fixes = translations(graph.measurement)
    lever = np.zeros_like(fixes) if graph.lever is None else np.asarray(graph.lever)
    for part in structure.part[loose]:
        here = positions[structure.part[structure.j[positions]] == part]
        own = structure.part == part
        j = structure.j[here]
        antennas = t[j] + np.einsum("eij,ej->ei", R[j], lever[here])
        turn, shift = _laid_onto(antennas, fixes[here], weights[here])
        R[own], t[own] = turn @ R[own], t[own] @ turn.T + shift
    return _with_held(graph, structure, R, t)


def _with_held(graph: PoseGraph, structure: Structure, R: _Array, t: _Array) -> Poses:
    """Return the poses; those of held vertices are exactly the graph's own."""
    found = poses_from(R, t)
    numbers = np.where(structure.held[:, None], numbers_of(graph.poses), numbers_of(found))
    return type(found)(jax.device_put(numbers))


def edges_at(graph: PoseGraph, index: NDArray[np.int64]) -> PoseGraph:
    """Return the graph with some of its edges.

    Args:
        graph: vertices and edges.
        index: (k,) numbers of the edges to keep.
    """

    def chosen(leaf: ArrayLike) -> jax.Array:
        return jax.device_put(np.asarray(leaf)[index])

    return PoseGraph(
        graph.poses,
        chosen(graph.i),
        chosen(graph.j),
        type(graph.measurement)(chosen(numbers_of(graph.measurement))),
        chosen(graph.information),
        chosen(graph.kind),
        graph.fixed,
        None if graph.lever is None else chosen(graph.lever),
    )


def _relative_poses(graph: PoseGraph, structure: Structure, weights: _Array) -> tuple[_Array, _Array]:
    """Return the rotations and the translations (m) that agree best with edges and priors."""
    Z, z = rotation_matrices(graph.measurement), translations(graph.measurement)
    dimensions = z.shape[-1]
    information = np.asarray(graph.information, np.float64) * weights[:, None, None]
    turning = information.shape[-1] - dimensions
    prior = (structure.kind == PRIOR)[:, None, None]
    identity = np.eye(dimensions)
    held = structure.held[:, None, None]

    # R_i Z = R_j for the transposes, whose columns are then independent unknowns
    precision = np.trace(information[:, :turning, :turning], axis1=1, axis2=2) / turning
    Z_turned = Z.transpose(0, 2, 1)
    R_turned = _least_squares(
        structure,
        precision[:, None, None] * identity,
        np.where(prior, 0.0, Z_turned),
        np.where(prior, Z_turned, 0.0),
        np.where(held, rotation_matrices(graph.poses).transpose(0, 2, 1), 0.0),
    )
    R = nearest_rotations(R_turned.transpose(0, 2, 1))

    to_world = np.where(prior, Z, R[structure.i] @ Z)
    shift = np.where(prior, z[:, :, None], R[structure.i] @ z[:, :, None])
    t = _least_squares(
        structure,
        to_world @ information[:, turning:, turning:] @ to_world.transpose(0, 2, 1),
        np.where(prior, 0.0, identity),
        shift,
        np.where(held, translations(graph.poses)[:, :, None], 0.0),
    )
    return R, t[:, :, 0]


def _least_squares(
    structure: Structure, precision: _Array, factor: _Array, offset: _Array, start: _Array
) -> _Array:
    """Return the x that minimise the sum of |M x_i + c - x_j|^2, weighted by ``precision``.

    Args:
        structure: structure of the graph.
        precision: (e, k, k) weight of each edge.
        factor: (e, k, k) M of each edge.
        offset: (e, k, r) c of each edge.
        start: (n, k, r) values x of the held vertices; 0 for the others.
    """
    i, j = structure.unknown[structure.i], structure.unknown[structure.j]
    count = structure.count
    missed = precision @ (factor @ start[structure.i] + offset - start[structure.j])
    back = factor.transpose(0, 2, 1)
    gradient = _summed(i, back @ missed, count) - _summed(j, missed, count)
    H_ij = -back @ precision
    H_pair = np.where((i < j)[:, None, None], H_ij.transpose(0, 2, 1), H_ij)
    diagonal = _summed(i, -H_ij @ factor, count) + _summed(j, precision, count)
    pairs = _summed(structure.pair_of, H_pair, len(structure.pairs))
    x = start.copy()
    if count:
        step = solve(factorise(structure.plan_of_coordinates, diagonal, pairs), -gradient)
        x[~structure.held] = step
    return x


def _summed(place: NDArray[np.int64], values: _Array, count: int) -> _Array:
    """Return the (count, ...) sums of the values at each place; values at place ``count`` are dropped."""
    gather = sparse.csr_matrix(
        (np.ones(len(place)), (place, np.arange(len(place)))), shape=(count + 1, len(place))
    )
    sums = np.asarray(gather @ values.reshape(len(place), -1))
    return sums[:count].reshape(count, *values.shape[1:])


def _laid_onto(points: _Array, targets: _Array, weights: _Array) -> tuple[_Array, _Array]:
    """Return the rotation and the translation that align (m, k) points with targets by least squares.

    A rotation that the points do not determine is the identity.
    """
    share = weights / max(weights.sum(), np.finfo(float).tiny)
    centre, target_centre = share @ points, share @ targets
    spread = (targets - target_centre).T @ ((points - centre) * share[:, None])
    spread += 1e-9 * np.linalg.norm(spread) * np.eye(len(spread))
    turn = nearest_rotations(spread[None])[0] if np.any(spread) else np.eye(len(spread))
    return turn, target_centre - turn @ centre
