"""Wrong loops among right ones, with known truth."""

import jaxlie
import numpy as np
import pytest

from lio_jax.pose_graph.graduated import truncated_weights
from lio_jax.pose_graph.graph import LOOP, translations
from lio_jax.pose_graph.pose_graph import Robust, solve
from tests.loops.graphs import at, graph_of, walk, with_edges

COUNT, LOOPS = 60, 24


@pytest.mark.parametrize("group", [jaxlie.SE3, jaxlie.SE2], ids=["space", "plane"])
@pytest.mark.parametrize("share", [0.2, 0.5])
def test_wrong_loops_are_found(group, share):
    rng = np.random.default_rng(11)
    truth = walk(group, COUNT, rng)
    pairs = np.sort(rng.integers(0, COUNT, (LOOPS, 2)), 1)
    pairs[:, 1] += 2
    pairs = pairs[pairs[:, 1] < COUNT]
    size = truth.tangent_dim
    information = np.tile(
        np.diag([1e4] * (size // 2) + [1e3] * (size - size // 2)), (COUNT - 1 + len(pairs), 1, 1)
    )
    clean = graph_of(truth, pairs, rng, information=information)
    wrong = round(len(pairs) * share / (1 - share))
    ends = rng.integers(0, COUNT // 2, (wrong, 2)) + np.array([0, COUNT // 2])
    elsewhere = rng.integers(0, COUNT, (2, wrong))
    measured = at(truth, elsewhere[0]).inverse() @ at(truth, elsewhere[1])
    spoilt = with_edges(clean, ends[:, 0], ends[:, 1], measured, information[:wrong], LOOP)

    def error(solution):
        return np.sqrt(np.mean(np.sum((translations(solution.poses) - translations(truth)) ** 2, 1)))

    reference, robust = error(solve(clean)), solve(spoilt, robust=Robust())
    assert robust.status == "converged"
    assert error(robust) < 2 * reference
    assert error(solve(spoilt)) > 5 * reference
    weights = np.asarray(robust.weights)
    right = len(clean.i)
    assert np.all(weights[right:] == 0)
    assert np.all(weights[: COUNT - 1] == 1)
    assert np.mean(weights[COUNT - 1 : right]) > 0.9


def test_weights_are_those_of_the_paper():
    """Equation (14): 0 beyond (mu + 1) / mu, 1 below mu / (mu + 1), c / r sqrt(mu (mu + 1)) - mu between."""
    mu = 0.5
    squared = np.array([0.0, 0.3, 1 / 3 - 1e-12, 1.0, 2.0, 3 + 1e-9, 100.0])
    expected = [1, 1, 1, np.sqrt(0.75) - 0.5, np.sqrt(0.75 / 2) - 0.5, 0, 0]
    np.testing.assert_allclose(truncated_weights(squared, mu), expected, atol=1e-9)
    np.testing.assert_array_equal(truncated_weights(squared, np.inf), [1, 1, 1, 1, 0, 0, 0])
