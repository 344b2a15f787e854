"""Strapdown propagation: the mean on a known motion, its transition, its covariance, and missing samples."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.error_state import ACCEL_BIAS, DOF, GYRO_BIAS, NavEstimate, local, retract
from lio_jax.core.types import ImuBatch
from lio_jax.imu.strapdown import path_along, propagate, propagate_sweep
from tests.imu.motion import ideal_imu, nav_at, pose_matrix, quick_jit, velocity
from tests.params import default_params

PARAMS = default_params().imu
NOISELESS = jax.tree.map(jnp.zeros_like, PARAMS)
TIMES = -0.007 + 0.005 * np.arange(12)
START, END = jnp.asarray(-0.003), jnp.asarray(0.041)
OFFSET = 0.0021
ORIGIN = 1.0


@pytest.fixture(scope="module")
def imu() -> ImuBatch:
    """Return samples around [START, END] on the lidar's clock, whose zero is at ORIGIN, with padding."""
    return ideal_imu(ORIGIN + TIMES, ORIGIN, OFFSET)


step = quick_jit(propagate)
follow = quick_jit(path_along)


def state(time: float, covariance: np.ndarray | None = None) -> NavEstimate:
    matrix = np.zeros((DOF, DOF)) if covariance is None else covariance
    return NavEstimate(nav_at(time, OFFSET), jnp.asarray(matrix))


@quick_jit
def transition(nav, imu):
    """Return the derivative of the propagated mean by forward differentiation through the retraction."""

    def mean(nav):
        path = path_along(nav, imu, START, END)
        moved = jax.tree.map(lambda x: x[-1], path.T_world_imu)
        return dataclasses.replace(nav, T_world_imu=moved, velocity=path.velocity[-1])

    end = mean(nav)
    return jax.jacfwd(lambda error: local(end, mean(retract(nav, error))))(jnp.zeros(DOF))


def test_it_follows_a_known_motion(imu: ImuBatch) -> None:
    moved, path = step(state(ORIGIN + float(START)), imu, PARAMS, START, END)
    end = ORIGIN + float(END)
    np.testing.assert_allclose(moved.nav.T_world_imu.as_matrix(), pose_matrix(end), atol=5e-6)
    np.testing.assert_allclose(moved.nav.velocity, velocity(jnp.asarray(end)), atol=2e-4)
    assert float(path.time[0]) == float(START)
    np.testing.assert_allclose(path.time[-1], END, atol=1e-15)
    assert bool(jnp.all(jnp.diff(path.time) >= 0))


def test_its_error_falls_with_the_square_of_the_sample_interval() -> None:
    errors = []
    for interval in (0.02, 0.01):
        batch = ideal_imu(ORIGIN + np.arange(-1, round(0.4 / interval) + 2) * interval, ORIGIN, OFFSET)
        path = follow(state(ORIGIN).nav, batch, jnp.asarray(0.0), jnp.asarray(0.4))
        expected = pose_matrix(ORIGIN + 0.4)[:3, 3]
        errors.append(np.linalg.norm(path.T_world_imu.translation()[-1] - expected))
    assert 3.5 < errors[0] / errors[1] < 4.5


def test_the_transition_is_the_derivative_of_the_mean(imu: ImuBatch) -> None:
    """Phi P Phi' for a random P, without noise: every block of Phi shows in it."""
    factor = np.random.default_rng(0).normal(size=(DOF, DOF))
    begun = state(ORIGIN, factor @ factor.T)
    phi = np.asarray(transition(begun.nav, imu))
    moved, _ = step(begun, imu, NOISELESS, START, END)
    np.testing.assert_allclose(moved.covariance, phi @ factor @ factor.T @ phi.T, atol=1e-12)


