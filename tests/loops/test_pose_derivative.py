"""Derivatives of solved poses against central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.pose_graph.factors import edge_hessians, residuals
from lio_jax.pose_graph.graph import POSITION, moved, picked, translations
from lio_jax.pose_graph.pose_derivative import solved_poses
from lio_jax.pose_graph.pose_graph import Limits, solve
from tests.loops.graphs import graph_of, walk, with_edges, with_poses, with_priors_and_positions

STEP = 1e-5


@pytest.fixture(params=[pytest.param(jaxlie.SE3, marks=pytest.mark.long), jaxlie.SE2], ids=["space", "plane"])
def graph(request):
    """Return a graph whose residuals are large, so that the exact Hessian is not Gauss-Newton's."""
    rng = np.random.default_rng(2)
    return graph_of(walk(request.param, 8, rng), [(0, 5), (2, 7)], rng, noise=5.0, scale=30.0)


def loss(poses):
    numbers = jax.tree.leaves(poses)[0]
    return jnp.sum(jnp.sin(numbers) * jnp.arange(numbers.size).reshape(numbers.shape) / numbers.size)


def changed(graph, change, t):
    """Return the graph after a share of a change of its measurements, information and fixed pose."""
    twist, scale, shift = change
    measurement = graph.measurement @ type(graph.poses).exp(t * twist)
    own = jnp.concatenate(
        [
            (at_first(graph.poses) @ type(graph.poses).exp(t * shift)).parameters()[None],
            graph.poses.parameters()[1:],
        ]
    )
    graph = with_poses(graph, type(graph.poses)(own))
    return eqx.tree_at(
        lambda graph: (graph.measurement, graph.information),
        graph,
        (measurement, graph.information * jnp.exp(t * scale)[:, None, None]),
    )


def at_first(poses):
    return jax.tree.map(lambda leaf: leaf[0], poses)


def change_of(graph, seed):
    rng = np.random.default_rng(seed)
    size = graph.poses.tangent_dim
    edges = len(graph.i)
    return tuple(jnp.asarray(rng.normal(size=shape)) for shape in ((edges, size), (edges,), (size,)))


@pytest.mark.parametrize("only", [0, 1, 2], ids=["measurements", "weights", "fixed pose"])
def test_derivative_along_a_change_is_the_central_difference(graph, only):
    change = tuple(part * (number == only) for number, part in enumerate(change_of(graph, 1)))

    def along(t):
        return loss(solved_poses(changed(graph, change, t)))

    expected = (float(along(STEP)) - float(along(-STEP))) / (2 * STEP)
    assert abs(expected) > 1e-3
    _, forward = jax.jvp(along, (0.0,), (1.0,))
    assert float(forward) == pytest.approx(expected, rel=2e-6)
    assert float(jax.grad(along)(0.0)) == pytest.approx(expected, rel=2e-6)


@pytest.mark.long
def test_gradient_by_all_weights(graph):
    def by_weights(logs):
        return loss(
            solved_poses(
                eqx.tree_at(lambda g: g.information, graph, graph.information * jnp.exp(logs)[:, None, None])
            )
        )

    logs = jnp.zeros(len(graph.i))
    gradient = jax.grad(by_weights)(logs)
    for k in (0, 4, 8):
        shift = STEP * jnp.eye(len(logs))[k]
        expected = (float(by_weights(shift)) - float(by_weights(-shift))) / (2 * STEP)
        assert float(gradient[k]) == pytest.approx(expected, rel=1e-5, abs=1e-9)
    np.testing.assert_allclose(jax.jacfwd(by_weights)(logs), gradient, rtol=1e-9, atol=1e-12)


@pytest.mark.long
def test_gradient_by_positions(graph):
    """The graph has a GPS-like position, whose coordinates move its poses."""
    size, turning = graph.poses.tangent_dim, 3 if graph.poses.tangent_dim == 6 else 1
    information = np.zeros((2, size, size))
    information[:, turning:, turning:] = 20 * np.eye(size - turning)
    fixes = jnp.asarray(translations(graph.poses)[[4, 7]] + 0.3)

    def by_fixes(fixes):
        poses = type(graph.poses).exp(jnp.pad(fixes, ((0, 0), (0, turning))))
        return loss(solved_poses(with_edges_traced(graph, poses, information)))

    gradient = jax.grad(by_fixes)(fixes)
    for k in range(2):
        shift = jnp.zeros_like(fixes).at[k, 1].set(STEP)
        expected = (float(by_fixes(fixes + shift)) - float(by_fixes(fixes - shift))) / (2 * STEP)
        assert float(gradient[k, 1]) == pytest.approx(expected, rel=1e-5)


