"""The drift of the map against poses that are moved with it."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.error_state import DOF, local
from lio_jax.core.types import NavState
from lio_jax.estimation.map_drift import MapDrift
from tests.estimation.navs import random_nav

SMALL = 1e-6


def off_by(nav: NavState, error: np.ndarray) -> jaxlie.SE3:
    """Return the motion of the world that moves the state's pose by a right perturbation, rotation first."""
    moved = nav.T_world_imu @ jaxlie.SE3.exp(jnp.asarray(np.roll(error, 3)))
    # jaxlie's logarithm couples both halves; here the position is moved in the body's axes
    position = nav.T_world_imu.translation() + nav.T_world_imu.rotation() @ jnp.asarray(error[3:])
    moved = jaxlie.SE3.from_rotation_and_translation(moved.rotation(), position)
    return moved @ nav.T_world_imu.inverse()


def moved_with(world: jaxlie.SE3, nav: NavState) -> NavState:
    """Return the state as it is where the world is moved; gravity stays."""
    return NavState(
        T_world_imu=world @ nav.T_world_imu,
        velocity=world.rotation() @ nav.velocity,
        gyro_bias=nav.gyro_bias,
        accel_bias=nav.accel_bias,
        gravity=nav.gravity,
        T_imu_lidar=nav.T_imu_lidar,
        time_offset=nav.time_offset,
    )


@pytest.mark.parametrize("axis", range(6))
def test_another_pose_in_the_same_map_moves_with_it(axis):
    before, after = random_nav(1), random_nav(2)
    error = np.zeros(6)
    error[axis] = SMALL
    drift = MapDrift(jnp.asarray(np.outer(error, error)))
    seen = np.asarray(local(after, moved_with(off_by(before, error), after)))
    carried = drift.carried(before.T_world_imu, after.T_world_imu)
    np.testing.assert_allclose(
        carried.covariance, np.outer(seen[:6], seen[:6]), rtol=1e-5, atol=1e-4 * SMALL**2
    )
    within = jnp.eye(DOF)
    found = np.asarray(carried.added_to(within, after) - within)
    np.testing.assert_allclose(found, np.outer(seen, seen), rtol=1e-5, atol=1e-4 * SMALL**2)


def test_what_is_new_takes_the_poses_error_into_the_map():
    rng = np.random.default_rng(0)
    share, scans, runs = 0.2, 40, 20_000
    root = rng.normal(size=(6, 6))
    errors = rng.normal(size=(runs, scans, 6)) @ root.T
    in_map = np.zeros((runs, 6))
    for scan in range(scans):
        in_map = (1 - share) * in_map + share * (in_map + errors[:, scan])
    pose = jnp.zeros((DOF, DOF)).at[:6, :6].set(root @ root.T)
    still, drift = jaxlie.SE3.identity(), MapDrift.none(jnp.dtype(jnp.float64))
    for _ in range(scans):
        drift = drift.carried(still, still).grown(pose, jnp.asarray(share), jnp.int32(7))
    np.testing.assert_allclose(drift.covariance, np.cov(in_map.T), atol=0.05 * np.abs(drift.covariance).max())


def test_the_first_scan_is_the_world_and_the_second_tells_how_well_it_shows_it():
    drift = MapDrift.none(jnp.dtype(jnp.float64))
    covariance = jnp.diag(jnp.arange(1.0, DOF + 1))
    first = drift.grown(covariance, jnp.asarray(1.0), jnp.int32(0))
    np.testing.assert_array_equal(first.covariance, 0.0)
    second = first.grown(covariance, jnp.asarray(0.3), jnp.int32(1))
    np.testing.assert_array_equal(second.covariance, covariance[:6, :6])


def test_gradient_is_finite_without_drift():
    nav = random_nav(3)

    def variance(share):
        drift = MapDrift.none(jnp.dtype(jnp.float64)).grown(jnp.eye(DOF), share, jnp.int32(5))
        return jnp.trace(drift.added_to(jnp.eye(DOF), nav))

    assert np.isfinite(jax.grad(variance)(jnp.asarray(0.1)))
