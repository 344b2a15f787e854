"""The derivative of a pose graph's solution with respect to measurements, information and fixed poses."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import ArrayLike, NDArray

from lio_jax.core.implicit import ImplicitSolution, Problem, implicit
from lio_jax.pose_graph.block_cholesky import factorise
from lio_jax.pose_graph.block_cholesky import solve as solve_factored
from lio_jax.pose_graph.descent import Limits
from lio_jax.pose_graph.factors import edge_costs, residuals
from lio_jax.pose_graph.graph import PoseGraph, Poses, moved, picked
from lio_jax.pose_graph.multifrontal import one_thread
from lio_jax.pose_graph.pose_graph import solve
from lio_jax.pose_graph.structure import Structure, structure_from, structure_of

_STRICT = Limits(tolerance=1e-12)
_NEWTON_STEPS = 2
"""Number of Newton steps with the exact Hessian after the descent."""


def solved_poses(graph: PoseGraph, limits: Limits = _STRICT) -> Poses:
    """Return the poses of least cost, with their derivative by measurements, information and fixed poses.

    Where the gradient g(x, q) of the cost vanishes, dx = -(dg/dx)^-1 (dg/dq) dq (implicit function theorem),
    with the exact Hessian dg/dx. One sparse factorisation serves all tangents, or all cotangents.
    Gauss-Newton steps end near such a point; Newton steps then reach it with full precision.

    Call it outside ``jit``, because the host finds the solution. :func:`~lio_jax.pose_graph.pose_graph.solve`
    returns the status of the solve, which this function does not return.

    Args:
        graph: vertices and edges; scale ``information`` to weight edges. The result does not depend on the
            poses of vertices that are not held.
        limits: conditions that end the Gauss-Newton steps.
    """
    held = jax.device_put(structure_of(graph).held)
    problem = Problem(
        solve=partial(_root, limits),
        probe=lambda step, numbers, inputs: (),
        residual=lambda step, probed, numbers, inputs: _gradient(step, numbers, *inputs),
        report=lambda step, probed, numbers, inputs: _poses_at(step, numbers, *inputs),
        inverse_slope=_solve_hessian,
    )
    return implicit(problem, (graph, held)).reported


def _root(limits: Limits, inputs: tuple[PoseGraph, Array]) -> ImplicitSolution:
    graph, _ = inputs
    poses = solve(graph, limits=limits).poses
    unmoved = jnp.zeros(len(graph.fixed) * graph.poses.tangent_dim, graph.information.dtype)
    for _ in range(_NEWTON_STEPS):
        (numbers,) = jax.tree.leaves(poses)
        step = _solve_hessian(unmoved, numbers, inputs, _gradient(unmoved, numbers, *inputs))
        poses = _poses_at(-step, numbers, *inputs)
    return ImplicitSolution(unmoved, jax.tree.leaves(poses)[0], poses)


@jax.jit
def _poses_at(step: Float[Array, " u"], numbers: Array, graph: PoseGraph, held: Bool[Array, " n"]) -> Poses:
    """Return the poses after a step from the solution; held vertices have the graph's own poses."""
    found = moved(type(graph.poses)(numbers), step.reshape(len(held), -1))
    return jax.tree.map(lambda own, found: jnp.where(held[:, None], own, found), graph.poses, found)


@jax.jit
def _gradient(
    step: Float[Array, " u"], numbers: Array, graph: PoseGraph, held: Bool[Array, " n"]
) -> Float[Array, " u"]:
    def cost(step: Array) -> Array:
        return jnp.sum(edge_costs(_poses_at(step, numbers, graph, held), graph))

    fixed = jnp.repeat(held, len(step) // len(held))
    return jnp.where(fixed, step, jax.grad(cost)(step))


@jax.jit
def _solve_hessian(
    step: Float[Array, " u"], numbers: Array, inputs: tuple[PoseGraph, Array], right: Float[Array, " u"]
) -> Float[Array, " u"]:
    """Return H^-1 right, where the rows of H that belong to held vertices are those of the identity."""
    graph, held = jax.lax.stop_gradient(inputs)
    hessians = _edge_hessians(type(graph.poses)(numbers), graph)
    shape = jax.ShapeDtypeStruct(right.shape, right.dtype)

    def on_host(_: object, right: Array) -> Array:
        fields = (graph.i, graph.j, graph.kind, held, hessians)
        return jax.pure_callback(_solve_on_host, shape, *fields, right, vmap_method="expand_dims")

    def product(step: Array) -> Array:
        at = jnp.zeros_like(step)
        return jax.jvp(lambda step: _gradient(step, numbers, graph, held), (at,), (step,))[1]

    return jax.lax.custom_linear_solve(product, right, on_host, symmetric=True)


def _edge_hessians(poses: Poses, graph: PoseGraph) -> Float[Array, "e h h"]:
    """Return the second derivatives of each edge's cost by the steps of its first and second vertex."""
    T_world_i, T_world_j = picked(poses, graph.i), picked(poses, graph.j)
    size = poses.tangent_dim

    def cost(steps: Float[Array, "e h"]) -> Array:
        r = residuals(moved(T_world_i, steps[:, :size]), moved(T_world_j, steps[:, size:]), graph)
        return jnp.einsum("ei,eij,ej->", r, graph.information, r) / 2

    still = jnp.zeros((len(graph.i), 2 * size), graph.information.dtype)

    def along(direction: Float[Array, " h"]) -> Array:
        return jax.jvp(jax.grad(cost), (still,), (jnp.broadcast_to(direction, still.shape),))[1]

    return jax.vmap(along, out_axes=-1)(jnp.eye(2 * size, dtype=still.dtype))


def _solve_on_host(
    i: ArrayLike, j: ArrayLike, kind: ArrayLike, held: ArrayLike, hessians: ArrayLike, right: ArrayLike
) -> NDArray[np.float64]:
    """Solve for one right-hand side or a batch of them."""
    hessians, right = np.asarray(hessians, np.float64), np.asarray(right)
    size = hessians.shape[-1] // 2
    i, j, kind = (np.asarray(leaf, np.int64).reshape(-1) for leaf in (i, j, kind))
    held = np.asarray(held).reshape(-1)
    structure = structure_from(i, j, kind, held, size)
    free = ~structure.held
    columns = right.reshape(-1, len(held), size).astype(np.float64)
    solved = columns.copy()
    if structure.count:
        with one_thread():
            factor = factorise(
                structure.plan, *hessian_blocks(structure, hessians.reshape(-1, 2 * size, 2 * size))
            )
            solved[:, free] = solve_factored(factor, columns[:, free].transpose(1, 2, 0)).transpose(2, 0, 1)
    return solved.reshape(right.shape).astype(right.dtype)


def hessian_blocks(
    structure: Structure, hessians: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the Hessian's blocks on the diagonal, and those of the pairs."""
    size = structure.tangent_size
    i, j = structure.unknown[structure.i], structure.unknown[structure.j]
    H_ij = hessians[:, :size, size:]
    diagonal = np.zeros((structure.count + 1, size, size))
    np.add.at(diagonal, i, hessians[:, :size, :size])
    np.add.at(diagonal, j, hessians[:, size:, size:])
    pairs = np.zeros((len(structure.pairs) + 1, size, size))
    np.add.at(pairs, structure.pair_of, np.where((i < j)[:, None, None], H_ij.transpose(0, 2, 1), H_ij))
    return diagonal[:-1], pairs[:-1]
