"""Levenberg-Marquardt on the normal equations of a pose graph."""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from numpy.typing import NDArray

from lio_jax.pose_graph.block_cholesky import factorise, solve
from lio_jax.pose_graph.factors import linearise
from lio_jax.pose_graph.graph import PoseGraph, Poses, Status, moved, numbers_of
from lio_jax.pose_graph.multifrontal import NotPositiveDefiniteError
from lio_jax.pose_graph.structure import Structure


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


_LEAST_DAMPING, _LARGEST_DAMPING = 1e-10, 1e8
"""Relative to the diagonal of the normal equations."""
_FAITHFUL = 0.5
"""A step that gains this share of what it promised may be followed by a less damped one."""
_ROUNDING = 1e-12
"""Relative; smaller changes of the cost may be those of its sum."""
_NEGLIGIBLE_PER_EDGE = 1e-14
"""A decrease of the cost that is only rounding, where all edges agree."""


@dataclass(frozen=True)
class Limits:
    """When a descent ends."""

    iterations: int = 100
    """Linear systems at most."""
    tolerance: float = 1e-8
    """Converged when a step promises to lower the cost by less than this share; that step is still made."""


class Descent(NamedTuple):
    """Where a descent ended."""

    point: Point
    iterations: int
    status: Status


def descend(
    padded: Padded, structure: Structure, poses: Poses, weights: Float[Array, " e"], limits: Limits
) -> Descent:
    """Return the poses of least cost near the given ones.

    Plain Gauss-Newton steps while they lower the cost; else the diagonal is raised by a share of itself, the
    more the more steps fail in a row, and by a tenth of it after each one that keeps its promise (Marquardt,
    "An algorithm for least-squares estimation of nonlinear parameters", 1963).

    Args:
        padded: the graph.
        structure: of the graph.
        poses: (n,) to start from, of the padded size.
        weights: of the edges, of the padded size.
        limits: when to end.
    """
    step = np.zeros((len(padded.places.unknown) + 1, structure.tangent_size), padded.graph.information.dtype)
    point = point_after(poses, jax.device_put(step), weights, padded)
    cost, damping, iterations = float(point.cost), 0.0, 0
    if not np.isfinite(cost):
        return Descent(point, 0, "not finite")
    equations, failures = Equations.at(point, structure), 0
    while structure.count and iterations < limits.iterations:
        iterations += 1
        negligible = limits.tolerance * cost + _NEGLIGIBLE_PER_EDGE * len(structure.i)
        try:
            step[: structure.count], promised = equations.solved(damping)
            tried = point_after(point.poses, jax.device_put(step), weights, padded)
            gained = cost - float(tried.cost)
        except NotPositiveDefiniteError:
            promised = gained = -np.inf
        last = damping == 0 and 0 <= promised <= negligible
        if gained >= 0:
            point, cost, failures = tried, float(tried.cost), 0
            if last or max(gained, promised) <= negligible:
                return Descent(point, iterations, "converged")
            equations = Equations.at(point, structure)
            if gained > _FAITHFUL * promised:
                damping = damping / 10 if damping > _LEAST_DAMPING else 0.0
        elif last or (promised >= 0 and max(promised, -gained) <= _ROUNDING * cost):
            return Descent(point, iterations, "converged")
        else:
            failures += 1
            damping = max(damping, _LEAST_DAMPING) * 10.0**failures
            if damping > _LARGEST_DAMPING:
                return Descent(point, iterations, "no further decrease")
    return Descent(point, iterations, "iteration limit" if structure.count else "converged")


@dataclass(frozen=True)
class Equations:
    """The normal equations H dx = -g on the host, without padding."""

    structure: Structure
    diagonal: NDArray[np.float64]
    """(n, d, d)."""
    pairs: NDArray[np.float64]
    """(m, d, d)."""
    gradient: NDArray[np.float64]
    """(n, d)."""

    @staticmethod
    def at(point: Point, structure: Structure) -> "Equations":
        """Take over what was assembled on the device."""
        blocks, gradient = jax.device_get((point.blocks, point.gradient))
        first = len(gradient)
        return Equations(
            structure,
            blocks[: structure.count].astype(np.float64, copy=False),
            blocks[first : first + len(structure.pairs)].astype(np.float64, copy=False),
            gradient[: structure.count].astype(np.float64, copy=False),
        )

    def solved(self, damping: float) -> tuple[NDArray[np.float64], float]:
        """Return the step and by how much it lowers the cost of the linearised graph.

        Raises:
            NotPositiveDefiniteError: H is singular, as far as numbers tell.
        """
        scale = np.diagonal(self.diagonal, axis1=1, axis2=2)
        added = damping * np.maximum(scale, 1e-6 * scale.max(initial=0.0))
        diagonal = self.diagonal
        if damping:
            diagonal = diagonal + added[:, :, None] * np.eye(added.shape[-1])
        factor = factorise(self.structure.plan, diagonal, self.pairs)
        step = solve(factor, -self.gradient)
        # H dx = -g - D dx with D the damping: the model falls by -g'dx - dx'H dx / 2 = (-g'dx + dx'D dx) / 2
        return step, float(-np.sum(self.gradient * step) + np.sum(added * step**2)) / 2
