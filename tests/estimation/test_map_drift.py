"""The drift of the map against poses that are moved with it, and against drawn errors."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.error_state import DOF, EXTRINSIC_ROTATION, EXTRINSIC_TRANSLATION, NavEstimate, local
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
    """Return the state as it is where the world is moved."""
    return NavState(
        T_world_imu=world @ nav.T_world_imu,
        velocity=world.rotation() @ nav.velocity,
        gyro_bias=nav.gyro_bias,
        accel_bias=nav.accel_bias,
        gravity=world.rotation() @ nav.gravity,
        T_imu_lidar=nav.T_imu_lidar,
        time_offset=nav.time_offset,
    )


@pytest.mark.parametrize("axis", range(6))
def test_another_pose_in_the_same_map_moves_with_it(axis):
    before, after = random_nav(1), random_nav(2)
    error = np.zeros(6)
    error[axis] = SMALL
    drift = MapDrift(jnp.asarray(np.outer(error, error)), jnp.zeros((DOF, 6)))
    seen = np.asarray(local(after, moved_with(off_by(before, error), after)))
    carried = drift.carried(before.T_world_imu, after.T_world_imu)
    np.testing.assert_allclose(
        carried.covariance, np.outer(seen[:6], seen[:6]), rtol=1e-5, atol=1e-4 * SMALL**2
    )
    within = jnp.eye(DOF)
    found = np.asarray(carried.added_to(NavEstimate(after, within)) - within)
    np.testing.assert_allclose(found, np.outer(seen, seen), rtol=1e-5, atol=1e-4 * SMALL**2)


NAV = random_nav(4)


def moved_by(error: np.ndarray) -> np.ndarray:
    """Return the change of a state's error by small errors (n, 6) of the map, found by moving the world."""
    worlds = [off_by(NAV, unit) for unit in SMALL * np.eye(6)]
    slope = np.stack([np.asarray(local(NAV, moved_with(world, NAV))) for world in worlds])
    return error @ (slope / SMALL)


def as_lidar() -> np.ndarray:
    """Return the derivative of an IMU pose that moves the lidar as a state's error does, by that error."""
    T_imu_lidar = np.asarray(NAV.T_imu_lidar.as_matrix())
    R_imu_lidar, arm = T_imu_lidar[:3, :3], T_imu_lidar[:3, 3]
    found = np.zeros((6, DOF))
    found[:3, :3] = found[3:, 3:6] = np.eye(3)
    # turning the lidar about itself is turning the IMU and moving it back by what the lever arm adds
    found[:3, EXTRINSIC_ROTATION] = R_imu_lidar
    found[3:, EXTRINSIC_ROTATION] = np.stack([np.cross(arm, axis) for axis in R_imu_lidar.T], 1)
    found[3:, EXTRINSIC_TRANSLATION] = np.eye(3)
    return found


def test_errors_that_are_drawn_scatter_as_the_drift_says():
    """Within the map the state is observed anew at each scan, and a part of its error stays."""
    rng = np.random.default_rng(0)
    share, scans, runs, kept = 0.2, 40, 40_000, 0.6
    root, planes = rng.normal(size=(DOF, DOF)), rng.normal(size=(6, 6))
    within, in_map = np.zeros((runs, DOF)), np.zeros((runs, 6))
    state, drift = jnp.zeros((DOF, DOF)), MapDrift.none(jnp.dtype(jnp.float64))
    still = NAV.T_world_imu
    for _ in range(scans):
        # a match leaves a part of the error, and adds its own
        within = kept * within + rng.normal(size=(runs, DOF)) @ root.T
        state = kept**2 * state + root @ root.T
        drift = MapDrift(drift.covariance, kept * drift.cross).carried(still, still)
        into_map = share * within @ as_lidar().T
        new_planes = np.sqrt(share * (2 - share)) * rng.normal(size=(runs, 6)) @ planes.T
        in_map, within = in_map + into_map + new_planes, within - moved_by(into_map)
        estimate, drift = drift.grown(
            NavEstimate(NAV, state), jnp.asarray(share), jnp.asarray(planes @ planes.T), jnp.int32(7)
        )
        state = estimate.covariance

    def agrees(found, one, other):
        scatter = np.sqrt(2 * np.outer(np.var(one, 0), np.var(other, 0)) / runs)
        assert np.all(np.abs(found - one.T @ other / runs) < 5 * scatter)

    agrees(drift.covariance, in_map, in_map)
    agrees(state, within, within)
    agrees(drift.cross, within, in_map)
    in_world = within + moved_by(in_map)
    agrees(drift.added_to(estimate), in_world, in_world)


def test_adding_a_scan_moves_errors_into_the_map_and_leaves_the_world_alone():
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(DOF, DOF)), rng.normal(size=(6, 6))
    covariance, in_map = (jnp.asarray(root @ root.T) for root in roots)
    before = NavEstimate(NAV, covariance)
    drift = MapDrift(in_map, jnp.asarray(0.1 * rng.normal(size=(DOF, 6))))
    after, grown = drift.grown(before, jnp.asarray(0.3), jnp.zeros((6, 6)), jnp.int32(9))
    np.testing.assert_allclose(grown.added_to(after), drift.added_to(before), rtol=1e-9, atol=1e-9)
    begun = drift.with_pose_of(covariance, jnp.asarray(True))
    both = drift.cross[:6] + drift.cross[:6].T
    np.testing.assert_allclose(begun.covariance, in_map + covariance[:6, :6] + both, rtol=1e-9)


def test_the_first_scan_is_the_world_and_all_planes_of_the_second_are_new():
    drift = MapDrift.none(jnp.dtype(jnp.float64))
    within, planes = NavEstimate(NAV, jnp.diag(jnp.arange(1.0, DOF + 1))), 0.5 * jnp.eye(6)
    state, first = drift.grown(within, jnp.asarray(1.0), planes, jnp.int32(0))
    np.testing.assert_array_equal(first.covariance, 0.0)
    np.testing.assert_array_equal(state.covariance, within.covariance)
    _, second = first.grown(within, jnp.asarray(0.0), planes, jnp.int32(1))
    np.testing.assert_array_equal(second.covariance, planes)


def test_gradient_is_finite_without_drift():
    def variance(share):
        drift, planes = MapDrift.none(jnp.dtype(jnp.float64)), jnp.eye(6)
        within, drift = drift.grown(NavEstimate(NAV, jnp.eye(DOF)), share, planes, jnp.int32(5))
        return jnp.trace(drift.added_to(within))

    assert np.isfinite(jax.grad(variance)(jnp.asarray(0.1)))
