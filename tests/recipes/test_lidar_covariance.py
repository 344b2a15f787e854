"""The covariance of odometry without inertial samples, against derivatives and random drives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.error_state import DOF, GYRO_BIAS, local, retract
from lio_jax.core.types import CONVERGED
from lio_jax.lidar.deskew import TrialMotion
from lio_jax.recipes.lidar_covariance import LidarCovariance, ScanOnMap, _carry, _lidar_as_imu, _to_imu
from lio_jax.registration.gauss_newton import Registration

RATE = GYRO_BIAS
TWIST = jnp.array([8.0, -0.5, 0.3, 0.1, -0.2, 0.4])
START = jaxlie.SE3.exp(jnp.array([3.0, -2.0, 1.0, 0.3, -0.5, 1.1]))
EXTRINSIC = jaxlie.SE3.exp(jnp.array([0.4, -0.2, 0.7, 0.1, 0.8, -0.3]))
SECONDS = 0.1


def disturbed(error):
    """Return pose and twist of a lidar whose state is off by an error."""
    nav = retract(_lidar_as_imu(START, TWIST), error)
    velocity = nav.T_world_imu.rotation().inverse() @ nav.velocity
    return nav.T_world_imu, jnp.concatenate([velocity, TWIST[3:] + error[RATE]])


def test_errors_are_carried_as_the_motion_itself_carries_them():
    def moved(error):
        pose, twist = disturbed(error)
        return pose @ jaxlie.SE3.exp(SECONDS * twist), twist

    end = moved(jnp.zeros(DOF))

    def off(error):
        return local(_lidar_as_imu(*end), _lidar_as_imu(*moved(error)))[:9]

    exact = jax.jacfwd(off)(jnp.zeros(DOF))
    found = _carry(_lidar_as_imu(START, TWIST), _lidar_as_imu(*end), jnp.asarray(SECONDS))
    # third order in the time is neglected
    assert np.abs(exact[:6, RATE]).max() > 0.05
    np.testing.assert_allclose(found[:9, :15], exact[:, :15], atol=2e-3)


def test_the_imus_error_follows_the_lidars():
    def of_imu(pose, twist):
        nav = _lidar_as_imu(pose @ EXTRINSIC.inverse(), twist)
        turned = EXTRINSIC.adjoint() @ twist
        return replace(nav, velocity=nav.T_world_imu.rotation() @ turned[:3])

    known = of_imu(*disturbed(jnp.zeros(DOF)))
    exact = jax.jacfwd(lambda error: local(known, of_imu(*disturbed(error)))[:9])(jnp.zeros(DOF))
    found = _to_imu(_lidar_as_imu(START, TWIST), TWIST, EXTRINSIC)
    np.testing.assert_allclose(found[:9, :15], exact[:, :15], atol=1e-9)
    assert not found[9:].any()


def scan_at(pose, information, degenerate=(), lost=False):
    held = jnp.zeros(6, bool).at[jnp.array(degenerate, int)].set(True) if degenerate else jnp.zeros(6, bool)
    zero = jnp.zeros(())
    match = Registration(
        pose, information, held, jnp.int32(500), zero, zero, jnp.int32(3), jnp.int32(CONVERGED)
    )
    flags = jnp.array(lost), jnp.array(False)
    return ScanOnMap(match, jnp.asarray(0.01), jnp.asarray(400.0), jnp.asarray(0.5), jnp.asarray(0.1), *flags)


SURE = jnp.diag(jnp.array([1e7] * 3 + [1e5] * 3))


@jax.jit
def one_scan(uncertain, number, scan):
    motion = TrialMotion(TWIST, jnp.asarray(SECONDS), number > 0, jnp.asarray(0.05), jnp.asarray(0.15))
    T_last = scan.match.T_world_lidar @ jaxlie.SE3.exp(-SECONDS * TWIST)
    twist = TWIST + 0.02 * jnp.where(number % 2 == 0, 1.0, -1.0)
    return uncertain.after(motion, T_last, twist, scan, number, EXTRINSIC)


def driven(scans):
    """Return the covariance after each scan."""
    uncertain, found = LidarCovariance.at_start(START.wxyz_xyz.dtype), []
    for number, scan in enumerate(scans):
        uncertain, covariance = one_scan(uncertain, jnp.int32(number), scan)
        found.append(np.asarray(covariance))
    return np.stack(found)


def along_the_lane(covariance):
    """Return the standard deviation along the lidar's x axis, m."""
    axis = np.asarray(EXTRINSIC.rotation() @ jnp.array([1.0, 0.0, 0.0]))
    return np.sqrt(axis @ covariance[3:6, 3:6] @ axis)


def test_the_error_grows_slowly_while_scans_are_matched():
    covariances = driven([scan_at(START, SURE)] * 60)
    sigma = np.sqrt(np.trace(covariances[:, 3:6, 3:6], axis1=1, axis2=2))
    assert (np.diff(sigma[10:]) > 0).all()
    assert sigma[-1] < 0.05


@pytest.mark.parametrize("case", ["lost", "tunnel"])
def test_the_error_along_an_unseen_direction_grows_fast(case):
    seen = [scan_at(START, SURE)] * 20
    if case == "lost":
        unseen = scan_at(START, jnp.zeros((6, 6)), lost=True)
    else:
        # the walls of a tunnel say almost nothing of the way along it
        unseen = scan_at(START, SURE.at[3, 3].set(1.0), degenerate=(0,))
    covariances = driven([*seen, *[unseen] * 50])
    before, after = along_the_lane(covariances[19]), along_the_lane(covariances[-1])
    assert before < 0.05
    # 1 m/s after 1 s, at random: t^3/3 after 5 s
    assert 4 < after < 10
    across = np.sqrt(np.linalg.eigvalsh(covariances[-1][3:6, 3:6])[0])
    assert across > 4 if case == "lost" else across < 0.1


def test_what_the_velocity_changes_by_is_its_uncertainty():
    sigma = np.sqrt(np.diagonal(driven([scan_at(START, SURE)] * 40)[-1])[6:9])
    # the twist jumps by 0.04 between scans, and the scan's end is half a scan later
    assert (sigma > 0.02).all()
    assert (sigma < 0.08).all()
