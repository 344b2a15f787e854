"""The simulated IMU against integration, the Allan deviation and gtsam's preintegration."""

import math
from dataclasses import replace
from itertools import pairwise

import allantools
import equinox as eqx
import gtsam
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from lio_jax.core.errors import UsageError
from lio_jax.sim.imu import GRAVITY, ImuModel, simulate_imu, specific_force
from lio_jax.sim.trajectory import kinematics_at, motion_along
from tests.sim.routes import LAP, WALK

IDEAL = ImuModel(
    gyro_noise=0.0,
    accel_noise=0.0,
    gyro_bias_walk=0.0,
    accel_bias_walk=0.0,
    gyro_bias_sigma=0.0,
    accel_bias_sigma=0.0,
)


@pytest.fixture(scope="module")
def drive():
    return motion_along(LAP, duration_s=60.0, standstill_s=1.5)


@pytest.fixture(scope="module")
def walk():
    return motion_along(WALK, duration_s=60.0)


@pytest.fixture(scope="module")
def noisy(drive):
    return simulate_imu(drive, ImuModel(), 60.0, seed=4)


@pytest.fixture(scope="module")
def ideal(drive):
    return simulate_imu(drive, IDEAL, 60.0, seed=4)[0]


_compiled_states = eqx.filter_jit(jax.vmap(kinematics_at, (None, 0)))


def _states(motion, times):
    """Return the states at up to 3000 instants, always by the same program."""
    states = _compiled_states(motion, jnp.asarray(np.resize(times, 3000)))
    return jax.tree.map(lambda leaf: np.array(leaf[: len(times)]), states)


def _integrated(data, pose, velocity):
    """Integrate the samples by the classical Runge-Kutta method on their quintic interpolant."""
    times = (data.stamp_ns - data.stamp_ns[0]) * 1e-9
    spline = make_interp_spline(times, np.column_stack([data.gyro, data.accel]), k=5)
    samples = [jnp.asarray(spline(times[:-1] + share * times[1])) for share in (0.0, 0.5, 1.0)]
    quaternion = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
    state = (jnp.asarray(quaternion), jnp.asarray(velocity), jnp.asarray(pose[:3, 3]))
    quaternion, velocity, position = _runge_kutta(state, samples, times[1])
    return Rotation.from_quat(np.asarray(quaternion)[[1, 2, 3, 0]]), np.asarray(position)


@jax.jit
def _runge_kutta(state, samples, step):
    def slope(state, sample):
        quaternion, velocity, _ = state
        turning = jaxlie.SO3(quaternion).multiply(jaxlie.SO3(jnp.append(0.0, sample[:3]))).wxyz / 2
        unit = jaxlie.SO3(quaternion / jnp.linalg.norm(quaternion))
        return turning, unit @ sample[3:] + GRAVITY, velocity

    def advance(state, sample):
        start, middle, end = sample
        k1 = slope(state, start)
        k2 = slope(jax.tree.map(lambda x, k: x + step / 2 * k, state, k1), middle)
        k3 = slope(jax.tree.map(lambda x, k: x + step / 2 * k, state, k2), middle)
        k4 = slope(jax.tree.map(lambda x, k: x + step * k, state, k3), end)
        moved = jax.tree.map(
            lambda x, a, b, c, d: x + step / 6 * (a + 2 * b + 2 * c + d), state, k1, k2, k3, k4
        )
        return (moved[0] / jnp.linalg.norm(moved[0]), *moved[1:]), None

    return jax.lax.scan(advance, state, samples)[0]


@pytest.mark.parametrize("name", ["drive", "walk"])
def test_integrated_without_noise_it_is_the_motion(name, request):
    motion = request.getfixturevalue(name)
    data = simulate_imu(motion, IDEAL, 60.0, seed=0)[0]
    assert len(data.stamp_ns) == 12_001
    states = _states(motion, np.array([0.0, 60.0]))
    poses = np.asarray(states.T_world_imu.as_matrix())
    rotation, position = _integrated(data, poses[0], states.velocity[0])
    assert np.linalg.norm(position - poses[1, :3, 3]) < 1e-3
    assert (rotation.inv() * Rotation.from_matrix(poses[1, :3, :3])).magnitude() < 1e-5


