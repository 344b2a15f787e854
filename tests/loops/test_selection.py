"""Loops that agree are selected among wrong ones, on long chains of uneven information."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.pose_graph.chordal import edges_at
from lio_jax.pose_graph.graph import LOOP, numbers_of, poses_from, translations
from lio_jax.pose_graph.leave_one_out import falls_without
from lio_jax.pose_graph.path_covariance import path_covariances
from lio_jax.pose_graph.pose_graph import marginal_covariances, solve
from lio_jax.pose_graph.robust import Robust
from lio_jax.pose_graph.structure import structure_of
from tests.loops.graphs import at, graph_of, walk, with_edges

LAPS, PER_LAP = 4, 100


def laps(group):
    """Return poses of several laps around a course of 100 m, looking ahead."""
    phase = 2 * np.pi * np.arange(LAPS * PER_LAP) / PER_LAP
    t = np.stack([16 * np.cos(phase), 12 * np.sin(phase), 0.3 * phase], -1)
    yaw = np.arctan2(*np.gradient(t, axis=0)[:, 1::-1].T)
    if group is jaxlie.SE2:
        c, s = np.cos(yaw), np.sin(yaw)
        return poses_from(np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2), t[:, :2])
    return poses_from(Rotation.from_euler("z", yaw[:, None]).as_matrix(), t)


def uneven_chain(group, rng, loops=40):
    """Return truth and a graph whose sigmas differ by a factor of 10, with right loops between the laps."""
    truth = laps(group)
    first = rng.integers(0, (LAPS - 1) * PER_LAP - 4, loops)
    pairs = np.stack([first, first + PER_LAP + rng.integers(-3, 4, loops)], -1)
    size = truth.tangent_dim
    turns = size // 2
    sigma = np.array([0.003] * turns + [0.02] * (size - turns))
    sigma = sigma * 10 ** rng.uniform(-0.5, 0.5, LAPS * PER_LAP - 1 + loops)[:, None]
    return truth, graph_of(truth, pairs, rng, information=np.eye(size) / sigma[:, None, :] ** 2)


def spoilt(graph, count, rng):
    """Return the graph with wrong loops, which state what a right loop states, between other vertices."""
    right = np.flatnonzero(np.asarray(graph.kind) == LOOP)
    source = rng.choice(right, count)
    ends = np.sort(rng.integers(0, len(graph.fixed), (count, 2)), 1)
    ends[:, 1] = np.where(np.diff(ends)[:, 0] % PER_LAP < 5, (ends[:, 1] + 31) % len(graph.fixed), ends[:, 1])
    information = np.asarray(graph.information)[source]
    return with_edges(graph, ends[:, 0], ends[:, 1], at(graph.measurement, source), information, LOOP)


@pytest.mark.parametrize("group", [jaxlie.SE3, jaxlie.SE2], ids=["space", "plane"])
@pytest.mark.parametrize("wrong", [0, 10, 40])
def test_right_loops_are_kept_and_wrong_ones_rejected(group, wrong):
    rng = np.random.default_rng(2)
    truth, clean = uneven_chain(group, rng)
    graph = spoilt(clean, wrong, rng) if wrong else clean
    found = solve(graph, robust=Robust())
    weights = np.asarray(found.weights)
    assert found.status == "converged"
    assert np.all(weights[: len(clean.i)] == 1)
    assert np.all(weights[len(clean.i) :] == 0)

    def error(poses):
        return np.sqrt(np.mean(np.sum((translations(poses) - translations(truth)) ** 2, 1)))

    assert error(found.poses) == pytest.approx(error(solve(clean).poses), rel=1e-3)
    assert error(found.poses) < 0.3 * error(clean.poses)


@pytest.mark.parametrize("factor", [3, 6])
def test_the_noise_may_be_smaller_than_stated(factor):
    """Many graphs state sigmas that are several times too large: a wrong loop then hides among right ones."""
    rng = np.random.default_rng(5)
    _, clean = uneven_chain(jaxlie.SE3, rng)
    loose = eqx.tree_at(lambda graph: graph.information, clean, clean.information / factor**2)
    weights = np.asarray(solve(spoilt(loose, 40, rng), robust=Robust()).weights)
    print(np.sum(weights[: len(clean.i)] == 0), np.sum(weights[len(clean.i) :]))
    assert np.all(weights[: len(clean.i)] == 1)
    assert np.all(weights[len(clean.i) :] == 0)


def few_loops(right, sure, rng):
    """Return a lap and a half with a few right loops; its odometry states 1 / sure of its true sigmas."""
    truth = at(laps(jaxlie.SE3), slice(3 * PER_LAP // 2))
    first = rng.choice(PER_LAP // 2 - 4, right, replace=False) + 2
    pairs = np.stack([first, first + PER_LAP + rng.integers(-2, 3, right)], -1)
    sigma = np.array([0.004] * 3 + [0.04] * 3)
    graph = graph_of(truth, pairs, rng, information=np.tile(np.diag(sigma**-2), (149 + right, 1, 1)))
    scale = np.where(np.asarray(graph.kind) == LOOP, 1.0, sure**2)[:, None, None]
    return eqx.tree_at(lambda graph: graph.information, graph, graph.information * scale)


def across(graph, count, rng):
    """Return the graph with wrong loops between opposite places of the course, 25 m apart."""
    first = rng.choice(90, count, replace=False)
    source = rng.choice(np.flatnonzero(np.asarray(graph.kind) == LOOP), count)
    measured, information = at(graph.measurement, source), np.asarray(graph.information)[source]
    return with_edges(graph, first, first + PER_LAP // 2, measured, information, LOOP)


@pytest.mark.parametrize(
    ("right", "wrong", "sure"),
    [(1, 0, 1), (1, 1, 0.2), (3, 1, 0.2), (5, 2, 0.2), (20, 5, 0.2), (5, 2, 1), (12, 5, 5)],
)
def test_a_few_loops_do_not_bend_the_odometry(right, wrong, sure):
    """With tight loops and a loose odometry, the odometry bends until all edges agree one by one."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        clean = few_loops(right, sure, rng)
        graph = across(clean, wrong, rng)
        weights = np.asarray(solve(graph, robust=Robust()).weights)
        assert np.all(weights[: len(clean.i)] == 1)
        assert np.all(weights[len(clean.i) :] == 0)


