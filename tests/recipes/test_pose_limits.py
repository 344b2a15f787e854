"""Tilt drawn to another attitude, limits of roll, pitch and height, and the IMU's own attitude."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.core.types import ImuBatch
from lio_jax.recipes.lio_sam_params import SmootherParams
from lio_jax.recipes.smoothed_odometry import drawn_to_tilt, measured_attitude, within_limits
from tests.params import default_params

RNG = np.random.default_rng(5)


def so3(rotation: Rotation) -> jaxlie.SO3:
    return jaxlie.SO3(jnp.asarray(rotation.as_quat()[[3, 0, 1, 2]]))


def scipy_of(rotation: jaxlie.SO3) -> Rotation:
    return Rotation.from_quat(np.asarray(rotation.wxyz)[[1, 2, 3, 0]])


def tilt_between(a: Rotation, b: Rotation) -> float:
    return float(np.arccos(np.clip(a.as_matrix()[2] @ b.as_matrix()[2], -1, 1)))


@pytest.mark.parametrize("weight", [0.0, 0.01, 0.4, 1.0])
def test_the_tilt_goes_its_share_of_the_way_and_the_heading_stays(weight):
    for _ in range(5):
        a, b = Rotation.random(random_state=RNG), Rotation.random(random_state=RNG)
        T = jaxlie.SE3.from_rotation_and_translation(so3(a), jnp.array([1.0, 2.0, 3.0]))
        drawn = drawn_to_tilt(T, so3(b), jnp.asarray(weight))
        found = scipy_of(drawn.rotation())
        assert tilt_between(found, b) == pytest.approx((1 - weight) * tilt_between(a, b), abs=1e-6)
        # the turn is about a horizontal axis: nothing of it is heading
        axis = a.as_matrix() @ (a.inv() * found).as_rotvec()
        assert axis[2] == pytest.approx(0, abs=1e-12)
        np.testing.assert_array_equal(drawn.translation(), T.translation())


def test_an_equal_tilt_changes_nothing_and_has_a_derivative():
    T = jaxlie.SE3.from_rotation_and_translation(so3(Rotation.from_rotvec([0.1, 0.2, 0.3])), jnp.zeros(3))
    turned = jaxlie.SO3.from_z_radians(jnp.asarray(1.0)) @ T.rotation()
    np.testing.assert_allclose(drawn_to_tilt(T, turned, jnp.asarray(0.5)).wxyz_xyz, T.wxyz_xyz, atol=1e-12)
    slope = jax.jacfwd(lambda w: drawn_to_tilt(T, T.rotation(), w).wxyz_xyz)(jnp.asarray(0.3))
    assert np.isfinite(slope).all()


def limits(tilt: float, height: float) -> SmootherParams:
    params = default_params().smoother
    from dataclasses import replace

    return replace(params, tilt_limit=jnp.asarray(tilt), height_limit=jnp.asarray(height))


def test_roll_pitch_and_height_are_cut_off():
    rotation = Rotation.from_euler("ZYX", [1.0, -0.4, 0.3])
    T = jaxlie.SE3.from_rotation_and_translation(so3(rotation), jnp.array([5.0, 6.0, -7.0]))
    cut = within_limits(T, limits(0.2, 2.0))
    np.testing.assert_allclose(scipy_of(cut.rotation()).as_euler("ZYX"), [1.0, -0.2, 0.2], atol=1e-12)
    np.testing.assert_array_equal(cut.translation(), [5.0, 6.0, -2.0])
    np.testing.assert_array_equal(within_limits(T, limits(1000.0, 1000.0)).wxyz_xyz, T.wxyz_xyz)


def test_the_imus_own_attitude_is_the_nearest_one_it_reports():
    attitudes = Rotation.random(4, random_state=RNG).as_quat()
    attitudes[2] = 0.0
    batch = ImuBatch(
        jnp.arange(4.0), jnp.zeros((4, 3)), jnp.zeros((4, 3)), jnp.array([True, True, True, False])
    )
    predicted = jaxlie.SO3.identity()
    _, there = measured_attitude(batch, jnp.asarray(1.0), predicted)
    assert not there
    nine = ImuBatch(batch.time, batch.gyro, batch.accel, batch.mask, jnp.asarray(attitudes))
    found, there = measured_attitude(nine, jnp.asarray(2.4), predicted)
    assert there
    np.testing.assert_allclose(scipy_of(found).as_matrix(), Rotation.from_quat(attitudes[1]).as_matrix())
