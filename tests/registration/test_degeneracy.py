"""Scenes with unobservable directions: these keep the prediction and are reported, the others are solved."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.types import CONVERGED
from tests.registration.scenes import (
    GROUND,
    box_room,
    map_of,
    matrix,
    params_with,
    pose,
    pose_error,
    sample,
    seen_from,
)
from tests.registration.test_register import NOISE, PARAMS, POINTS, solve

CORRIDOR = box_room(200.0, 9.0, 4.5)
"""A corridor with ends out of sight: the position along its axis, at 0.2 rad, is not observable."""
DECIDED = params_with(lidar__range_sigma=0.03, registration__degeneracy_ratio=0.02)
"""A threshold well between the corridor's axis (0.004) and its next weakest direction (0.1)."""


@pytest.mark.parametrize("along", [-0.4, 0.0, 0.4])
@pytest.mark.parametrize("params", [PARAMS, DECIDED], ids=["default threshold", "decided threshold"])
def test_a_corridor_keeps_the_prediction_along_its_axis(params, along):
    vmap = map_of(sample(CORRIDOR, 60000, NOISE, seed=0, reach=20.0), params)
    truth = pose([0, 0, 0], [0, 0, 0.2])
    start = truth @ pose([along, 0.1, 0.08], [0.01, 0.01, -0.02])
    points = seen_from(truth, sample(CORRIDOR, POINTS, NOISE, seed=1, reach=12.0))
    result = solve(vmap, points, start, 0.5, params)
    # seen in the corridor's own axes, because the true pose is aligned with them
    off = matrix(truth.inverse() @ result.T_world_lidar)
    assert result.status == CONVERGED
    assert np.linalg.norm(off[1:3, 3]) < 0.02
    assert pose_error(result.T_world_lidar, truth)[1] < 0.2
    assert np.asarray(result.degenerate).tolist() == [True] + [False] * 5
    assert abs(off[0, 3] - along) < 0.05


@pytest.mark.parametrize(
    "params",
    [PARAMS, params_with(lidar__range_sigma=0.03, registration__degeneracy_ratio=0.1)],
    ids=["default threshold", "decided threshold"],
)
def test_bare_ground_leaves_three_directions_to_the_prediction(params):
    vmap = map_of(sample(GROUND, 60000, NOISE, seed=0), params)
    start = pose([0.3, -0.2, 0.1], [0.02, -0.01, 0.03])
    points = seen_from(pose([0, 0, 0], [0, 0, 0]), sample(GROUND, POINTS, NOISE, seed=1, reach=25.0))
    result = solve(vmap, points, start, 0.5, params)
    found = matrix(result.T_world_lidar)
    # the ground is at z = -1.7 of the true pose: height, roll and pitch are known
    np.testing.assert_allclose(found[2, 3], 0.0, atol=0.01)
    np.testing.assert_allclose(found[2, :2], 0.0, atol=2e-3)
    assert np.asarray(result.degenerate).tolist() == [True] * 3 + [False] * 3
    np.testing.assert_allclose(found[:2, 3], [0.3, -0.2], atol=0.05)
    yaw = Rotation.from_matrix(found[:3, :3]).as_euler("zyx")[0]
    np.testing.assert_allclose(yaw, 0.03, atol=0.005)
