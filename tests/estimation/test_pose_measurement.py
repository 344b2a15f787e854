"""The lidar pose's derivatives against automatic differentiation, and what a degenerate scan leaves."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.error_state import DOF, POSITION, ROTATION, TIME_OFFSET, retract
from lio_jax.estimation.pose_measurement import imu_pose_jacobian, keep_observed, lidar_pose_jacobian
from tests.estimation.navs import random_nav

keep = jax.jit(keep_observed)


def world_perturbation(at: jaxlie.SE3, T: jaxlie.SE3) -> jax.Array:
    """Return turn and move in world axes that take one pose to the other."""
    turn = (T.rotation() @ at.rotation().inverse()).log()
    return jnp.concatenate([turn, T.translation() - at.translation()])


@jax.jit
def pose_jacobian_by_differentiation(nav):
    at = nav.T_world_imu @ nav.T_imu_lidar

    def moved(error):
        changed = retract(nav, error)
        return world_perturbation(at, changed.T_world_imu @ changed.T_imu_lidar)

    return jax.jacfwd(moved)(jnp.zeros(DOF))


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobian_is_that_of_the_lidar_pose(seed) -> None:
    nav = random_nav(seed)
    jacobian = jax.jit(lidar_pose_jacobian)(nav)
    np.testing.assert_allclose(jacobian, pose_jacobian_by_differentiation(nav), atol=1e-12)
    assert not np.any(np.asarray(jacobian)[:, TIME_OFFSET])


@pytest.mark.parametrize("seed", range(5))
def test_the_imu_pose_jacobian_moves_the_lidar_alike(seed) -> None:
    nav = random_nav(seed)
    by_error = np.asarray(jax.jit(lidar_pose_jacobian)(nav))
    by_pose = np.hstack([by_error[:, ROTATION], by_error[:, POSITION]])
    np.testing.assert_allclose(by_pose @ np.asarray(imu_pose_jacobian(nav)), by_error, atol=1e-12)


def tunnel(seed):
    """Return normal equations without any hold along one axis, and that axis."""
    rng = np.random.default_rng(seed)
    axis = np.array([0.6, 0.0, 0.8])
    normal = rng.normal(size=(200, 3))
    normal -= np.outer(normal @ axis, axis)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    arm = rng.uniform(-20, 20, (200, 3))
    rows = np.hstack([np.cross(arm, normal), normal]) / 0.05
    residual = rng.normal(size=200)
    return rows.T @ rows, rows.T @ residual, np.mean(np.sum(arm**2, 1)), axis


@pytest.mark.parametrize("seed", range(3))
def test_a_degenerate_direction_is_dropped_and_the_others_are_kept(seed) -> None:
    information, gradient, arm_squared, axis = tunnel(seed)
    # what the roughness of the map seems to know along the tunnel
    along = np.concatenate([np.zeros(3), axis])
    rough = information + 1e-3 * information[5, 5] * np.outer(along, along)
    pulled = gradient + 1e3 * along
    kept, held, degenerate = keep(
        jnp.asarray(rough), jnp.asarray(pulled), jnp.asarray(arm_squared), jnp.array(0.01)
    )
    np.testing.assert_array_equal(degenerate, [True, False, False, False, False, False])
    assert np.abs(kept @ along).max() < 1e-3 * np.abs(information).max() * 1e-3
    # the weakest direction of the scaled problem leans little: the rest is untouched but for that
    np.testing.assert_allclose(kept, information, atol=2e-3 * np.abs(information).max())
    values = np.linalg.eigvalsh(kept)
    assert values[0] > -1e-9 * values[-1]
    assert np.linalg.matrix_rank(np.asarray(kept), tol=1e-9 * values[-1]) == 5
    # the gradient lies in the range of the information
    solution = np.linalg.lstsq(np.asarray(kept), np.asarray(held), rcond=1e-9)[0]
    np.testing.assert_allclose(kept @ solution, held, atol=1e-8 * np.abs(held).max())


def test_with_ratio_zero_everything_is_kept() -> None:
    rows = np.random.default_rng(4).normal(size=(50, 6)) * np.array([1, 1, 1, 1e-3, 1, 1])
    information, gradient = jnp.asarray(rows.T @ rows), jnp.asarray(rows.T @ np.ones(50))
    kept, held, degenerate = keep(information, gradient, jnp.array(30.0), jnp.array(0.0))
    np.testing.assert_allclose(kept, information, atol=1e-10)
    np.testing.assert_allclose(held, gradient, atol=1e-10)
    assert not degenerate.any()


def test_no_information_at_all_is_all_degenerate() -> None:
    kept, held, degenerate = keep(jnp.zeros((6, 6)), jnp.zeros(6), jnp.array(0.0), jnp.array(0.01))
    assert degenerate.all()
    assert not np.any(kept)
    assert not np.any(held)
