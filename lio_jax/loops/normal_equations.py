"""The normal equations of a pose graph, assembled on the device and solved on the host."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from lio_jax.loops.factors import linearise
from lio_jax.loops.graph import PoseGraph, Poses, moved
from lio_jax.loops.host_poses import numbers_of
from lio_jax.loops.structure import Structure


class Places(NamedTuple):
    """Where vertices and edges add to the normal equations; the last place takes what is not wanted."""

    unknown: Int[Array, " n"]
    pair: Int[Array, " e"]
    turned: Bool[Array, " e"]
    """True where the edge's block is the transpose of the pair's."""


class Padded(NamedTuple):
    """A graph of a size that many graphs share, so that they share their compiled programs too."""

    graph: PoseGraph
    places: Places


class Point(NamedTuple):
    """Poses and the normal equations around them, H dx = -g."""

    poses: Poses
    cost: Float[Array, ""]
    edge_costs: Float[Array, " e"]
    """r' Omega r / 2 of each edge, not weighted."""
    blocks: Float[Array, "b d d"]
    """Blocks of H: on the diagonal, then of the pairs (the last of each is nobody's)."""
    gradient: Float[Array, "u d"]


def size_at_least(count: int) -> int:
    """Return the next size of the form 4, 5, 6 or 7 times a power of two, 32 at least."""
    power = 8
    while 7 * power < count:
        power *= 2
    return next(times * power for times in (4, 5, 6, 7) if times * power >= count)


def padded(graph: PoseGraph, structure: Structure) -> Padded:
    """Return the graph at its padded size; edges that were added have no information."""
    edges, vertices = len(structure.i), len(structure.held)
    more_edges, more_vertices = size_at_least(edges) - edges, size_at_least(vertices) - vertices

    def longer(leaf: Array, by: int, value: float = 0) -> Array:
        values = np.asarray(leaf)
        return jax.device_put(np.pad(values, [(0, by), *[(0, 0)] * (values.ndim - 1)], constant_values=value))

    return Padded(
        PoseGraph(
            poses=padded_poses(graph.poses, vertices + more_vertices),
            i=longer(graph.i, more_edges),
            j=longer(graph.j, more_edges),
            measurement=padded_poses(graph.measurement, edges + more_edges),
            information=longer(graph.information, more_edges),
            kind=longer(graph.kind, more_edges),
            fixed=longer(graph.fixed, more_vertices, True),
            lever=None if graph.lever is None else longer(graph.lever, more_edges),
        ),
        places_in(structure),
    )


def places_in(structure: Structure) -> Places:
    """Return where vertices and edges add, at the padded size."""

    def longer(values: NDArray, none: int) -> Array:
        """Return padded values, with those that equal ``none`` at the last place."""
        wanted = np.where(values == none, -1, values)
        return jax.device_put(np.pad(wanted, (0, more(len(values))), constant_values=-1))

    def more(count: int) -> int:
        return size_at_least(count) - count

    turned = structure.unknown[structure.i] < structure.unknown[structure.j]
    return Places(
        unknown=longer(structure.unknown, structure.count),
        pair=longer(structure.pair_of, len(structure.pairs)),
        turned=jax.device_put(np.pad(turned, (0, more(len(turned))))),
    )


def padded_poses(poses: Poses, count: int) -> Poses:
    """Return ``count`` poses, the identity behind those given."""
    own = numbers_of(poses)
    none = np.zeros((count - len(own), own.shape[-1]), own.dtype)
    none[:, 0] = 1
    return type(poses)(jax.device_put(np.concatenate([own, none])))


def padded_weights(weights: NDArray[np.float64], padded: Padded) -> Float[Array, " e"]:
    """Return weights of the edges, 0 of those that padding added."""
    return jax.device_put(np.pad(weights, (0, len(padded.graph.i) - len(weights))))


@jax.jit
def point_after(
    poses: Poses, step: Float[Array, "u d"], weights: Float[Array, " e"], padded: Padded
) -> Point:
    """Return what lies a step away from the poses.

    Args:
        poses: (n,).
        step: of the unknowns; the last one stays zero.
        weights: of the edges' information.
        padded: the graph.
    """
    graph, places = padded
    held = (places.unknown < 0)[:, None]
    stepped = moved(poses, step[places.unknown])
    poses = jax.tree.map(lambda still, gone: jnp.where(held, still, gone), poses, stepped)
    parts = linearise(poses, graph)
    w = weights[:, None, None]
    H_pair = w * jnp.where(places.turned[:, None, None], jnp.swapaxes(parts.H_ij, -1, -2), parts.H_ij)
    i, j = places.unknown[graph.i], places.unknown[graph.j]
    size = step.shape[-1]
    diagonal = (
        jnp.zeros((len(step), size, size), step.dtype).at[i].add(w * parts.H_ii).at[j].add(w * parts.H_jj)
    )
    pairs = jnp.zeros((len(weights) + 1, size, size), step.dtype).at[places.pair].add(H_pair)
    w = weights[:, None]
    return Point(
        poses=poses,
        cost=jnp.sum(weights * parts.cost),
        edge_costs=parts.cost,
        blocks=jnp.concatenate([diagonal, pairs]),
        gradient=jnp.zeros_like(step).at[i].add(w * parts.g_i).at[j].add(w * parts.g_j),
    )
