"""The navigation state's update: manifold reset, frozen parts, and the dense solve it replaces."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.error_state import (
    DOF,
    EXTRINSIC_ROTATION,
    EXTRINSIC_TRANSLATION,
    GRAVITY,
    ROTATION,
    TIME_OFFSET,
    NavEstimate,
    SweptState,
    local,
    retract,
)
from lio_jax.core.types import CONVERGED, NavState
from lio_jax.estimation.iterated_filter import Measurement, Update
from lio_jax.estimation.nav_update import reset_jacobian, update_nav
from tests.estimation.measured_pose import measured_pose
from tests.estimation.navs import random_covariance, random_nav

TOLERANCES = {"rotation_tolerance": jnp.array(1e-11), "translation_tolerance": jnp.array(1e-11)}


@jax.jit
def reset_by_differentiation(nav: NavState, error: jax.Array) -> jax.Array:
    moved = retract(nav, error)
    return jax.jacfwd(lambda small: local(moved, retract(nav, error + small)))(jnp.zeros(DOF))


@pytest.mark.parametrize("scale", [0.0, 1e-9, 1e-3, 0.1, 0.8])
def test_the_reset_is_the_derivative_of_the_change_of_tangent_space(scale) -> None:
    nav = random_nav(1)
    error = scale * jax.random.normal(jax.random.key(2), (DOF,))
    np.testing.assert_allclose(
        jax.jit(reset_jacobian)(nav, error), reset_by_differentiation(nav, error), atol=1e-10
    )


@partial(jax.jit, static_argnums=3)
def update_by_pose(
    prior: NavEstimate, T_world_lidar: jaxlie.SE3, information: jax.Array, iterations: int
) -> Update:
    def measure(nav: NavState) -> Measurement:
        return measured_pose(nav, T_world_lidar, information)

    return update_nav(SweptState.at_once(prior), measure, max_iterations=iterations, **TOLERANCES)[0]


@pytest.fixture(scope="module")
def observation() -> tuple[NavEstimate, jaxlie.SE3, jax.Array]:
    nav = random_nav(3)
    prior = NavEstimate(nav, random_covariance(4, 0.3))
    root = np.linalg.cholesky(np.asarray(prior.covariance))
    truth = jax.jit(retract)(nav, jnp.asarray(root @ np.random.default_rng(5).normal(size=DOF)))
    root = np.random.default_rng(6).normal(size=(6, 6))
    return prior, truth.T_world_imu @ truth.T_imu_lidar, jnp.asarray(50 * root @ root.T)


def test_it_finds_the_maximum_a_posteriori_of_a_dense_solve(observation) -> None:
    prior, T_world_lidar, information = observation
    result = update_by_pose(prior, T_world_lidar, information, 60)
    assert int(result.status) == CONVERGED
    prior_information = jnp.linalg.inv(prior.covariance)
    root = jnp.linalg.cholesky(information).T
    prior_root = jnp.linalg.cholesky(prior_information).T

    def stacked(error: jax.Array, at: NavState) -> jax.Array:
        nav = retract(at, error)
        missed = T_world_lidar.inverse() @ nav.T_world_imu @ nav.T_imu_lidar
        pose_error = jnp.concatenate([missed.rotation().log(), missed.translation()])
        return jnp.concatenate([prior_root @ local(prior.nav, nav), root @ pose_error])

    # Gauss-Newton at the result: its gradient vanishes there and its inverse Hessian is the covariance
    zero, nav = np.zeros(DOF), result.state.nav
    residual = np.asarray(jax.jit(stacked)(zero, nav))
    jacobian = np.asarray(jax.jit(jax.jacfwd(stacked))(zero, nav))
    hessian = jacobian.T @ jacobian
    step = np.linalg.solve(hessian, jacobian.T @ residual)
    np.testing.assert_allclose(step, 0, atol=1e-9)
    assert np.linalg.norm(jax.jit(local)(prior.nav, result.state.nav)) > 0.1
    np.testing.assert_allclose(result.state.covariance, np.linalg.inv(hessian), atol=1e-9)


def test_frozen_parts_stay_put_to_the_last_bit(observation) -> None:
    prior, T_world_lidar, information = observation
    free = jnp.ones(DOF)
    for part in (GRAVITY, EXTRINSIC_ROTATION, EXTRINSIC_TRANSLATION, TIME_OFFSET):
        free = free.at[part].set(0.0)
    state = NavEstimate(prior.nav, prior.covariance * free * free[:, None])
    for _ in range(5):
        result = update_by_pose(state, T_world_lidar, information, 60)
        for name in ("gravity", "T_imu_lidar", "time_offset"):
            before, after = jax.tree.leaves((getattr(prior.nav, name), getattr(result.state.nav, name)))
            np.testing.assert_array_equal(after, before)
        assert not np.any(np.asarray(result.state.covariance)[free == 0])
        assert int(result.status) == CONVERGED
        state = result.state
    assert np.linalg.norm(jax.jit(local)(prior.nav, state.nav)[ROTATION]) > 0.01
