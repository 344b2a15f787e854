"""A vehicle at rest shows gravity's direction and its biases; a moving vehicle is detected."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from lio_jax.core.error_state import (
    ACCEL_BIAS,
    EXTRINSIC_ROTATION,
    GRAVITY,
    GYRO_BIAS,
    ROTATION,
    TIME_OFFSET,
    VELOCITY,
)
from lio_jax.core.types import ImuBatch
from lio_jax.imu.initialise import RestStart, initialise_at_rest
from lio_jax.imu.params import InitialParams
from tests.params import default_params

GRAVITY_STRENGTH = 9.80665
RATE = 200
SIZE = 256
PARAMS = eqx.tree_at(
    lambda p: (p.initial.rotation_sigma, p.initial.gravity_sigma, p.initial.velocity_sigma),
    default_params(),
    [jnp.array(value) for value in (0.02, 0.0, 0.1)],
)
"""The attitude bears the uncertainty here, gravity being known; the recipes have it the other way round."""
GYRO_SIGMA = float(PARAMS.imu.gyro_noise) * RATE**0.5
ACCEL_SIGMA = float(PARAMS.imu.accel_noise) * RATE**0.5
T_IMU_LIDAR = jaxlie.SE3(jnp.array([1.0, 0, 0, 0, 0.1, 0.2, 0.3]))

Initialise = Callable[..., RestStart]


def sigmas(**changed: float) -> InitialParams:
    values = [jnp.array(value) for value in changed.values()]
    return eqx.tree_at(lambda p: [getattr(p, name) for name in changed], PARAMS.initial, values)


def padded(seconds: np.ndarray, gyro: np.ndarray, accel: np.ndarray, size: int = SIZE) -> ImuBatch:
    """Return a batch whose padding would be noticed."""
    count = len(seconds)

    def extended(values: np.ndarray) -> jax.Array:
        return jnp.asarray(np.concatenate([values, np.full((size - count, *values.shape[1:]), np.nan)]))

    return ImuBatch(extended(seconds), extended(gyro), extended(accel), jnp.arange(size) < count)


def resting(
    rng: np.random.Generator,
    R_world_imu: np.ndarray,
    gyro_bias: np.ndarray,
    accel_bias: np.ndarray,
    count: int = 200,
    noise: float = 1.0,
) -> ImuBatch:
    accel = R_world_imu.T @ [0.0, 0.0, GRAVITY_STRENGTH] + accel_bias
    return padded(
        np.arange(count) / RATE - 0.9,
        gyro_bias + noise * rng.normal(0, GYRO_SIGMA, (count, 3)),
        accel + noise * rng.normal(0, ACCEL_SIGMA, (count, 3)),
    )


@pytest.fixture(scope="module")
def initialise() -> Initialise:
    compiled = jax.jit(initialise_at_rest)
    return lambda imu, initial=PARAMS.initial: compiled(imu, PARAMS.imu, initial, T_IMU_LIDAR, jnp.array(0.0))


def level(roll: float, pitch: float) -> np.ndarray:
    return Rotation.from_euler("ZYX", [0.0, pitch, roll]).as_matrix()


@pytest.mark.parametrize(
    ("roll", "pitch"),
    [(0.0, 0.0), (0.3, -0.2), (np.pi, 0.0), (np.pi / 2, 0.4), (0.0, 1.5), (-3.0, -1.0)],
)
def test_without_noise_and_bias_the_attitude_is_exact(initialise, roll, pitch):
    zero = np.zeros(3)
    found = initialise(resting(np.random.default_rng(0), level(roll, pitch), zero, zero, noise=0.0))
    assert bool(found.is_still)
    matrix = np.asarray(found.start.nav.T_world_imu.rotation().as_matrix())
    np.testing.assert_allclose(matrix, level(roll, pitch), atol=1e-12)
    assert float(found.accel_scale) == pytest.approx(1.0, abs=1e-12)
    np.testing.assert_array_equal(found.start.nav.velocity, 0.0)
    np.testing.assert_allclose(found.start.nav.gravity, [0, 0, -GRAVITY_STRENGTH], rtol=1e-15)
    np.testing.assert_array_equal(found.start.nav.T_imu_lidar.wxyz_xyz, T_IMU_LIDAR.wxyz_xyz)


def test_biases_are_found(initialise):
    gyro_bias = np.array([0.01, -0.02, 0.005])
    R = level(0.2, 0.1)
    up = R.T @ [0, 0, 1.0]
    found = initialise(resting(np.random.default_rng(1), R, gyro_bias, 0.15 * up))
    nav = found.start.nav
    sigma = np.sqrt(np.diagonal(found.start.covariance)[GYRO_BIAS])
    assert np.all(sigma < 1.2 * GYRO_SIGMA / 200**0.5)
    assert np.all(np.abs(nav.gyro_bias - gyro_bias) < 4 * sigma)
    assert np.linalg.norm(nav.accel_bias - 0.15 * up) < 4 * ACCEL_SIGMA / 200**0.5
    assert float(found.accel_scale) == pytest.approx(1 + 0.15 / GRAVITY_STRENGTH, abs=5e-3)


def test_the_covariance_is_that_of_the_errors(initialise):
    """Average normalised error squared over random attitudes and biases lies in its 95 % band."""
    rng = np.random.default_rng(2)
    runs, dof = 200, 8
    total = 0.0
    for _ in range(runs):
        R = level(*rng.uniform(-1, 1, 2))
        gyro_bias = rng.normal(0, float(PARAMS.initial.gyro_bias_sigma), 3)
        accel_bias = rng.normal(0, float(PARAMS.initial.accel_bias_sigma), 3)
        found = initialise(resting(rng, R, gyro_bias, accel_bias))
        assert bool(found.is_still)
        nav = found.start.nav
        estimate = np.asarray(nav.T_world_imu.rotation().as_matrix())
        # the world's heading is free: compare where up is
        up, up_found = R.T @ [0, 0, 1.0], estimate.T @ [0, 0, 1.0]
        tilt = np.cross(up, up_found)
        error = np.concatenate([tilt, gyro_bias - nav.gyro_bias, accel_bias - nav.accel_bias])
        index = np.r_[ROTATION, GYRO_BIAS, ACCEL_BIAS]
        covariance = np.asarray(found.start.covariance)[np.ix_(index, index)]
        # no heading: two of the three rotation axes, so eight in all
        plane = np.linalg.svd(up_found[None])[2][1:]
        project = np.zeros((8, 9))
        project[:2, :3], project[2:, 3:] = plane, np.eye(6)
        reduced = project @ covariance @ project.T
        total += (project @ error) @ np.linalg.solve(reduced, project @ error)
    low, high = chi2.ppf([0.025, 0.975], runs * dof) / runs
    assert low < total / runs < high


def test_tilt_and_bias_normal_to_gravity_are_not_observable_apart(initialise):
    start = initialise(resting(np.random.default_rng(3), np.eye(3), np.zeros(3), np.zeros(3))).start
    covariance = np.asarray(start.covariance)
    sigma = np.sqrt(np.diagonal(covariance))
    correlation = [covariance[i, j] / sigma[i] / sigma[j] for i, j in ((1, 12), (0, 13))]
    assert np.all(np.abs(correlation) > 0.9)
    assert sigma[14] < 1.2 * ACCEL_SIGMA / 200**0.5 < 0.25 * sigma[12]


def test_the_heading_is_fixed(initialise):
    start = initialise(resting(np.random.default_rng(3), level(0.4, -0.3), np.zeros(3), np.zeros(3))).start
    up = np.asarray(start.nav.T_world_imu.rotation().as_matrix())[2]
    assert up @ np.asarray(start.covariance)[:3, :3] @ up < 1e-15
    assert np.trace(start.covariance[:3, :3]) > 1e-5


def test_covariance_is_symmetric_and_has_no_negative_direction(initialise):
    covariance = np.asarray(
        initialise(
            resting(np.random.default_rng(3), level(0.5, 0.5), np.zeros(3), np.zeros(3))
        ).start.covariance
    )
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > -1e-12


def test_zero_sigma_freezes(initialise):
    gyro_bias = np.array([0.01, 0.0, 0.0])
    frozen = sigmas(gyro_bias_sigma=0.0, accel_bias_sigma=0.0, rotation_sigma=0.0, velocity_sigma=0.0)
    found = initialise(
        resting(np.random.default_rng(4), level(0.3, 0), gyro_bias, np.array([0, 0, 0.1])), frozen
    )
    np.testing.assert_array_equal(found.start.nav.gyro_bias, 0.0)
    np.testing.assert_array_equal(found.start.nav.accel_bias, 0.0)
    np.testing.assert_array_equal(found.start.covariance, 0.0)


def test_extrinsic_gravity_and_offset_sigmas_are_taken_over(initialise):
    free = sigmas(gravity_sigma=0.01, extrinsic_rotation_sigma=0.02, time_offset_sigma=0.03)
    covariance = initialise(
        resting(np.random.default_rng(5), np.eye(3), np.zeros(3), np.zeros(3)), free
    ).start.covariance
    sigma = np.sqrt(np.diagonal(covariance))
    np.testing.assert_allclose(sigma[GRAVITY], 0.01, rtol=1e-3)
    np.testing.assert_allclose(sigma[EXTRINSIC_ROTATION], 0.02, rtol=1e-12)
    np.testing.assert_allclose(sigma[TIME_OFFSET], 0.03, rtol=1e-12)


def test_the_time_offset_is_that_of_the_settings():
    batch = resting(np.random.default_rng(5), np.eye(3), np.zeros(3), np.zeros(3))
    found = initialise_at_rest(batch, PARAMS.imu, PARAMS.initial, T_IMU_LIDAR, jnp.array(0.02))
    assert float(found.start.nav.time_offset) == 0.02


def test_twenty_samples_are_enough(initialise):
    found = initialise(resting(np.random.default_rng(6), level(0.1, 0.2), np.zeros(3), np.zeros(3), count=20))
    assert bool(found.is_still)


def moving(kind: str) -> ImuBatch:
    rng = np.random.default_rng(7)
    seconds = np.arange(200) / RATE
    gyro, accel = np.zeros((200, 3)), np.tile([0.0, 0.0, GRAVITY_STRENGTH], (200, 1))
    if kind == "pulls away":
        accel[:, 0] = np.clip(2.0 * (seconds - 0.5), 0, None)
    elif kind == "accelerates steadily":
        accel[:, 0] = 4.0
    elif kind == "turns at 10 m/s":
        gyro[:, 2], accel[:, 1] = 0.4, 4.0
    elif kind == "vibrates":
        accel += np.random.default_rng(8).normal(0, 1.0, accel.shape)
    elif kind == "handheld":
        gyro = np.stack([np.sin(6 * seconds), np.cos(5 * seconds), 0.3 * np.sin(4 * seconds)], axis=1)
        accel += 2 * np.stack([np.sin(7 * seconds), np.cos(9 * seconds), np.sin(8 * seconds)], axis=1)
    gyro += rng.normal(0, GYRO_SIGMA, gyro.shape)
    accel += rng.normal(0, ACCEL_SIGMA, accel.shape)
    return padded(seconds - 0.9, gyro, accel)


@pytest.mark.parametrize(
    "kind", ["pulls away", "accelerates steadily", "turns at 10 m/s", "vibrates", "handheld"]
)
def test_motion_is_found_out_and_leaves_room_for_it(initialise, kind):
    found = initialise(moving(kind))
    assert not bool(found.is_still)
    nav, sigma = found.start.nav, np.sqrt(np.diagonal(found.start.covariance))
    np.testing.assert_array_equal(nav.gyro_bias, 0.0)
    np.testing.assert_array_equal(nav.accel_bias, 0.0)
    np.testing.assert_allclose(sigma[GYRO_BIAS], PARAMS.initial.gyro_bias_sigma, rtol=1e-9)
    assert np.all(sigma[VELOCITY] >= 10.0)
    up = np.asarray(nav.T_world_imu.rotation().as_matrix())[2]
    tilt = np.arccos(np.clip(up @ [0, 0, 1.0], -1, 1))
    assert 0.05 < sigma[0] < 0.5
    assert tilt < 4 * sigma[0]


@pytest.mark.parametrize("count", [0, 1, 4])
def test_too_few_samples_say_nothing_and_break_nothing(initialise, count):
    found = initialise(
        resting(np.random.default_rng(9), level(0.2, 0.0), np.zeros(3), np.zeros(3), count=count)
    )
    assert not bool(found.is_still)
    for leaf in jax.tree.leaves(found):
        assert np.isfinite(np.asarray(leaf)).all()
    if count == 0:
        np.testing.assert_array_equal(found.start.nav.T_world_imu.wxyz_xyz, [1, 0, 0, 0, 0, 0, 0])
        assert float(found.accel_scale) == 0.0


def test_upside_down_stays_upside_down(initialise):
    found = initialise(resting(np.random.default_rng(10), level(np.pi, 0.0), np.zeros(3), np.zeros(3)))
    assert float(found.start.nav.T_world_imu.rotation().as_matrix()[2, 2]) < -0.99


def test_an_accelerometer_in_g_is_not_taken_for_rest(initialise):
    batch = resting(np.random.default_rng(11), np.eye(3), np.zeros(3), np.zeros(3))
    in_g = eqx.tree_at(lambda b: b.accel, batch, batch.accel / GRAVITY_STRENGTH)
    found = initialise(in_g)
    assert not bool(found.is_still)
    assert float(found.accel_scale) == pytest.approx(1 / GRAVITY_STRENGTH, rel=1e-2)


def test_single_precision_does_as_well():
    with jax.enable_x64(False):
        batch = resting(np.random.default_rng(12), level(0.2, 0.1), np.array([0.01, 0, 0]), np.zeros(3))
        single = jax.tree.map(lambda leaf: jnp.asarray(leaf), batch)
        params = default_params()
        found = initialise_at_rest(
            single, params.imu, params.initial, jaxlie.SE3.identity(), jnp.array(0.0, jnp.float32)
        )
    assert found.start.covariance.dtype == jnp.float32
    assert bool(found.is_still)
    assert float(found.start.nav.gyro_bias[0]) == pytest.approx(0.01, abs=0.01)
    assert np.all(np.diagonal(found.start.covariance) >= 0)


def test_a_velocity_that_is_given_has_the_given_uncertainty(initialise):
    known = eqx.tree_at(
        lambda initial: (initial.velocity, initial.velocity_sigma),
        PARAMS.initial,
        (jnp.array([10.0, 0.0, 0.0]), jnp.asarray(0.3)),
    )
    found = initialise(moving("turns at 10 m/s"), known)
    np.testing.assert_allclose(np.sqrt(np.diagonal(found.start.covariance))[VELOCITY], 0.3, rtol=1e-9)
