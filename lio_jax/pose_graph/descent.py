"""Levenberg-Marquardt on a pose graph.

The device linearises all edges and assembles the normal equations. A graph is padded to a size that many
graphs share, so that few programs are compiled. The host factorises the equations and chooses the damping.
"""

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
from lio_jax.pose_graph.structure import Structure, structure_of


class Places(NamedTuple):
    """The places in the normal equations where vertices and edges add; the last place (-1) is not used."""

    unknown: Int[Array, " n"]
    """Place of each vertex on the diagonal and in the gradient."""
    pair: Int[Array, " e"]
    """Place of each edge among the pairs."""
    turned: Bool[Array, " e"]
    """True where the edge's block is the transpose of the pair's block."""


class Padded(NamedTuple):
    """A graph, padded to a size that many graphs share, so that they share their compiled programs."""

    graph: PoseGraph
    """The graph with padded vertices and edges."""
    places: Places
    """Places of its vertices and edges in the normal equations."""


class Point(NamedTuple):
    """Poses and the normal equations H dx = -g at these poses."""

    poses: Poses
    """(n,) T_world_vertex, m."""
    cost: Float[Array, ""]
    """Weighted sum of ``edge_costs``."""
    edge_costs: Float[Array, " e"]
    """r' Omega r / 2 of each edge, without its weight."""
    blocks: Float[Array, "b d d"]
    """Blocks of H: those on the diagonal, then those of the pairs; the last block of each is not used."""
    gradient: Float[Array, "u d"]
    """Gradient g; the last row is not used."""


def size_at_least(count: int) -> int:
    """Return the least size not below ``count`` and 32 that is 4, 5, 6 or 7 times a power of two."""
    power = 8
    while 7 * power < count:
        power *= 2
    return next(times * power for times in (4, 5, 6, 7) if times * power >= count)


def padded(graph: PoseGraph, structure: Structure) -> Padded:
    """Return the graph at its padded size; added edges have no information, and added vertices are fixed.

    Args:
        graph: vertices and edges.
        structure: structure of the graph.
    """
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
    """Return the places in the normal equations where the vertices and edges of a padded graph add."""

    def longer(values: NDArray, none: int) -> Array:
        """Return padded values, with -1, the last place, for those that equal ``none``."""
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
    """Return ``count`` poses: those given, then identities."""
    own = numbers_of(poses)
    none = np.zeros((count - len(own), own.shape[-1]), own.dtype)
    none[:, 0] = 1
    return type(poses)(jax.device_put(np.concatenate([own, none])))


def padded_weights(weights: NDArray[np.float64], padded: Padded) -> Float[Array, " e"]:
    """Return the weights of a padded graph's edges: those given, then 0 for added edges."""
    return jax.device_put(np.pad(weights, (0, len(padded.graph.i) - len(weights))))


