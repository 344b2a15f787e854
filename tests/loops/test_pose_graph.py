"""Pose graphs against gtsam, known truth and the optima of recorded graphs."""

import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.pose_graph.chordal import chordal_poses, edges_at
from lio_jax.pose_graph.descent import point_after
from lio_jax.pose_graph.factors import linearise, residuals
from lio_jax.pose_graph.g2o import read_g2o
from lio_jax.pose_graph.graph import LOOP, POSITION, moved, numbers_of, translations
from lio_jax.pose_graph.pose_graph import Limits, compile_for, marginal_covariances, solve
from lio_jax.pose_graph.structure import structure_of
from tests.loops.agreement import agrees_on_covariances, agrees_with_gtsam
from tests.loops.graphs import (
    at,
    graph_of,
    gtsam_graph,
    gtsam_optimum,
    gtsam_values,
    walk,
    with_poses,
    with_priors_and_positions,
)
from tests.shared_data import SHARED_DATA, needs_shared

GROUPS = {"space": jaxlie.SE3, "plane": jaxlie.SE2}
LOOPS = [(0, 20), (3, 17), (5, 28), (9, 22), (2, 12), (20, 2)]


@pytest.fixture(params=GROUPS.values(), ids=GROUPS)
def graph(request):
    rng = np.random.default_rng(3)
    return graph_of(walk(request.param, 30, rng), LOOPS, rng)


def test_cost_is_gtsams(graph):
    graph = with_priors_and_positions(graph, np.random.default_rng(0))
    rng = np.random.default_rng(1)
    moved = graph.poses @ type(graph.poses).exp(
        jnp.asarray(0.5 * rng.normal(size=(30, graph.poses.tangent_dim)))
    )
    there = with_poses(graph, moved)
    expected = gtsam_graph(graph).error(gtsam_values(moved))
    assert float(solve(there, limits=Limits(iterations=0)).initial_cost) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("start", ["chordal", "poses"])
def test_optimum_is_gtsams(graph, start):
    agrees_with_gtsam(graph, solve(graph, start))


def test_optimum_with_priors_and_positions_is_gtsams(graph):
    graph = with_priors_and_positions(graph, np.random.default_rng(5))
    agrees_with_gtsam(graph, solve(graph))


def test_positions_alone_tie_a_graph_to_the_world(graph):
    graph = with_priors_and_positions(
        graph, np.random.default_rng(6), priors=(), positions=(1, 7, 14, 22, 29)
    )
    turned = type(graph.poses).exp(jnp.ones(graph.poses.tangent_dim)) @ graph.poses
    solution = solve(with_poses(graph, turned))
    agrees_with_gtsam(graph, solution)
    assert float(solution.initial_cost) > 10 * float(solution.cost)


def lever_in(graph):
    """Return the place of an antenna in the vertices' frame, far enough to matter."""
    return np.array([0.8, -1.7, 2.3])[: 3 if graph.information.shape[-1] == 6 else 2]


def test_cost_with_a_lever_is_gtsams(graph):
    graph = with_priors_and_positions(graph, np.random.default_rng(0), lever=lever_in(graph))
    step = 0.5 * np.random.default_rng(1).normal(size=(30, graph.poses.tangent_dim))
    there = with_poses(graph, graph.poses @ type(graph.poses).exp(jnp.asarray(step)))
    expected = gtsam_graph(graph).error(gtsam_values(there.poses))
    assert float(solve(there, limits=Limits(iterations=0)).initial_cost) == pytest.approx(expected, rel=1e-9)


def test_optimum_with_a_lever_is_gtsams(graph):
    """Beside other edges, and where positions are all that ties the graph to the world."""
    rng = np.random.default_rng(10)
    with_priors = with_priors_and_positions(graph, rng, lever=lever_in(graph))
    agrees_with_gtsam(with_priors, solve(with_priors))
    alone = with_priors_and_positions(graph, rng, (), (1, 7, 14, 22, 29), lever_in(graph))
    lost = with_poses(alone, type(alone.poses).exp(jnp.ones(alone.poses.tangent_dim)) @ alone.poses)
    agrees_with_gtsam(alone, solve(lost))


