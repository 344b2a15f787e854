"""Solve a pose graph within one compiled program, under ``jit`` and ``vmap``."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from lio_jax.pose_graph.descent import (
    FAITHFUL,
    LARGEST_DAMPING,
    LEAST_DAMPING,
    LEAST_SCALE,
    NEGLIGIBLE_PER_EDGE,
    ROUNDING,
    Limits,
)
from lio_jax.pose_graph.edge_equations import EdgeEquations
from lio_jax.pose_graph.factors import Linearised, linearise
from lio_jax.pose_graph.graph import POSITION, PRIOR, PoseGraph, Poses, moved


def is_traced(tree: Any) -> bool:
    """Return whether a leaf has no value yet, so that the host can't find the solution."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


def held_vertices(graph: PoseGraph) -> Bool[Array, " n"]:
    """Return the vertices that keep their pose, as :attr:`~lio_jax.pose_graph.structure.Structure.held`.

    These are the fixed vertices, and the first one of each connected part without a fixed vertex, a prior or
    a position. A vertex takes the least number among its own and its neighbours', and then that of the vertex
    with this number, until nothing changes.
    """
    own = jnp.arange(len(graph.fixed))

    def spread(labels: tuple[Array, Array]) -> tuple[Array, Array]:
        _, first = labels
        least = jnp.minimum(first[graph.i], first[graph.j])
        nearer = first.at[graph.i].min(least).at[graph.j].min(least)
        return first, nearer[nearer]

    _, first = jax.lax.while_loop(lambda labels: jnp.any(labels[0] != labels[1]), spread, spread((own, own)))
    measured = (graph.kind == PRIOR) | (graph.kind == POSITION)
    tied = jnp.zeros_like(graph.fixed).at[first].max(graph.fixed).at[first[graph.j]].max(measured)
    return graph.fixed | ((first == own) & ~tied)


def _moved_unless(held: Bool[Array, " n"], poses: Poses, step: Float[Array, "n d"]) -> Poses:
    """Return T exp(step); held vertices keep their pose.

    Args:
        held: True for vertices that keep their pose.
        poses: (n,) poses T, m.
        step: right perturbations, rotation (rad) before translation (m).
    """
    return jax.tree.map(lambda still, gone: jnp.where(held[:, None], still, gone), poses, moved(poses, step))


class _Search(NamedTuple):
    """A descent in progress: the best poses, and the step to try from them."""

    poses: Poses
    """(n,) best poses so far, m."""
    parts: Linearised
    """The graph, linearised at these poses."""
    cost: Float[Array, ""]
    step: Float[Array, "n d"]
    """Step to try."""
    promised: Float[Array, ""]
    """Decrease of the cost that the linearised graph predicts for the step."""
    damping: Float[Array, ""]
    """Damping of the step."""
    failures: Int[Array, ""]
    """Number of steps in a row that did not lower the cost."""
    solved: Int[Array, ""]
    """Number of linear systems solved."""
    ended: Bool[Array, ""]


def descended(graph: PoseGraph, held: Bool[Array, " n"], limits: Limits) -> Poses:
    """Return the poses of least cost near the graph's own poses.

    Steps, damping and limits are those of :func:`lio_jax.pose_graph.descent.descend`. A descent that does
    not converge returns its best poses.

    Args:
        graph: vertices and edges.
        held: vertices that keep their pose.
        limits: conditions that end the descent.
    """
    edges, dtype = len(graph.i), graph.information.dtype
    free = ~held[:, None]

    def proposed(search: _Search) -> _Search:
        """Return the search with its next step."""
        parts = search.parts
        zero = jnp.zeros_like(search.step)
        g = jnp.where(free, zero.at[graph.i].add(parts.g_i).at[graph.j].add(parts.g_j), 0.0)
        scale = zero.at[graph.i].add(_diagonal(parts.H_ii)).at[graph.j].add(_diagonal(parts.H_jj))
        scale = jnp.where(free, scale, 0.0)
        added = search.damping * jnp.maximum(scale, LEAST_SCALE * jnp.max(scale))
        step = EdgeEquations(graph.i, graph.j, held, parts.blocks(), added).solved(-g)
        promised = (-jnp.sum(g * step) + jnp.sum(added * step**2)) / 2
        return search._replace(
            step=step,
            promised=jnp.where(jnp.isfinite(promised), promised, -jnp.inf),
            solved=search.solved + 1,
        )

    def tried(search: _Search) -> _Search:
        """Try the step, and choose the damping of the next one."""
        poses = _moved_unless(held, search.poses, search.step)
        parts = linearise(poses, graph)
        cost, damping, promised = jnp.sum(parts.cost), search.damping, search.promised
        gained = search.cost - cost
        # the factorisation of a singular matrix leaves no step
        gained = jnp.where(jnp.isfinite(gained) & (promised > -jnp.inf), gained, -jnp.inf)
        begins = search.solved == 0
        accepted = begins | (gained >= 0)
        negligible = limits.tolerance * search.cost + NEGLIGIBLE_PER_EDGE * edges
        last = (damping == 0) & (promised >= 0) & (promised <= negligible)
        rounding = (promised >= 0) & (jnp.maximum(promised, -gained) <= ROUNDING * search.cost)
        converged = last | jnp.where(accepted, jnp.maximum(gained, promised) <= negligible, rounding)
        failures = jnp.where(accepted, 0, search.failures + 1)
        less = jnp.where(damping > LEAST_DAMPING, damping / 10, 0.0)
        less = jnp.where(gained > FAITHFUL * promised, less, damping)
        more = jnp.maximum(damping, LEAST_DAMPING) * 10.0**failures
        damping = jnp.where(begins, 0.0, jnp.where(accepted, less, more))
        poses, parts, cost = jax.tree.map(
            lambda new, old: jnp.where(accepted, new, old),
            (poses, parts, cost),
            (search.poses, search.parts, search.cost),
        )
        ended = (
            (~begins & converged)
            | (damping > LARGEST_DAMPING)
            | (search.solved >= limits.iterations)
            | ~jnp.isfinite(cost)
        )
        return search._replace(
            poses=poses, parts=parts, cost=cost, damping=damping, failures=failures, ended=ended
        )

    size = graph.information.shape[-1]
    zero, none = jnp.zeros((), dtype), jnp.zeros((edges, size, size), dtype)
    begin = _Search(
        poses=graph.poses,
        parts=Linearised(none[:, 0, 0], none, none, none, none[:, 0], none[:, 0]),
        cost=zero,
        step=jnp.zeros((len(held), size), dtype),
        promised=zero,
        damping=zero,
        failures=jnp.zeros((), int),
        solved=jnp.zeros((), int),
        ended=jnp.zeros((), bool),
    )

    def after_a_step(search: _Search) -> _Search:
        # jaxlie may return doubles for single precision
        def at_its_precision(changed: _Search) -> _Search:
            return jax.tree.map(lambda new, old: new.astype(old.dtype), changed, search)

        return at_its_precision(proposed(at_its_precision(tried(search))))

    return jax.lax.while_loop(lambda search: ~search.ended, after_a_step, begin).poses


def _diagonal(matrices: Float[Array, "e d d"]) -> Float[Array, "e d"]:
    return jnp.diagonal(matrices, axis1=-2, axis2=-1)