@jax.jit
def point_after(
    poses: Poses, step: Float[Array, "u d"], weights: Float[Array, " e"], padded: Padded
) -> Point:
    """Return the poses after a step, and the normal equations there.

    Args:
        poses: (n,) T_world_vertex, m.
        step: right perturbation of each unknown, rotation (rad) before translation (m); the last row is zero.
        weights: factor of each edge's information.
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


def point_at(poses: Poses, weights: Float[Array, " e"], padded: Padded) -> Point:
    """Return the normal equations at the given poses.

    Args:
        poses: (n,) T_world_vertex at the padded size, m.
        weights: factor of each edge's information, at the padded size.
        padded: the graph.
    """
    information = padded.graph.information
    still = np.zeros((len(padded.places.unknown) + 1, information.shape[-1]), information.dtype)
    return point_after(poses, jax.device_put(still), weights, padded)


def restricted(graph: PoseGraph, padded: Padded, used: NDArray[np.bool_]) -> tuple[Padded, Structure]:
    """Return a padded graph and its structure with some edges only; the others cause no fill-in.

    Args:
        graph: vertices and edges, without padding.
        padded: the graph at its padded size.
        used: (e,) edges that are used; the weights of the others must be zero.
    """
    structure = structure_of(graph, used)
    return padded._replace(places=places_in(structure)), structure


LEAST_DAMPING, LARGEST_DAMPING = 1e-10, 1e8
"""Bounds of the damping, relative to the diagonal of the normal equations."""
LEAST_SCALE = 1e-6
"""Least entry of the diagonal that the damping refers to, over the largest one."""
FAITHFUL = 0.5
"""Least ratio of the actual to the predicted decrease of the cost after which the damping is reduced."""
ROUNDING = 1e-12
"""Relative change of the cost below which it may be a rounding error of the sum."""
NEGLIGIBLE_PER_EDGE = 1e-14
"""Decrease of the cost per edge that is only rounding where all edges agree."""


@dataclass(frozen=True)
class Limits:
    """Conditions that end a descent."""

    iterations: int = 100
    """Largest number of linear systems solved."""
    tolerance: float = 1e-8
    """Relative decrease of the cost below which the descent has converged; the step that predicts it is still
    made."""


class Descent(NamedTuple):
    """The result of a descent."""

    point: Point
    """The best poses, with the normal equations there."""
    iterations: int
    """Number of linear systems solved."""
    status: Status
    """Why the descent ended."""


def descend(
    padded: Padded, structure: Structure, poses: Poses, weights: Float[Array, " e"], limits: Limits
) -> Descent:
    """Return the poses of least cost near the given ones.

    The steps are those of Gauss-Newton while they lower the cost. After a step that fails, the diagonal is
    increased by a share of itself, which grows with each failure in a row. After a step whose decrease is
    near the predicted one, the share is divided by ten (Marquardt, "An algorithm for least-squares estimation
    of nonlinear parameters", 1963).

    Args:
        padded: the graph.
        structure: structure of the graph without padding.
        poses: (n,) poses to start from, at the padded size.
        weights: factors of the edges' information, at the padded size.
        limits: conditions that end the descent.
    """
    step = np.zeros((len(padded.places.unknown) + 1, structure.tangent_size), padded.graph.information.dtype)
    point = point_at(poses, weights, padded)
    cost, damping, iterations = float(point.cost), 0.0, 0
    if not np.isfinite(cost):
        return Descent(point, 0, "not finite")
    equations, failures = Equations.at(point, structure), 0
    while structure.count and iterations < limits.iterations:
        iterations += 1
        negligible = limits.tolerance * cost + NEGLIGIBLE_PER_EDGE * len(structure.i)
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
            if gained > FAITHFUL * promised:
                damping = damping / 10 if damping > LEAST_DAMPING else 0.0
        elif last or (promised >= 0 and max(promised, -gained) <= ROUNDING * cost):
            return Descent(point, iterations, "converged")
        else:
            failures += 1
            damping = max(damping, LEAST_DAMPING) * 10.0**failures
            if damping > LARGEST_DAMPING:
                return Descent(point, iterations, "no further decrease")
    return Descent(point, iterations, "iteration limit" if structure.count else "converged")


@dataclass(frozen=True)
class Equations:
    """The normal equations H dx = -g on the host, without padding."""

    structure: Structure
    """Structure of the graph, with the plan of the factorisation."""
    diagonal: NDArray[np.float64]
    """(n, d, d) blocks of H on the diagonal, for n unknown vertices."""
    pairs: NDArray[np.float64]
    """(m, d, d) blocks of H for the m pairs of coupled unknowns."""
    gradient: NDArray[np.float64]
    """(n, d) gradient g."""

    @staticmethod
    def at(point: Point, structure: Structure) -> "Equations":
        """Return the equations that were assembled on the device."""
        blocks, gradient = jax.device_get((point.blocks, point.gradient))
        first = len(gradient)
        return Equations(
            structure,
            blocks[: structure.count].astype(np.float64, copy=False),
            blocks[first : first + len(structure.pairs)].astype(np.float64, copy=False),
            gradient[: structure.count].astype(np.float64, copy=False),
        )

    def solved(self, damping: float) -> tuple[NDArray[np.float64], float]:
        """Return the (n, d) step, and the decrease of the cost that the linearised graph predicts for it.

        Args:
            damping: increase of H's diagonal, as a share of it.

        Raises:
            NotPositiveDefiniteError: H is numerically singular.
        """
        scale = np.diagonal(self.diagonal, axis1=1, axis2=2)
        added = damping * np.maximum(scale, LEAST_SCALE * scale.max(initial=0.0))
        diagonal = self.diagonal
        if damping:
            diagonal = diagonal + added[:, :, None] * np.eye(added.shape[-1])
        factor = factorise(self.structure.plan, diagonal, self.pairs)
        step = solve(factor, -self.gradient)
        # H dx = -g - D dx with D the damping: the model falls by -g'dx - dx'H dx / 2 = (-g'dx + dx'D dx) / 2
        return step, float(-np.sum(self.gradient * step) + np.sum(added * step**2)) / 2