def test_covariances_with_a_lever_are_gtsams(graph):
    graph = with_priors_and_positions(graph, np.random.default_rng(8), lever=lever_in(graph))
    agrees_on_covariances(graph, solve(graph))


def test_a_lever_makes_one_antenna_tell_the_heading(graph):
    """Antenna and origin of one vertex both measured: the line between them points somewhere."""
    rng = np.random.default_rng(11)
    size = graph.information.shape[-1]
    with_both = with_priors_and_positions(graph, rng, (), (4,))
    with_both = with_priors_and_positions(with_both, rng, (), (4,), lever_in(graph))
    if size == 3:
        agrees_with_gtsam(with_both, solve(with_both))
    else:
        with pytest.raises(LioJaxError, match="leave a pose open"):
            marginal_covariances(with_both, solve(with_both), [3])


def test_linearisation_of_a_position_is_the_finite_difference(graph):
    graph = with_priors_and_positions(graph, np.random.default_rng(12), lever=lever_in(graph))
    size = graph.information.shape[-1]
    T_world_j = at(graph.poses, np.asarray(graph.j))
    T_world_i = at(graph.poses, np.asarray(graph.i))
    parts = linearise(graph.poses, graph)
    is_position = np.asarray(graph.kind) == POSITION

    def gradient(direction):
        def cost(step):
            stepped = moved(T_world_j, jnp.asarray(np.tile(step, (len(graph.i), 1))))
            r = np.asarray(residuals(T_world_i, stepped, graph))
            return np.einsum("ei,eij,ej->e", r, np.asarray(graph.information), r) / 2

        return (cost(1e-5 * direction) - cost(-1e-5 * direction)) / 2e-5

    expected = np.stack([gradient(direction) for direction in np.eye(size)], -1)
    np.testing.assert_allclose(
        np.asarray(parts.g_j)[is_position], expected[is_position], rtol=1e-6, atol=1e-4
    )
    assert np.abs(expected[is_position]).max() > 1.0


def test_several_fixed_vertices_stay(graph):
    fixed = np.isin(np.arange(30), [0, 11, 29])
    graph = with_poses(graph, graph.poses, fixed)
    solution = solve(graph, limits=Limits(tolerance=1e-13))
    agrees_with_gtsam(graph, solution)
    np.testing.assert_array_equal(numbers_of(solution.poses)[fixed], numbers_of(graph.poses)[fixed])


def test_a_graph_without_noise_is_solved_from_nothing(graph):
    rng = np.random.default_rng(7)
    truth = walk(type(graph.poses), 30, rng)
    exact = graph_of(truth, LOOPS, rng, noise=0.0)
    lost = numbers_of(type(truth).identity((30,)))
    solution = solve(with_poses(exact, type(truth)(jnp.asarray(lost))))
    assert solution.status == "converged"
    assert float(solution.cost) < 1e-15
    assert solution.iterations == 1
    np.testing.assert_allclose(translations(solution.poses), translations(truth), atol=1e-8)


def test_parts_are_solved_each_by_itself(graph):
    """Without the edges from the first half to the second."""
    i, j = np.asarray(graph.i), np.asarray(graph.j)
    keep = (i < 15) == (j < 15)
    split = edges_at(graph, np.flatnonzero(keep))
    solution = solve(split)
    assert solution.status == "converged"
    assert structure_of(split).parts == 2
    np.testing.assert_array_equal(numbers_of(solution.poses)[15], numbers_of(graph.poses)[15])
    held = with_poses(split, split.poses, np.isin(np.arange(30), [0, 15]))
    agrees_with_gtsam(held, solution)


def test_covariances_are_gtsams(graph):
    graph = with_priors_and_positions(graph, np.random.default_rng(8))
    agrees_on_covariances(graph, solve(graph))


def test_a_fixed_pose_has_no_covariance(graph):
    solution = solve(graph)
    covariances = marginal_covariances(graph, solution, [0, 3])
    assert np.all(covariances[0] == 0)
    assert np.all(np.linalg.eigvalsh(covariances[1]) > 0)


def test_a_pose_without_a_covariance_is_an_error(graph):
    """One position leaves the graph's rotation open."""
    graph = with_priors_and_positions(graph, np.random.default_rng(9), priors=(), positions=(4,))
    with pytest.raises(LioJaxError, match="leave a pose open"):
        marginal_covariances(graph, solve(graph), [3])


