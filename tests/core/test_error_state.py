"""The error state's retraction against matrix algebra and gtsam, and its inverse."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.linalg import expm

from lio_jax.core.error_state import DOF, GRAVITY, local, retract, sphere_basis
from lio_jax.core.types import NavState


def random_nav(seed: int) -> NavState:
    keys = jax.random.split(jax.random.key(seed), 7)
    return NavState(
        T_world_imu=jaxlie.SE3.sample_uniform(keys[0]),
        velocity=jax.random.normal(keys[1], (3,)),
        gyro_bias=jax.random.normal(keys[2], (3,)),
        accel_bias=jax.random.normal(keys[3], (3,)),
        gravity=jaxlie.SO3.exp(0.3 * jax.random.normal(keys[4], (3,))) @ jnp.array([0, 0, -9.81]),
        T_imu_lidar=jaxlie.SE3.sample_uniform(keys[5]),
        time_offset=jax.random.normal(keys[6], ()),
    )


def skew(v: np.ndarray) -> np.ndarray:
    return np.cross(np.eye(3), v)


@pytest.mark.parametrize("seed", range(5))
def test_local_is_the_inverse_of_retract(seed: int) -> None:
    nav = random_nav(seed)
    error = 0.5 * jax.random.normal(jax.random.key(100 + seed), (DOF,))
    np.testing.assert_allclose(local(nav, retract(nav, error)), error, atol=1e-12)


def test_retraction_is_that_of_gtsams_nav_state() -> None:
    gtsam = pytest.importorskip("gtsam")
    nav = random_nav(0)
    error = 0.5 * np.asarray(jax.random.normal(jax.random.key(1), (DOF,)))
    rotation = np.asarray(nav.T_world_imu.rotation().as_matrix())
    start = gtsam.NavState(
        gtsam.Rot3(rotation), np.asarray(nav.T_world_imu.translation()), np.asarray(nav.velocity)
    )
    expected = start.retract(error[:9])
    got = retract(nav, jnp.asarray(error))
    np.testing.assert_allclose(got.velocity, expected.velocity(), atol=1e-12)
    np.testing.assert_allclose(got.T_world_imu.as_matrix(), expected.pose().matrix(), atol=1e-12)


def test_gravity_turns_on_its_sphere() -> None:
    nav = random_nav(2)
    gravity = np.asarray(nav.gravity)
    basis = np.asarray(sphere_basis(nav.gravity))
    np.testing.assert_allclose(basis.T @ basis, np.eye(2), atol=1e-12)
    np.testing.assert_allclose(basis.T @ gravity, 0, atol=1e-12)
    turn = np.array([0.2, -0.1])
    got = retract(nav, jnp.zeros(DOF).at[GRAVITY].set(turn)).gravity
    np.testing.assert_allclose(got, expm(skew(basis @ turn)) @ gravity, atol=1e-12)


def test_the_derivative_at_zero_is_the_identity() -> None:
    nav = random_nav(3)
    jacobian = jax.jacfwd(lambda error: local(nav, retract(nav, error)))(jnp.zeros(DOF))
    np.testing.assert_allclose(jacobian, np.eye(DOF), atol=1e-12)