def test_at_rest_it_feels_gravity_alone(ideal):
    resting = ideal.stamp_ns <= 1_500_000_000
    assert resting.sum() == 301
    np.testing.assert_allclose(ideal.accel[resting], np.tile(-GRAVITY, (301, 1)), atol=1e-6)
    np.testing.assert_allclose(ideal.gyro[resting], 0, atol=1e-12)


def test_an_accelerometer_at_the_lidar_feels_the_lever_arm(walk):
    """Euler and centripetal terms: f_I + alpha x l + omega x (omega x l), l the arm."""
    arm, turn = np.array([0.3, -0.2, 0.5]), Rotation.from_euler("xyz", [0.2, -0.4, 2.0])
    T_imu_lidar = np.eye(4)
    T_imu_lidar[:3, :3], T_imu_lidar[:3, 3] = turn.as_matrix(), arm
    times, step = np.linspace(2.0, 20.0, 300), 2e-3
    stencil = [_states(walk, times + k * step) for k in (-2, -1, 0, 1, 2)]
    lidar = [np.asarray(states.T_world_imu.as_matrix()) @ T_imu_lidar for states in stencil]

    def weighted(values, *weights):
        return sum(weight * value for weight, value in zip(weights, values, strict=True))

    # of the lidar's own path, by finite differences, without any rigid-body formula
    acceleration = weighted([pose[:, :3, 3] for pose in lidar], -1, 16, -30, 16, -1) / (12 * step**2)
    felt = np.einsum("nij,ni->nj", lidar[2][:, :3, :3], acceleration - GRAVITY)
    omega = stencil[2].angular_velocity
    alpha = weighted([states.angular_velocity for states in stencil], 1, -8, 0, 8, -1) / (12 * step)
    at_imu = np.array(jax.vmap(specific_force)(stencil[2]))
    expected = turn.inv().apply(at_imu + np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm)))
    np.testing.assert_allclose(felt, expected, atol=1e-5)
    assert np.abs(felt - turn.inv().apply(at_imu)).max() > 0.3


def test_an_hour_at_rest_gives_back_the_densities():
    """White noise: sigma^2 = N^2 / tau; bias walk: K^2 tau / 3 (IEEE Std 952-1997, appendix C)."""
    model = ImuModel()
    resting = motion_along(LAP, duration_s=3600.0, standstill_s=3700.0)
    data = simulate_imu(resting, model, 3600.0, seed=0)[0]
    white = np.array([0.05, 0.1, 0.2])
    long = np.array([20.0, 30.0, 45.0, 67.0, 100.0])
    for values, noise, walk in (
        (data.gyro, model.gyro_noise, model.gyro_bias_walk),
        (data.accel, model.accel_noise, model.accel_bias_walk),
    ):
        variance = np.mean([_allan(values[:, axis], model.rate, white) ** 2 for axis in range(3)], axis=0)
        assert math.sqrt(np.mean(variance * white)) == pytest.approx(noise, rel=0.05)
        variance = np.mean([_allan(values[:, axis], model.rate, long) ** 2 for axis in range(3)], axis=0)
        # less the white part, what grows with tau is the walk's
        grown = np.mean((variance - noise**2 / long) * 3 / long)
        assert math.sqrt(grown) == pytest.approx(walk, rel=0.15)


