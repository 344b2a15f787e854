"""Compare a solved pose graph with gtsam's solution."""

import gtsam
import numpy as np
import pytest

from lio_jax.pose_graph.graph import rotation_matrices, translations
from lio_jax.pose_graph.pose_graph import marginal_covariances
from tests.loops.graphs import gtsam_graph, gtsam_optimum, gtsam_values


def agrees_with_gtsam(graph, solution):
    factors = gtsam_graph(graph)
    theirs = gtsam_optimum(factors, gtsam_values(solution.poses))
    assert solution.status == "converged"
    assert float(solution.cost) == pytest.approx(factors.error(theirs), rel=1e-9)
    for number, (R, t) in enumerate(
        zip(rotation_matrices(solution.poses), translations(solution.poses), strict=True)
    ):
        pose = theirs.atPose3(number) if len(t) == 3 else theirs.atPose2(number)
        np.testing.assert_allclose(t, pose.translation(), atol=1e-5)
        np.testing.assert_allclose(R, pose.rotation().matrix(), atol=1e-5)


def agrees_on_covariances(graph, solution, chosen=(0, 7, 19, 29)):
    marginals = gtsam.Marginals(gtsam_graph(graph), gtsam_values(solution.poses))
    for number, ours in zip(chosen, marginal_covariances(graph, solution, chosen), strict=True):
        theirs = marginals.marginalCovariance(number)
        if len(theirs) == 3:
            theirs = np.roll(theirs, 1, axis=(0, 1))
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6 * np.abs(theirs).max())