def test_a_graph_without_loops_has_nothing_to_select():
    rng = np.random.default_rng(4)
    graph = graph_of(walk(jaxlie.SE2, 10, rng), [], rng)
    found = solve(graph, robust=Robust())
    assert found.status == "converged"
    assert np.all(np.asarray(found.weights) == 1)


@pytest.mark.parametrize("group", [jaxlie.SE3, jaxlie.SE2], ids=["space", "plane"])
def test_the_fall_without_a_loop_is_that_of_a_new_solve(group):
    rng = np.random.default_rng(1)
    graph = graph_of(walk(group, 40, rng), [(0, 12), (3, 39), (5, 30), (6, 31)], rng, noise=1e-3)
    solution = solve(graph, start="poses")
    used, loops = np.ones(len(graph.i), bool), np.flatnonzero(np.asarray(graph.kind) == LOOP)
    found = falls_without(solution.poses, graph, structure_of(graph), used, loops)
    whole = 2 * np.sum(np.asarray(solution.edge_costs))
    for loop, fall in zip(loops, found, strict=True):
        rest = edges_at(graph, np.flatnonzero(np.arange(len(graph.i)) != loop))
        assert fall == pytest.approx(whole - 2 * np.sum(np.asarray(solve(rest).edge_costs)), rel=1e-3)


@pytest.mark.parametrize("group", [jaxlie.SE3, jaxlie.SE2], ids=["space", "plane"])
def test_the_covariance_along_a_chain_is_the_marginal_one(group):
    """Without loops there is one path, and the first vertex is fixed: its bound is then exact."""
    rng = np.random.default_rng(3)
    graph = graph_of(walk(group, 30, rng), [(0, 12), (0, 29)], rng, noise=1e-4)
    structure = structure_of(graph)
    used = structure.kind != LOOP
    chain = structure_of(graph, used)
    found = path_covariances(
        graph, chain, np.linalg.inv(np.asarray(graph.information)), graph.poses, used, np.flatnonzero(~used)
    )
    alone = edges_at(graph, np.flatnonzero(used))
    solution = solve(alone)
    exact = marginal_covariances(alone, solution, [12, 29])
    np.testing.assert_allclose(found, exact, rtol=1e-6, atol=1e-9 * np.abs(exact).max())


def test_vertices_beyond_all_numbers_leave_a_result(recwarn):
    """A damaged file may state any number; nothing is printed but what the command says."""
    rng = np.random.default_rng(2)
    _, clean = uneven_chain(jaxlie.SE2, rng)
    numbers = np.array(numbers_of(clean.measurement))
    numbers[[5, 120, -1], -1] = 1e160, -1e160, 1e160
    graph = eqx.tree_at(lambda graph: graph.measurement, clean, jaxlie.SE2(jnp.asarray(numbers)))
    assert len(solve(graph, robust=Robust()).weights) == len(clean.i)
    assert not recwarn.list
