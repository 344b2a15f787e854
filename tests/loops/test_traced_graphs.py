"""Pose graphs that are solved within compiled programs, against the host's solution and differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.pose_graph.edge_equations import MOST_DENSE_ROWS
from lio_jax.pose_graph.graph import matrices_of, numbers_of
from lio_jax.pose_graph.pose_derivative import solved_poses
from lio_jax.pose_graph.structure import structure_of
from lio_jax.pose_graph.traced_solve import held_vertices
from tests.loops.graphs import graph_of, walk, with_poses, with_priors_and_positions

LEVER = (0.7, -0.4, 1.1)
in_program = jax.jit(solved_poses)


def small(group, seed=2):
    """Return 8 poses with two loops and large residuals."""
    rng = np.random.default_rng(seed)
    return graph_of(walk(group, 8, rng), [(0, 5), (2, 7)], rng, noise=3.0, scale=100.0)


def measured(group):
    """Return a graph with a prior and antenna positions, and no fixed vertex."""
    rng = np.random.default_rng(3)
    lever = LEVER[: 3 if group is jaxlie.SE3 else 2]
    return with_priors_and_positions(small(group), rng, priors=(4,), positions=(1, 3, 6), lever=lever)


def in_two_parts(group):
    """Return two graphs side by side; nothing connects the second one with the world."""
    first, second = small(group), small(group, 5)
    count = len(first.fixed)

    def both(leaf, other):
        return jnp.concatenate([leaf, other])

    joined = jax.tree.map(both, first, second)
    ends = [both(getattr(first, name), getattr(second, name) + count) for name in ("i", "j")]
    fixed = jnp.arange(2 * count) == 0
    return eqx.tree_at(lambda graph: (graph.i, graph.j, graph.fixed), joined, (*ends, fixed))


def large(group):
    """Return a graph with more rows than are solved as a dense matrix."""
    rng = np.random.default_rng(4)
    count = MOST_DENSE_ROWS // group.tangent_dim + 6
    return graph_of(walk(group, count, rng), [(0, 20), (7, count - 1)], rng)


KINDS = {"loops": small, "measured": measured, "two parts": in_two_parts, "large": large}


def weighted(graph, logs):
    information = graph.information * jnp.exp(logs)[:, None, None]
    return eqx.tree_at(lambda graph: graph.information, graph, information)


def loss(poses):
    numbers = jax.tree.leaves(poses)[0]
    return jnp.sum(jnp.sin(numbers) * jnp.arange(numbers.size).reshape(numbers.shape) / numbers.size)


@pytest.mark.parametrize(
    ("group", "kind"),
    [
        (jaxlie.SE3, "measured"),
        (jaxlie.SE2, "two parts"),
        (jaxlie.SE2, "large"),
        pytest.param(jaxlie.SE3, "two parts", marks=pytest.mark.long),
        pytest.param(jaxlie.SE3, "large", marks=pytest.mark.long),
        pytest.param(jaxlie.SE2, "measured", marks=pytest.mark.long),
    ],
)
def test_solution_is_that_of_the_host(group, kind):
    graph = KINDS[kind](group)
    np.testing.assert_allclose(matrices_of(in_program(graph)), matrices_of(solved_poses(graph)), atol=1e-9)


def test_held_vertices_are_those_of_the_structure():
    """Random graphs of several parts, some tied by a fixed vertex, a prior or a position."""
    rng = np.random.default_rng(8)
    of_program = jax.jit(held_vertices)
    chain = graph_of(walk(jaxlie.SE2, 40, rng), [], rng)
    for _ in range(20):
        i, j = rng.integers(0, 40, (2, 39))
        kind = rng.choice([0, 1, 2, 3], 39, p=[0.6, 0.3, 0.05, 0.05])
        i = np.where(kind >= 2, j, i)
        graph = eqx.tree_at(
            lambda graph: (graph.i, graph.j, graph.kind, graph.fixed),
            chain,
            (jnp.asarray(i), jnp.asarray(j), jnp.asarray(kind), jnp.asarray(rng.random(40) < 0.03)),
        )
        np.testing.assert_array_equal(of_program(graph), structure_of(graph).held)


@pytest.mark.parametrize("kind", ["loops", "large"])
def test_sets_of_weights_are_solved_as_one_by_one(kind):
    graph = KINDS[kind](jaxlie.SE2)
    logs = jnp.asarray(np.random.default_rng(1).normal(size=(8, len(graph.i))))
    together = jax.jit(jax.vmap(lambda logs: solved_poses(weighted(graph, logs))))(logs)
    alone = [numbers_of(solved_poses(weighted(graph, each))) for each in logs]
    np.testing.assert_allclose(jax.tree.leaves(together)[0], np.stack(alone), atol=1e-9)


def test_graphs_with_other_edges_are_one_batch():
    """Each graph of the batch has its own structure, on the host as well."""
    graphs = [large(jaxlie.SE2)]
    graphs.append(eqx.tree_at(lambda graph: graph.j, graphs[0], graphs[0].j.at[-1].add(-1)))
    graphs.append(with_poses(graphs[0], graphs[0].poses, np.arange(len(graphs[0].fixed)) == 3))
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *graphs)
    together = jax.tree.leaves(jax.jit(jax.vmap(solved_poses))(stacked))[0]
    for graph, ours in zip(graphs, together, strict=True):
        np.testing.assert_allclose(ours, numbers_of(in_program(graph)), atol=1e-9)


@pytest.mark.parametrize("kind", [pytest.param("loops", marks=pytest.mark.long), "large"])
def test_gradient_in_a_program_is_that_outside_and_the_central_difference(kind):
    graph = KINDS[kind](jaxlie.SE2)
    logs = jnp.zeros(len(graph.i))

    def by_weights(logs):
        return loss(solved_poses(weighted(graph, logs)))

    outside = jax.grad(by_weights)(logs)
    inside = jax.jit(jax.grad(by_weights))(logs)
    np.testing.assert_allclose(inside, outside, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(jax.jit(jax.jacfwd(by_weights))(logs), inside, rtol=1e-9, atol=1e-12)
    value = jax.jit(by_weights)
    for k in (0, 4, len(logs) - 1):
        shift = jnp.zeros_like(logs).at[k].set(1e-3)
        near, far = (float(value(times * shift) - value(-times * shift)) for times in (1, 2))
        assert float(inside[k]) == pytest.approx((8 * near - far) / 12e-3, rel=1e-6, abs=1e-9)


@pytest.mark.long
def test_gradients_of_a_batch_in_space():
    graph = measured(jaxlie.SE3)
    logs = jnp.asarray(np.random.default_rng(1).normal(size=(3, len(graph.i))))

    def by_weights(logs):
        return loss(solved_poses(weighted(graph, logs)))

    together = jax.jit(jax.vmap(jax.grad(by_weights)))(logs)
    for ours, each in zip(together, logs, strict=True):
        np.testing.assert_allclose(ours, jax.grad(by_weights)(each), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("kind", ["loops", "large"])
def test_a_pose_that_edges_leave_open_is_not_a_number(kind):
    graph = KINDS[kind](jaxlie.SE2)
    graph = weighted(graph, jnp.zeros(len(graph.i)).at[1].set(-jnp.inf))
    graph = eqx.tree_at(lambda graph: graph.information, graph, graph.information.at[-1].set(0.0))
    graph = eqx.tree_at(lambda graph: graph.information, graph, graph.information.at[-2].set(0.0))
    assert np.any(np.isnan(numbers_of(in_program(graph))))


def test_single_precision_stays_single():
    graph = jax.tree.map(
        lambda leaf: leaf.astype(jnp.float32) if eqx.is_inexact_array(leaf) else leaf, small(jaxlie.SE3)
    )
    (numbers,) = jax.tree.leaves(in_program(graph))
    assert numbers.dtype == jnp.float32
    np.testing.assert_allclose(numbers, numbers_of(solved_poses(small(jaxlie.SE3))), atol=1e-3)
