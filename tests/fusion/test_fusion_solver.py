"""The solution of a fusion against least squares by scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from lio_jax.fusion.prepare import prepare_fusion
from lio_jax.fusion.problem import COMMON_DOF, NODE_DOF, roots_of
from lio_jax.fusion.solve import fuse, search, whitened_residuals
from lio_jax.fusion.tune import replaced
from tests.fusion import made_drive as made


def test_the_solution_is_the_minimum_that_scipy_finds():
    drive = made.made_drive(seed=2, seconds=1.0)
    # one second of driving does not tell the mounting, so its prior has to
    names = ["extrinsics.rotation", "extrinsics.rotation_sigma"]
    mounting = jnp.asarray(Rotation.from_matrix(made.T_IMU_SENSOR[:3, :3]).as_quat())
    params = replaced(made.true_params(), names, [mounting, jnp.asarray(0.02)])
    problem, states = prepare_fusion(drive.odometry, drive.imu, drive.gps, params)
    found, *_ = search(problem, params, states, jnp.inf, jnp.asarray(50, jnp.int32))
    roots, count = roots_of(problem, params), len(states.motion)

    @jax.jit
    def residuals(error):
        nodes = error[: count * NODE_DOF].reshape(count, NODE_DOF)
        moved = states.retract(nodes, error[count * NODE_DOF :])
        parts = whitened_residuals(problem, params, roots, moved)
        return jnp.concatenate([part.ravel() for part in parts])

    jacobian = jax.jit(jax.jacfwd(residuals))
    start = np.zeros(count * NODE_DOF + COMMON_DOF)
    best = least_squares(residuals, start, jacobian, x_scale="jac", xtol=1e-15, ftol=1e-15, gtol=1e-10)
    error = jnp.asarray(best.x)
    nodes = error[: count * NODE_DOF].reshape(count, NODE_DOF)
    oracle = states.retract(nodes, error[count * NODE_DOF :])
    np.testing.assert_allclose(found.motion[:, :10], oracle.motion[:, :10], atol=2e-4)
    cost = 0.5 * np.sum(np.asarray(residuals(jnp.asarray(best.x))) ** 2)
    result = fuse(problem, params, states)
    assert float(result.cost) == pytest.approx(cost, rel=1e-4)
    by = np.asarray(jacobian(jnp.asarray(best.x)))
    covariance = np.linalg.inv(by.T @ by)
    at = slice((count - 1) * NODE_DOF, (count - 1) * NODE_DOF + 6)
    np.testing.assert_allclose(
        np.diagonal(result.covariance[-1])[:6], np.diagonal(covariance[at, at]), rtol=0.02
    )