@pytest.mark.long
def test_gradient_by_the_lever(graph):
    """Where the antenna sits is found by gradient as well as any other number."""
    size, turning = graph.poses.tangent_dim, 3 if graph.poses.tangent_dim == 6 else 1
    information = np.zeros((2, size, size))
    information[:, turning:, turning:] = 20 * np.eye(size - turning)
    fixes = jnp.asarray(translations(graph.poses)[[4, 7]] + 0.3)
    poses = type(graph.poses).exp(jnp.pad(fixes, ((0, 0), (0, turning))))

    def by_lever(lever):
        tied = with_edges_traced(graph, poses, information, jnp.zeros((2, size - turning)))
        levers = jnp.zeros((len(tied.i), size - turning)).at[-2:].set(lever)
        return loss(solved_poses(eqx.tree_at(lambda g: g.lever, tied, levers)))

    lever = jnp.array([0.7, -0.4, 1.1])[: size - turning]
    gradient = jax.grad(by_lever)(lever)
    for k in range(size - turning):
        shift = STEP * jnp.eye(size - turning)[k]
        expected = (float(by_lever(lever + shift)) - float(by_lever(lever - shift))) / (2 * STEP)
        assert float(gradient[k]) == pytest.approx(expected, rel=1e-5)


def with_edges_traced(graph, poses, information, lever=None):
    identity = type(poses).identity((2,))
    graph = with_edges(graph, [4, 7], [4, 7], identity, information, POSITION, lever)
    numbers = jnp.concatenate([jax.tree.leaves(graph.measurement)[0][:-2], jax.tree.leaves(poses)[0]])
    return eqx.tree_at(lambda g: g.measurement, graph, type(poses)(numbers))


def test_values_are_those_of_the_solve(graph):
    expected = jax.tree.leaves(solve(graph, limits=Limits(tolerance=1e-14)).poses)[0]
    np.testing.assert_allclose(jax.tree.leaves(solved_poses(graph))[0], expected, atol=1e-6)


@pytest.mark.parametrize(("scale", "largest"), [(1e7, 1e-3), (1e9, 1e-4)])
def test_derivative_in_the_plane_where_residuals_are_small(scale, largest):
    """A logarithm that cancels at small angles makes the exact Hessian wrong."""
    rng = np.random.default_rng(6)
    graph = graph_of(walk(jaxlie.SE2, 8, rng), [(0, 5), (2, 7)], rng, scale=scale)
    r = residuals(picked(graph.poses, graph.i), picked(graph.poses, graph.j), graph)
    assert largest / 10 < np.abs(np.asarray(r)).max() < 10 * largest
    _, logs, _ = change_of(graph, 1)

    def along(t):
        weighted = graph.information * jnp.exp(t * logs)[:, None, None]
        return loss(solved_poses(eqx.tree_at(lambda graph: graph.information, graph, weighted)))

    # differences of fourth order, whose error is far below the tolerance
    near, far = (float(along(step) - along(-step)) for step in (0.02, 0.04))
    assert float(jax.grad(along)(0.0)) == pytest.approx((8 * near - far) / (12 * 0.02), rel=1e-6)


@pytest.mark.parametrize("group", [jaxlie.SE3, jaxlie.SE2], ids=["space", "plane"])
def test_hessians_of_edges_are_second_differences(group):
    rng = np.random.default_rng(5)
    graph = graph_of(walk(group, 8, rng), [(0, 5), (2, 7)], rng, noise=5.0, scale=30.0)
    lever = (0.7, -0.4, 1.1)[: 3 if group is jaxlie.SE3 else 2]
    graph = with_priors_and_positions(graph, rng, priors=(4,), positions=(3, 6), lever=lever)
    size = group.tangent_dim
    T_world_i, T_world_j = picked(graph.poses, graph.i), picked(graph.poses, graph.j)

    @jax.jit
    def costs(steps):
        r = residuals(moved(T_world_i, steps[:, :size]), moved(T_world_j, steps[:, size:]), graph)
        return jnp.einsum("ei,eij,ej->e", r, graph.information, r) / 2

    hessians = jax.jit(edge_hessians)(graph.poses, graph)
    step = 3e-3
    for _ in range(4):
        along = jnp.asarray(rng.normal(size=(len(graph.i), 2 * size)))
        far, near, here = (costs(k * step * along) + costs(-k * step * along) for k in (2, 1, 0))
        expected = (16 * near - far - 15 * here) / (12 * step**2)
        ours = jnp.einsum("ei,eij,ej->e", along, hessians, along)
        np.testing.assert_allclose(ours, expected, rtol=1e-6, atol=1e-5)
