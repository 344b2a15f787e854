"""Log-determinant and selected inverse against dense algebra, and the derivative against differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.pose_graph.block_cholesky import factorise, order_of, plan_of
from lio_jax.pose_graph.factors import edge_costs
from lio_jax.pose_graph.graph import between, moved, picked
from lio_jax.pose_graph.log_determinant import inverse_blocks, log_determinant, log_determinant_of
from tests.loops.graphs import graph_of, walk
from tests.loops.test_block_cholesky import GRAPHS, split, system


@pytest.mark.parametrize("worth_a_level", [1, 4, 1000])
@pytest.mark.parametrize("size", [2, 6])
@pytest.mark.parametrize("name", GRAPHS)
def test_blocks_of_the_inverse_are_those_of_the_dense_inverse(name, size, worth_a_level):
    pairs, blocks, dense = system(name, size)
    factor = factorise(plan_of(order_of(60, pairs, worth_a_level), size), *split(blocks))
    inverse = np.linalg.inv(dense).reshape(60, size, 60, size)
    diagonal, off = inverse_blocks(factor)
    numbers = np.arange(60)
    np.testing.assert_allclose(diagonal, inverse[numbers, :, numbers], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(off, inverse[pairs[:, 0], :, pairs[:, 1]], rtol=1e-9, atol=1e-9)
    assert log_determinant_of(factor) == pytest.approx(np.linalg.slogdet(dense)[1], rel=1e-12)


@pytest.fixture(params=[pytest.param(jaxlie.SE3, marks=pytest.mark.long), jaxlie.SE2], ids=["space", "plane"])
def graph(request):
    rng = np.random.default_rng(2)
    return graph_of(walk(request.param, 8, rng), [(0, 5), (2, 7)], rng, noise=1.0, scale=30.0)


def test_it_is_that_of_the_curvature_where_nothing_is_left_over(graph):
    """Without residuals the Gauss-Newton Hessian is the Hessian."""
    size = graph.poses.tangent_dim
    exact = between(picked(graph.poses, graph.i), picked(graph.poses, graph.j))
    graph = eqx.tree_at(lambda graph: graph.measurement, graph, exact)

    def cost(step):
        steps = jnp.concatenate([jnp.zeros(size), step]).reshape(8, size)
        return jnp.sum(edge_costs(moved(graph.poses, steps), graph))

    dense = jax.hessian(cost)(jnp.zeros(7 * size))
    expected = np.linalg.slogdet(np.asarray(dense))[1]
    assert float(log_determinant(graph.poses, graph)) == pytest.approx(expected, rel=1e-9)


def test_derivatives_by_poses_and_weights_are_central_differences(graph):
    rng = np.random.default_rng(4)
    steps = jnp.asarray(0.3 * rng.normal(size=(8, graph.poses.tangent_dim)))
    scales = jnp.asarray(rng.normal(size=len(graph.i)))

    def along(t):
        information = graph.information * jnp.exp(t * scales)[:, None, None]
        weighted = eqx.tree_at(lambda graph: graph.information, graph, information)
        return log_determinant(moved(graph.poses, t * steps), weighted)

    ends = [float(along(k * 2e-3)) for k in (-2, -1, 1, 2)]
    expected = np.dot(ends, [1, -8, 8, -1]) / (12 * 2e-3)
    assert abs(expected) > 1
    assert float(jax.jvp(along, (0.0,), (1.0,))[1]) == pytest.approx(expected, rel=1e-8)
    assert float(jax.grad(along)(0.0)) == pytest.approx(expected, rel=1e-8)


def test_what_is_not_observable_has_no_number(graph):
    none = eqx.tree_at(lambda graph: graph.information, graph, jnp.zeros_like(graph.information))
    assert np.isnan(log_determinant(none.poses, none))