def _allan(values, rate, taus):
    # whole samples of tau only, and averaged down first: the long taus need no more
    thin = 10 if taus[0] > 1 else 1
    values = values[: len(values) // thin * thin].reshape(-1, thin).mean(axis=1)
    found = allantools.oadev(values, rate=rate / thin, data_type="freq", taus=taus)
    np.testing.assert_allclose(found[0], taus)
    return found[1]


def test_gtsam_predicts_the_next_pose_within_its_covariance(drive, noisy):
    """Rotation and position against the 3-sigma ellipsoid of the preintegration's own covariance."""
    data, truth = noisy
    model, per_interval = truth.model, 20
    settings = gtsam.PreintegrationParams.MakeSharedU(9.80665)
    settings.setGyroscopeCovariance(model.gyro_noise**2 * np.eye(3))
    settings.setAccelerometerCovariance(model.accel_noise**2 * np.eye(3))
    settings.setIntegrationCovariance(1e-14 * np.eye(3))
    ends = np.arange(0, len(data.stamp_ns), per_interval)
    states = _states(drive, data.stamp_ns[ends] * 1e-9)
    poses, velocities = np.asarray(states.T_world_imu.as_matrix()), states.velocity
    distances = []
    for number, (first, last) in enumerate(pairwise(ends)):
        bias = gtsam.imuBias.ConstantBias(truth.accel_bias[first], truth.gyro_bias[first])
        interval = gtsam.PreintegratedImuMeasurements(settings, bias)
        # gtsam holds a measurement for a step: the mean of both ends is its value to second order
        for sample in range(first, last):
            interval.integrateMeasurement(
                data.accel[sample : sample + 2].mean(axis=0),
                data.gyro[sample : sample + 2].mean(axis=0),
                1 / model.rate,
            )
        factor = gtsam.ImuFactor(0, 1, 2, 3, 4, interval)
        start, end = (gtsam.Pose3(poses[number + k]) for k in (0, 1))
        error = factor.evaluateError(start, velocities[number], end, velocities[number + 1], bias)[:6]
        distances.append(error @ np.linalg.solve(interval.preintMeasCov()[:6, :6], error))
    within = np.mean(np.array(distances) < chi2.ppf(math.erf(3 / math.sqrt(2)), 6))
    assert len(distances) == 600
    assert within >= 0.99
    # and the covariance is not merely large
    assert 0.9 < np.mean(distances) / 6 < 1.1


def test_noise_and_biases_add_up(noisy, ideal):
    data, truth = noisy
    for values, exact, bias, noise in (
        (data.gyro, ideal.gyro, truth.gyro_bias, truth.model.gyro_noise),
        (data.accel, ideal.accel, truth.accel_bias, truth.model.accel_noise),
    ):
        white = values - exact - bias
        assert np.std(white) == pytest.approx(noise * math.sqrt(200), rel=0.02)
        assert abs(np.mean(white)) < 4 * noise / math.sqrt(60 * 3)
        correlation = np.mean(white[1:] * white[:-1]) / np.var(white)
        assert abs(correlation) < 0.02


def test_the_initial_bias_has_its_mean_and_spread(drive):
    model = replace(ImuModel(), gyro_bias=[0.1, 0.2, -0.1], accel_bias=0.5)
    starts = [simulate_imu(drive, model, 0.01, seed)[1] for seed in range(60)]
    gyro = np.array([truth.gyro_bias[0] for truth in starts]) - [0.1, 0.2, -0.1]
    accel = np.array([truth.accel_bias[0] for truth in starts]) - 0.5
    assert np.std(gyro) == pytest.approx(0.002, rel=0.2)
    assert np.std(accel) == pytest.approx(0.02, rel=0.2)
    assert np.all(np.abs(np.mean(gyro, axis=0)) < 4 * 0.002 / math.sqrt(60))


def test_a_longer_recording_begins_the_same(drive, noisy):
    shorter, truth = simulate_imu(drive, ImuModel(), 10.0, seed=4)
    np.testing.assert_array_equal(noisy[0].accel[:2001], shorter.accel)
    np.testing.assert_array_equal(noisy[1].gyro_bias[:2001], truth.gyro_bias)


def test_chunks_join_without_a_seam():
    """A walk of the bias alone: steps across a chunk's edge are as large as any other."""
    resting = motion_along(LAP, duration_s=200.0, standstill_s=200.0)
    model = replace(IDEAL, accel_bias_walk=0.1)
    data, truth = simulate_imu(resting, model, 200.0, seed=0)
    steps = np.diff(truth.accel_bias, axis=0)
    assert np.std(steps) == pytest.approx(0.1 / math.sqrt(200), rel=0.02)
    assert np.abs(steps).max() < 6 * 0.1 / math.sqrt(200)
    assert np.all(np.any(steps != 0, axis=1))
    np.testing.assert_allclose(data.accel, truth.accel_bias - GRAVITY, atol=1e-6)


def test_the_seed_decides(drive, noisy):
    again, other = (simulate_imu(drive, ImuModel(), 1.0, seed)[0] for seed in (4, 5))
    assert again.gyro.tobytes() == noisy[0].gyro[:201].tobytes()
    assert not np.array_equal(again.gyro, other.gyro)


def test_scale_and_misalignment_act_on_the_true_motion(drive, ideal):
    gain = np.array([[1.01, 0.002, 0.0], [0.0, 0.99, -0.003], [0.001, 0.0, 1.0]])
    data = simulate_imu(drive, replace(IDEAL, gyro_gain=gain, accel_gain=1.02), 10.0, seed=4)[0]
    np.testing.assert_allclose(data.gyro, ideal.gyro[:2001] @ gain.T, atol=1e-12)
    np.testing.assert_allclose(data.accel, 1.02 * ideal.accel[:2001], atol=1e-12)


def test_readings_saturate(drive, ideal):
    data = simulate_imu(drive, replace(IDEAL, gyro_range=0.2, accel_range=9.9), 60.0, seed=4)[0]
    assert np.abs(data.gyro).max() == pytest.approx(0.2)
    assert np.abs(data.accel).max() == pytest.approx(9.9)
    inside = np.abs(ideal.gyro) < 0.2
    np.testing.assert_array_equal(data.gyro[inside], ideal.gyro[inside])
    assert 0.05 < np.mean(~inside) < 0.5


def test_stamps_are_off_by_the_time_offset(drive, ideal):
    data, truth = simulate_imu(drive, replace(IDEAL, time_offset=0.013), 10.0, seed=4, start_ns=5_000)
    np.testing.assert_array_equal(truth.stamp_ns, ideal.stamp_ns[:2001] + 5_000)
    np.testing.assert_array_equal(data.stamp_ns, truth.stamp_ns + 13_000_000)
    np.testing.assert_array_equal(data.gyro, ideal.gyro[:2001])


@pytest.mark.parametrize("rate", [100.0, 300.0, 500.0])
def test_samples_are_exact_at_their_stamps(drive, rate):
    data = simulate_imu(drive, replace(IDEAL, rate=rate), 4.0, seed=0)[0]
    assert len(data.stamp_ns) == 4 * rate + 1
    assert data.stamp_ns[-1] == 4_000_000_000
    exact = _states(drive, data.stamp_ns * 1e-9)
    np.testing.assert_allclose(data.gyro, exact.angular_velocity, atol=1e-12)


def test_numbers_do_not_depend_on_the_x64_mode(drive, noisy):
    with jax.enable_x64(False):
        data = simulate_imu(drive, ImuModel(), 1.0, seed=4)[0]
    np.testing.assert_array_equal(data.accel, noisy[0].accel[:201])


def test_the_truth_can_be_stored_by_name(noisy):
    arrays = noisy[1].arrays()
    assert arrays["gyro_bias"].shape == (12_001, 3)
    assert float(arrays["accel_bias_walk"]) == 2e-4
    assert arrays["gyro_gain"].shape == (3, 3)


def test_no_duration_is_refused(drive):
    with pytest.raises(UsageError, match="duration of 0 s holds no samples"):
        simulate_imu(drive, IDEAL, 0, seed=0)


def test_an_impossible_rate_is_refused(drive):
    with pytest.raises(UsageError, match=r"imu\.rate: 0"):
        simulate_imu(drive, replace(IDEAL, rate=0), 1.0, seed=0)


def test_a_negative_density_is_refused(drive):
    with pytest.raises(UsageError, match=r"imu\.accel_bias_walk: -1"):
        simulate_imu(drive, replace(IDEAL, accel_bias_walk=-1.0), 1.0, seed=0)


def test_a_gain_of_the_wrong_shape_is_refused(drive):
    with pytest.raises(UsageError, match=r"imu.gyro_gain: shape \(3,\)"):
        simulate_imu(drive, replace(IDEAL, gyro_gain=[1.0, 1.0, 1.0]), 1.0, seed=0)