def test_warm_start_takes_few_steps(graph):
    solution = solve(graph)
    again = solve(with_poses(graph, solution.poses), "poses")
    assert again.iterations == 1
    assert float(again.cost) == pytest.approx(float(solution.cost), rel=1e-12)


def test_a_limit_is_reported(graph):
    assert solve(graph, "poses", limits=Limits(iterations=1)).status == "iteration limit"


def test_numbers_that_are_not_finite_are_reported(graph):
    poses = numbers_of(graph.poses).copy()
    poses[3, -1] = np.nan
    assert solve(with_poses(graph, type(graph.poses)(jnp.asarray(poses))), "poses").status == "not finite"


def test_graphs_of_similar_size_share_their_program():
    compile_for(graph_of(walk(jaxlie.SE3, 30, np.random.default_rng(0)), LOOPS, np.random.default_rng(0)))
    programs = point_after._cache_size()
    for count in (27, 31):
        rng = np.random.default_rng(count)
        solve(graph_of(walk(jaxlie.SE3, count, rng), [(0, 9), (5, 20)], rng))
    assert point_after._cache_size() == programs


def test_the_same_graph_gives_the_same_bytes(graph):
    first, second = solve(graph), solve(graph)
    np.testing.assert_array_equal(numbers_of(first.poses), numbers_of(second.poses))


OPTIMA = {
    "smallGrid3D": 517.9253,
    "sphere2500": 675.701,
    "parking-garage": 0.634192,
    "M3500": 68.957439,
    "intel": 107.919061,
    "MIT": 20.603473,
}
"""Half the sum of squared whitened residuals; those in the plane are gtsam's from our solution on."""


@needs_shared
@pytest.mark.parametrize("name", OPTIMA)
def test_recorded_graphs_reach_their_optimum(name):
    """From edges alone, and also from the file's guess where it leads to the optimum."""
    graph = read_g2o(SHARED_DATA / "g2o" / f"{name}.g2o").graph
    solution = solve(graph)
    assert solution.status == "converged"
    digits = 1e-6 if name in ("sphere2500", "parking-garage", "smallGrid3D") else 3e-8
    assert float(solution.cost) == pytest.approx(OPTIMA[name], rel=digits)
    factors = gtsam_graph(graph)
    values = gtsam_values(solution.poses)
    assert factors.error(values) == pytest.approx(float(solution.cost), rel=1e-8)
    theirs = gtsam_optimum(factors, values)
    assert factors.error(theirs) == pytest.approx(float(solution.cost), rel=1e-7)
    if name not in ("MIT", "intel"):
        from_file = solve(graph, "poses")
        assert float(from_file.cost) == pytest.approx(OPTIMA[name], rel=1e-6)


@needs_shared
def test_chordal_start_escapes_the_local_minimum_of_the_files_guess():
    """MIT: descents from the guess in the file, gtsam's too, end at 385."""
    graph = read_g2o(SHARED_DATA / "g2o" / "MIT.g2o").graph
    factors = gtsam_graph(graph)
    stuck = factors.error(gtsam_optimum(factors, gtsam_values(graph.poses)))
    assert float(solve(graph).cost) < 0.1 * stuck


@pytest.mark.parametrize("group", GROUPS.values(), ids=GROUPS)
def test_chordal_poses_are_nearer_than_the_odometry(group):
    """Where turns and shifts are measured independently of each other."""
    rng = np.random.default_rng(4)
    information = 1e3 * np.tile(np.eye(6 if group is jaxlie.SE3 else 3), (35, 1, 1))
    graph = graph_of(walk(group, 30, rng), LOOPS, rng, information=information)
    structure = structure_of(graph)
    started = with_poses(graph, chordal_poses(graph, structure))
    solution = solve(graph)
    cost = float(solve(started, limits=Limits(iterations=0)).initial_cost)
    assert cost < 0.1 * float(solution.initial_cost)


def test_kinds_are_those_of_the_edges(graph):
    assert np.sum(np.asarray(graph.kind) == LOOP) == len(LOOPS)
