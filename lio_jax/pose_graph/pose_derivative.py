"""The derivative of a pose graph's solution with respect to measurements, information and fixed poses."""

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lio_jax.core.implicit import ImplicitSolution, Problem, implicit
from lio_jax.pose_graph.descent import Limits
from lio_jax.pose_graph.edge_equations import EdgeEquations
from lio_jax.pose_graph.factors import edge_hessians, gradient
from lio_jax.pose_graph.graph import PoseGraph, Poses, moved
from lio_jax.pose_graph.pose_graph import solve
from lio_jax.pose_graph.structure import structure_of
from lio_jax.pose_graph.traced_solve import descended, held_vertices, is_traced

_STRICT = Limits(tolerance=1e-12)
_NEWTON_STEPS = 2
"""Number of Newton steps with the exact Hessian after the descent."""


def solved_poses(graph: PoseGraph, limits: Limits = _STRICT) -> Poses:
    """Return the poses of least cost, with their derivative by measurements, information and fixed poses.

    Where the gradient g(x, q) of the cost vanishes, dx = -(dg/dx)^-1 (dg/dq) dq (implicit function theorem),
    with the exact Hessian dg/dx. One factorisation serves all tangents, or all cotangents. Gauss-Newton steps
    end near such a point; Newton steps then reach it with full precision.

    Outside ``jit`` and ``vmap`` the host finds the solution, from a first guess that it computes from the
    edges. Within them the solve is a part of the compiled program and begins at the graph's own poses, so
    that it may end in another local minimum if these are far off. Under ``vmap`` many graphs are one call,
    which takes as many steps as the slowest of them.

    :func:`~lio_jax.pose_graph.pose_graph.solve` returns the status of the solve, which this function does not
    return. Poses are NaN if the exact Hessian is not positive definite, for example because the edges
    leave a pose open.

    Args:
        graph: vertices and edges; scale ``information`` to weight edges. Outside ``jit`` the result does not
            depend on the poses of vertices that are not held.
        limits: conditions that end the Gauss-Newton steps.
    """
    of_structure = (graph.i, graph.j, graph.kind, graph.fixed)
    held = held_vertices(graph) if is_traced(of_structure) else jax.device_put(structure_of(graph).held)
    problem = Problem(
        solve=partial(_root, limits),
        probe=lambda step, numbers, inputs: (),
        residual=lambda step, probed, numbers, inputs: _gradient(step, numbers, *inputs),
        report=lambda step, probed, numbers, inputs: _poses_at(step, numbers, *inputs),
        inverse_slope=_solve_hessian,
    )
    return implicit(problem, (graph, held)).reported


def _root(limits: Limits, inputs: tuple[PoseGraph, Array]) -> ImplicitSolution:
    graph, held = inputs
    poses = _descended(limits, graph, held) if is_traced(inputs) else solve(graph, limits=limits).poses
    unmoved = jnp.zeros(len(graph.fixed) * graph.poses.tangent_dim, graph.information.dtype)
    poses = _after_newton_steps(unmoved, jax.tree.leaves(poses)[0], inputs)
    return ImplicitSolution(unmoved, jax.tree.leaves(poses)[0], poses)


# kept, so that a call under vmap outside of jit is compiled once
_descended = jax.jit(lambda limits, graph, held: descended(graph, held, limits), static_argnums=0)


@jax.jit
def _after_newton_steps(
    unmoved: Float[Array, " u"], numbers: Array, inputs: tuple[PoseGraph, Array]
) -> Poses:
    def stepped(_: int, numbers: Array) -> Array:
        step = _solve_hessian(unmoved, numbers, inputs, _gradient(unmoved, numbers, *inputs))
        return jax.tree.leaves(_poses_at(-step, numbers, *inputs))[0].astype(numbers.dtype)

    return type(inputs[0].poses)(jax.lax.fori_loop(0, _NEWTON_STEPS, stepped, numbers))


@jax.jit
def _poses_at(step: Float[Array, " u"], numbers: Array, graph: PoseGraph, held: Bool[Array, " n"]) -> Poses:
    """Return the poses after a step from the solution; held vertices have the graph's own poses."""
    found = moved(type(graph.poses)(numbers), step.reshape(len(held), -1))
    return jax.tree.map(lambda own, found: jnp.where(held[:, None], own, found), graph.poses, found)


@jax.jit
def _gradient(
    step: Float[Array, " u"], numbers: Array, graph: PoseGraph, held: Bool[Array, " n"]
) -> Float[Array, " u"]:
    """Return the gradient at the poses after a step; the step itself for held vertices."""
    at_poses = gradient(_poses_at(step, numbers, graph, held), graph)
    return jnp.where(jnp.repeat(held, len(step) // len(held)), step, at_poses.ravel())


@jax.jit
def _solve_hessian(
    step: Float[Array, " u"], numbers: Array, inputs: tuple[PoseGraph, Array], right: Float[Array, " u"]
) -> Float[Array, " u"]:
    """Return H^-1 right, where the rows of H that belong to held vertices are those of the identity."""
    graph, held = jax.lax.stop_gradient(inputs)
    blocks = edge_hessians(type(graph.poses)(numbers), graph)
    right = right.reshape(len(held), -1)
    equations = EdgeEquations(graph.i, graph.j, held, blocks, jnp.zeros_like(right))
    return equations.solved(right).ravel()
