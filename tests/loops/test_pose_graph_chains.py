"""Pose graphs of long chains, whose vertices are eliminated many at a time."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.pose_graph.chordal import edges_at
from lio_jax.pose_graph.descent import Equations, Limits, padded, padded_weights, point_after
from lio_jax.pose_graph.graph import LOOP, ODOMETRY, numbers_of
from lio_jax.pose_graph.pose_derivative import solved_poses
from lio_jax.pose_graph.pose_graph import solve
from lio_jax.pose_graph.robust import Robust
from lio_jax.pose_graph.structure import structure_of
from tests.loops.agreement import agrees_on_covariances
from tests.loops.graphs import (
    at,
    graph_of,
    gtsam_graph,
    gtsam_optimum,
    gtsam_values,
    measured,
    walk,
    with_edges,
    with_poses,
    with_priors_and_positions,
)

COUNT = 210
SHAPES = {
    "no loops": [],
    "a ring": [(0, 209)],
    "loops": [(3, 80), (20, 190), (60, 61), (100, 204), (101, 150), (150, 20)],
    "the same loop twice": [(20, 190), (20, 190), (190, 20)],
    "segments of one": [(2 * k, 2 * k + 2) for k in range(100)],
    "one vertex in all loops": [(k, 105) for k in range(5, 95, 6)],
}


@pytest.fixture(params=[jaxlie.SE3, jaxlie.SE2], ids=["space", "plane"])
def group(request):
    return request.param


def chain(group, loops, count=COUNT, noise=1.0):
    """Return a chain whose information is even in all directions, so that its optimum has many digits."""
    rng = np.random.default_rng(6)
    information = np.tile(1e4 * np.eye(6 if group is jaxlie.SE3 else 3), (count - 1 + len(loops), 1, 1))
    truth = walk(group, count, rng, step=0.1, turn=0.1)
    return graph_of(truth, loops, rng, noise, information=information)


def costs_what_gtsams_optimum_does(graph, solution):
    """Poses at the end of a chain are known to few digits, but none is a thousandth of its sigma off."""
    factors = gtsam_graph(graph)
    theirs = factors.error(gtsam_optimum(factors, gtsam_values(solution.poses)))
    assert solution.status == "converged"
    assert abs(float(solution.cost) - theirs) < 1e-3**2 / 2
    assert abs(factors.error(gtsam_values(solution.poses)) - theirs) < 1e-3**2 / 2


def levels(graph):
    return structure_of(graph).order.reduction.levels


@pytest.mark.parametrize("shape", SHAPES)
def test_optimum_is_gtsams(group, shape):
    graph = chain(group, SHAPES[shape])
    assert levels(graph)
    costs_what_gtsams_optimum_does(graph, solve(graph))


def test_optimum_and_covariances_with_priors_and_positions_are_gtsams(group):
    rng = np.random.default_rng(4)
    graph = with_priors_and_positions(chain(group, SHAPES["loops"]), rng, (40, 111), (7, 8, 120, 209))
    # a decrease of 1e-8 of the cost, the solver's default, would be more than a thousandth of a sigma here
    solution = solve(graph, limits=Limits(tolerance=1e-9))
    costs_what_gtsams_optimum_does(graph, solution)
    agrees_on_covariances(graph, solution, (0, 7, 40, 101, 102, 209))


def test_parts_and_fixed_vertices(group):
    """Two chains, in one of which vertices in the middle are fixed."""
    graph = chain(group, SHAPES["loops"])
    i, j = np.asarray(graph.i), np.asarray(graph.j)
    split = edges_at(graph, np.flatnonzero((i < 140) == (j < 140)))
    split = with_poses(split, split.poses, np.isin(np.arange(COUNT), [30, 31, 90, 140]))
    assert levels(split)
    solution = solve(split)
    costs_what_gtsams_optimum_does(split, solution)
    np.testing.assert_array_equal(numbers_of(solution.poses)[[30, 140]], numbers_of(split.poses)[[30, 140]])


def test_wrong_loops_are_distrusted(group):
    graph = chain(group, SHAPES["loops"])
    wrong = np.array([[10, 160], [44, 130]])
    information = np.asarray(graph.information)[:2]
    rng = np.random.default_rng(5)
    elsewhere = measured(at(graph.poses, np.roll(np.arange(COUNT), 37)), wrong, information, rng)
    spoilt = with_edges(graph, wrong[:, 0], wrong[:, 1], elsewhere, information, LOOP)
    assert levels(spoilt)
    solution = solve(spoilt, robust=Robust())
    loops = np.asarray(spoilt.kind) != ODOMETRY
    expected = np.append(np.ones(len(SHAPES["loops"])), [0, 0])
    np.testing.assert_allclose(np.asarray(solution.weights)[loops], expected, atol=1e-3)


def test_a_step_is_that_of_dense_normal_equations(group):
    rng = np.random.default_rng(8)
    graph = with_priors_and_positions(chain(group, SHAPES["loops"]), rng, (40,), (7, 120))
    structure = structure_of(graph)
    whole = padded(graph, structure)
    still = jnp.zeros((len(whole.places.unknown) + 1, structure.tangent_size))
    weights = padded_weights(np.ones(len(graph.i)), whole)
    equations = Equations.at(point_after(whole.graph.poses, still, weights, whole), structure)
    count, size = structure.count, structure.tangent_size
    H = np.zeros((count, size, count, size))
    H[np.arange(count), :, np.arange(count)] = equations.diagonal
    a, b = structure.pairs.T
    H[a, :, b], H[b, :, a] = equations.pairs, equations.pairs.transpose(0, 2, 1)
    expected = np.linalg.solve(H.reshape(count * size, -1), -equations.gradient.ravel())
    step, _ = equations.solved(0.0)
    np.testing.assert_allclose(step.ravel(), expected, rtol=1e-6, atol=1e-8 * np.abs(expected).max())


def test_the_same_graph_gives_the_same_bytes(group):
    graph = chain(group, SHAPES["loops"])
    first, second = solve(graph), solve(graph)
    np.testing.assert_array_equal(numbers_of(first.poses), numbers_of(second.poses))


@pytest.mark.long
def test_derivative_is_the_central_difference():
    graph = chain(jaxlie.SE2, [(3, 80), (20, 60)], 110, noise=5.0)
    rng = np.random.default_rng(7)
    assert levels(graph)
    weights = jnp.asarray(rng.normal(size=(110, 4)))
    twist = jnp.asarray(0.1 * rng.normal(size=(len(graph.i), 3)))

    def along(t):
        turned = graph.measurement @ jaxlie.SE2.exp(t * twist)
        moved = type(graph)(
            graph.poses, graph.i, graph.j, turned, graph.information, graph.kind, graph.fixed, graph.lever
        )
        return jnp.sum(weights * jax.tree.leaves(solved_poses(moved))[0])

    # a smaller step would show the rounding of the two solutions, a larger one their curvature
    step = 3e-4
    expected = float(along(step) - along(-step)) / (2 * step)
    assert abs(expected) > 1.0
    assert float(jax.jvp(along, (0.0,), (1.0,))[1]) == pytest.approx(expected, rel=1e-5)