def test_the_transition_at_rest_is_finite_and_right(imu: ImuBatch) -> None:
    nav = state(ORIGIN).nav
    rest = dataclasses.replace(
        imu,
        gyro=jnp.broadcast_to(nav.gyro_bias, imu.gyro.shape),
        accel=jnp.broadcast_to(nav.accel_bias, imu.accel.shape),
    )
    phi = np.asarray(transition(nav, rest))
    moved, _ = step(NavEstimate(nav, jnp.eye(DOF)), rest, NOISELESS, START, END)
    np.testing.assert_allclose(moved.covariance, phi @ phi.T, atol=1e-12)


@pytest.mark.parametrize("row", [3, 10])
def test_the_transition_of_the_time_offset_is_a_finite_difference(imu: ImuBatch, row: int) -> None:
    """Compared with differences of whole propagations; noise on the samples makes the shift visible."""
    nav = state(ORIGIN).nav
    noisy = dataclasses.replace(imu, gyro=imu.gyro + jnp.sin(100.0 * jnp.arange(48))[:, None])
    h = 1e-6

    def end(offset: float):
        path = follow(dataclasses.replace(nav, time_offset=jnp.asarray(offset)), noisy, START, END)
        return path.T_world_imu.wxyz_xyz[-1], path.velocity[-1]

    high, low = end(OFFSET + h), end(OFFSET - h)
    phi = transition(nav, noisy)[:9, 23]
    speed = (high[1] - low[1]) / (2 * h)
    begun = np.zeros((DOF, DOF))
    begun[23, 23] = 1.0
    moved, _ = step(NavEstimate(nav, jnp.asarray(begun)), noisy, NOISELESS, START, END)
    rotation = moved.nav.T_world_imu.rotation()
    np.testing.assert_allclose(rotation @ phi[6:9], speed, rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(moved.covariance[:9, 23], phi, atol=1e-12)


def test_frozen_parts_stay_frozen(imu: ImuBatch) -> None:
    moved, _ = step(state(ORIGIN), imu, PARAMS, START, END)
    np.testing.assert_array_equal(moved.covariance[15:], 0)
    np.testing.assert_array_equal(moved.covariance[:, 15:], 0)
    np.testing.assert_array_equal(moved.covariance, moved.covariance.T)
    assert np.all(np.diag(moved.covariance)[:15] > 0)


def test_covariance_is_that_of_noisy_runs() -> None:
    """3000 runs on samples with white noise and walking biases."""
    runs, count, interval = 3000, 48, 0.005
    keys = jax.random.split(jax.random.key(0), 4)
    params = dataclasses.replace(PARAMS, gyro_bias_walk=jnp.asarray(0.02), accel_bias_walk=jnp.asarray(0.2))
    span = (jnp.asarray(0.0), jnp.asarray((count - 1) * interval))
    clean = ideal_imu(ORIGIN + np.arange(count) * interval, ORIGIN, OFFSET, size=count)
    begun = state(ORIGIN)
    moved, _ = step(begun, clean, params, *span)

    def walk(key, density):
        steps = density * jnp.sqrt(interval) * jax.random.normal(key, (runs, count, 3))
        return jnp.cumsum(steps.at[:, 0].set(0), axis=1)

    def white(key, density):
        return density / jnp.sqrt(interval) * jax.random.normal(key, (runs, count, 3))

    gyro_walk, accel_walk = walk(keys[0], 0.02), walk(keys[1], 0.2)
    gyro = clean.gyro + gyro_walk + white(keys[2], params.gyro_noise)
    accel = clean.accel + accel_walk + white(keys[3], params.accel_noise)

    @quick_jit
    @jax.vmap
    def error(gyro, accel, gyro_drift, accel_drift):
        path = path_along(begun.nav, ImuBatch(clean.time, gyro, accel, clean.mask), *span)
        end = dataclasses.replace(
            begun.nav,
            T_world_imu=jax.tree.map(lambda x: x[-1], path.T_world_imu),
            velocity=path.velocity[-1],
        )
        drift = jnp.zeros(DOF).at[GYRO_BIAS].set(gyro_drift).at[ACCEL_BIAS].set(accel_drift)
        # the estimate keeps the old bias, so the truth is ahead of it by the drift
        return drift.at[:9].set(local(end, moved.nav)[:9])

    errors = np.asarray(error(gyro, accel, gyro_walk[:, -1], accel_walk[:, -1]))[:, :15]
    expected = np.asarray(moved.covariance)[:15, :15]
    sampled = errors.T @ errors / runs
    sigma = np.sqrt(np.diag(expected))
    # the midpoint rule halves the first and last sample, and runs are finite: a sampled correlation of 3000
    # runs has a standard deviation of at most 0.026 on the diagonal
    np.testing.assert_allclose(sampled / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=0.1)


def test_without_samples_the_velocity_stays_and_the_covariance_grows() -> None:
    nothing = ideal_imu(np.zeros(0))
    begun = state(ORIGIN, 1e-4 * np.eye(DOF))
    moved, path = step(begun, nothing, PARAMS, jnp.asarray(0.0), jnp.asarray(0.1))
    np.testing.assert_allclose(moved.nav.velocity, begun.nav.velocity, atol=1e-14)
    np.testing.assert_allclose(
        moved.nav.T_world_imu.translation(),
        begun.nav.T_world_imu.translation() + 0.1 * begun.nav.velocity,
        atol=1e-14,
    )
    np.testing.assert_array_equal(path.gravity, 0)
    sigma = np.sqrt(np.diag(moved.covariance))
    assert 0.05 < sigma[:3].max() < 0.2
    assert 0.5 < sigma[6:9].min() < 2.0
    # the samples' biases do not act
    np.testing.assert_allclose(moved.covariance[9:15, :9], 0, atol=1e-15)
    assert np.all(np.linalg.eigvalsh(moved.covariance) > 0)


def test_a_gap_costs_certainty(imu: ImuBatch) -> None:
    times = np.arange(-2, 16) * 0.05
    full = ideal_imu(ORIGIN + times, ORIGIN, OFFSET)
    gap = dataclasses.replace(full, mask=full.mask & ((full.time < 0.1) | (full.time > 0.55)))
    span = (jnp.asarray(0.0), jnp.asarray(0.7))
    (whole, _), (holed, _) = (step(state(ORIGIN), batch, PARAMS, *span) for batch in (full, gap))
    assert bool(jnp.all(jnp.isfinite(holed.nav.velocity)))
    assert float(holed.covariance[0, 0]) > 100 * float(whole.covariance[0, 0])


def test_no_time_changes_nothing(imu: ImuBatch) -> None:
    begun = state(ORIGIN, 0.01 * np.eye(DOF))
    moved, _ = step(begun, imu, PARAMS, START, START)
    for before, after in zip(jax.tree.leaves(begun), jax.tree.leaves(moved), strict=True):
        np.testing.assert_allclose(after, before, atol=1e-15)


@pytest.fixture(scope="module")
def reverse():
    def value(log_noise, gyro, imu):
        params = dataclasses.replace(PARAMS, gyro_noise=jnp.exp(log_noise))
        moved, path = propagate(
            state(ORIGIN, 1e-4 * np.eye(DOF)), dataclasses.replace(imu, gyro=gyro), params, START, END
        )
        return 1e3 * jnp.sum(moved.covariance) + jnp.sum(moved.nav.velocity) + jnp.sum(path.T_world_imu.log())

    return quick_jit(jax.value_and_grad(value, argnums=(0, 1)))


@pytest.mark.long
@pytest.mark.parametrize("still", [False, True])
def test_gradients_are_finite_differences(reverse, imu: ImuBatch, still: bool) -> None:
    bias = state(ORIGIN).nav.gyro_bias
    gyro = jnp.broadcast_to(bias, imu.gyro.shape) if still else jnp.where(imu.mask[:, None], imu.gyro, 0.0)
    noise, h = jnp.log(PARAMS.gyro_noise), 1e-6
    _, (by_noise, by_gyro) = reverse(noise, gyro, imu)
    assert bool(jnp.all(jnp.isfinite(by_gyro)))
    difference = (reverse(noise + h, gyro, imu)[0] - reverse(noise - h, gyro, imu)[0]) / (2 * h)
    np.testing.assert_allclose(by_noise, difference, rtol=1e-5)
    along = jnp.asarray(np.random.default_rng(0).normal(size=gyro.shape))
    difference = (reverse(noise, gyro + h * along, imu)[0] - reverse(noise, gyro - h * along, imu)[0]) / (
        2 * h
    )
    np.testing.assert_allclose(jnp.sum(by_gyro * along), difference, rtol=1e-6)


def along(directions, x, imu):
    """Return a propagated covariance and its derivatives along directions of 14 numbers.

    The numbers change the velocity, the rate where nothing is measured, the first variances, the time offset
    and the noise.
    """

    def left(x):
        begun = state(ORIGIN, 1e-4 * np.eye(DOF))
        nav = dataclasses.replace(
            begun.nav, velocity=begun.nav.velocity + x[:3], time_offset=begun.nav.time_offset + x[12]
        )
        params = dataclasses.replace(PARAMS, gyro_noise=PARAMS.gyro_noise * jnp.exp(x[13]))
        begun = NavEstimate(nav, begun.covariance + jnp.diag(jnp.tile(x[6:12], 4)))
        rate = jnp.asarray([0.3, -0.2, 0.5]) + x[3:6]
        swept, _ = propagate_sweep(begun, imu, params, START, END, START, rate)
        return swept.covariance

    return jax.vmap(lambda one: jax.jvp(left, (x,), (one,)), out_axes=(None, 0))(directions)


def test_without_samples_the_derivative_by_the_motion_is_a_finite_difference() -> None:
    nothing, value = ideal_imu(np.zeros(0)), quick_jit(along)
    directions, h = jnp.eye(14)[:6], 1e-6
    _, slopes = value(directions, jnp.zeros(14), nothing)
    for direction, slope in zip(directions, slopes, strict=True):
        high, low = (value(directions, side * h * direction, nothing)[0] for side in (1, -1))
        assert float(jnp.max(jnp.abs(slope))) > 1e-6
        np.testing.assert_allclose(slope, (high - low) / (2 * h), rtol=1e-6, atol=1e-8)


def test_the_derivative_by_time_offset_and_noise_is_a_finite_difference(imu: ImuBatch) -> None:
    """The time offset changes how long the first and the last interval are, and so their noise."""
    value = quick_jit(along)
    directions, h = jnp.eye(14)[12:], 1e-5
    _, slopes = value(directions, jnp.zeros(14), imu)
    for direction, slope in zip(directions, slopes, strict=True):
        high, low = (value(directions, side * h * direction, imu)[0] for side in (1, -1))
        largest = float(jnp.max(jnp.abs(slope)))
        assert largest > 1e-7
        np.testing.assert_allclose(slope, (high - low) / (2 * h), rtol=1e-5, atol=1e-5 * largest)


def test_tangents_share_the_slopes_of_the_samples(imu: ImuBatch) -> None:
    """14 tangents need less than twice the operations of one."""

    def operations(count: int) -> float:
        lowered = jax.jit(along).lower(jnp.eye(14)[:count], jnp.zeros(14), imu)
        return lowered.cost_analysis()["flops"]

    assert operations(14) < 2 * operations(1)


def test_it_runs_in_float32(imu: ImuBatch) -> None:
    def single(tree):
        return jax.tree.map(lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, tree)

    begun = state(ORIGIN + float(START), 1e-4 * np.eye(DOF))
    exact, _ = step(begun, imu, PARAMS, START, END)
    rough, _ = step(*single((begun, imu, PARAMS, START, END)))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(rough))
    np.testing.assert_allclose(
        rough.nav.T_world_imu.as_matrix(), exact.nav.T_world_imu.as_matrix(), atol=2e-6
    )
    np.testing.assert_allclose(rough.covariance, exact.covariance, atol=1e-8)
