"""Preintegration against gtsam, and its two forms against each other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.types import NavState
from lio_jax.imu.params import ImuParams
from lio_jax.imu.preintegration import (
    Preintegrated,
    compose,
    correct_bias,
    predict,
    preintegrate,
    preintegrate_parallel,
)
from lio_jax.imu.sampling import Intervals
from tests.imu.motion import nav_at, quick_jit
from tests.params import default_params

gtsam = pytest.importorskip("gtsam")

GYRO_BIAS = np.array([0.01, 0.02, -0.03])
ACCEL_BIAS = np.array([0.1, -0.2, 0.05])
COUNT = 12
FLIP = np.diag([1.0] * 9 + [-1.0] * 6)
"""gtsam states the biases' error as first minus second."""
ORDER = [*range(9), 12, 13, 14, 9, 10, 11]
"""gtsam has the accelerometer's bias before the gyroscope's."""


def random_intervals(seed: int) -> Intervals:
    rng = np.random.default_rng(seed)
    return Intervals(
        duration=jnp.asarray(rng.uniform(0.001, 0.02, COUNT)),
        gyro=jnp.asarray(2 * rng.normal(size=(COUNT, 3))),
        accel=jnp.asarray(3 * rng.normal(size=(COUNT, 3)) + [0, 0, 9.8]),
        gap=jnp.zeros(COUNT),
        known=jnp.ones(COUNT, bool),
        measured=jnp.asarray(True),
    )


def imu_params(walk: float) -> ImuParams:
    params = default_params().imu
    return dataclasses.replace(
        params, gyro_bias_walk=jnp.asarray(0.1 * walk), accel_bias_walk=jnp.asarray(walk)
    )


scan_form = quick_jit(preintegrate, static_argnames="turning")
parallel_form = quick_jit(preintegrate_parallel, static_argnames="turning")


def ours(intervals: Intervals, turning: bool, walk: float = 0.0, form=scan_form) -> Preintegrated:
    return form(intervals, jnp.asarray(GYRO_BIAS), jnp.asarray(ACCEL_BIAS), imu_params(walk), turning=turning)


def gtsams(intervals: Intervals, turning: bool, walk: float = 0.0):
    """Return gtsam's measurements, with walking biases if ``walk`` is not zero."""
    params = imu_params(walk)
    combined = walk > 0
    kind = "Combined" if combined else "Imu"
    variant = "G" if turning else "Manifold"
    bag = (gtsam.PreintegrationCombinedParams if combined else gtsam.PreintegrationParams).MakeSharedU(9.81)
    bag.setGyroscopeCovariance(np.eye(3) * float(params.gyro_noise) ** 2)
    bag.setAccelerometerCovariance(np.eye(3) * float(params.accel_noise) ** 2)
    bag.setIntegrationCovariance(np.zeros((3, 3)))
    if combined:
        bag.setBiasOmegaCovariance(np.eye(3) * float(params.gyro_bias_walk) ** 2)
        bag.setBiasAccCovariance(np.eye(3) * float(params.accel_bias_walk) ** 2)
    bias = gtsam.imuBias.ConstantBias(ACCEL_BIAS, GYRO_BIAS)
    measurements = getattr(gtsam, f"Preintegrated{kind}Measurements{variant}")(bag, bias)
    for accel, gyro, h in zip(intervals.accel, intervals.gyro, intervals.duration, strict=True):
        measurements.integrateMeasurement(np.asarray(accel), np.asarray(gyro), float(h))
    return measurements


def close(a, b, relative: float) -> None:
    """Compare covariances entry by entry, relative to the two entries' sigmas."""
    sigma = np.sqrt(np.diag(b))
    np.testing.assert_allclose(
        np.asarray(a) / np.outer(sigma, sigma), b / np.outer(sigma, sigma), atol=relative
    )


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_deltas_and_covariance_are_gtsams(seed: int, turning: bool) -> None:
    intervals = random_intervals(seed)
    got, expected = ours(intervals, turning), gtsams(intervals, turning)
    np.testing.assert_allclose(got.rotation.as_matrix(), expected.deltaRij().matrix(), atol=1e-12)
    np.testing.assert_allclose(got.velocity, expected.deltaVij(), atol=1e-12)
    np.testing.assert_allclose(got.position, expected.deltaPij(), atol=1e-12)
    np.testing.assert_allclose(got.duration, expected.deltaTij(), atol=1e-14)
    close(got.covariance[:9, :9], expected.preintMeasCov(), 1e-9)


@pytest.mark.parametrize("turning", [False, True])
def test_covariance_with_walking_biases_is_gtsams(turning: bool) -> None:
    intervals = random_intervals(7)
    got = FLIP @ np.asarray(ours(intervals, turning, walk=0.1).covariance) @ FLIP
    close(got[np.ix_(ORDER, ORDER)], gtsams(intervals, turning, walk=0.1).preintMeasCov(), 1e-9)


@pytest.mark.parametrize("turning", [False, True])
def test_bias_jacobian_is_gtsams(turning: bool) -> None:
    """gtsam corrects to first order, so differences of its prediction show its Jacobians."""
    intervals = random_intervals(3)
    measurements = gtsams(intervals, turning)
    start = gtsam.NavState(gtsam.Rot3(), np.zeros(3), np.zeros(3))

    def predicted(gyro: np.ndarray, accel: np.ndarray):
        return measurements.predict(start, gtsam.imuBias.ConstantBias(ACCEL_BIAS + accel, GYRO_BIAS + gyro))

    centre, step, none = predicted(np.zeros(3), np.zeros(3)), 1e-5, np.zeros(3)
    columns = [
        (centre.localCoordinates(predicted(*high)) - centre.localCoordinates(predicted(*low))) / (2 * step)
        for high, low in [
            *(((step * axis, none), (-step * axis, none)) for axis in np.eye(3)),
            *(((none, step * axis), (none, -step * axis)) for axis in np.eye(3)),
        ]
    ]
    np.testing.assert_allclose(ours(intervals, turning).bias_jacobian, np.stack(columns, 1), atol=1e-8)


@pytest.mark.parametrize(("turning", "change"), [(False, 0.02), (True, 0.0)])
def test_prediction_is_gtsams(turning: bool, change: float) -> None:
    """Also with other biases, for which gtsam corrects as we do (its G variant corrects along the group)."""
    intervals = random_intervals(5)
    nav = dataclasses.replace(
        nav_at(0.7),
        gyro_bias=jnp.asarray(GYRO_BIAS + change),
        accel_bias=jnp.asarray(ACCEL_BIAS - 5 * change),
    )
    start = gtsam.NavState(
        gtsam.Rot3(np.asarray(nav.T_world_imu.rotation().as_matrix())),
        np.asarray(nav.T_world_imu.translation()),
        np.asarray(nav.velocity),
    )
    bias = gtsam.imuBias.ConstantBias(np.asarray(nav.accel_bias), np.asarray(nav.gyro_bias))
    expected = gtsams(intervals, turning).predict(start, bias)
    got = predict(ours(intervals, turning), nav)
    np.testing.assert_allclose(got.T_world_imu.as_matrix(), expected.pose().matrix(), atol=1e-9)
    np.testing.assert_allclose(got.velocity, expected.velocity(), atol=1e-9)


def test_first_order_correction_is_close_to_integrating_anew() -> None:
    intervals = random_intervals(6)
    gyro, accel = jnp.asarray(GYRO_BIAS + 1e-3), jnp.asarray(ACCEL_BIAS - 1e-2)
    anew = parallel_form(intervals, gyro, accel, imu_params(0.0))
    before = ours(intervals, True)
    corrected = correct_bias(before, gyro, accel)
    for name in ("position", "velocity"):
        error = np.abs(getattr(corrected, name) - getattr(anew, name)).max()
        change = np.abs(getattr(before, name) - getattr(anew, name)).max()
        assert error < 2e-3 * change
    np.testing.assert_array_equal(corrected.gyro_bias, gyro)


def assert_equal(a: Preintegrated, b: Preintegrated) -> None:
    for left, right in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(left, right, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("turning", [False, True])
def test_both_forms_agree(turning: bool) -> None:
    intervals = random_intervals(8)
    assert_equal(ours(intervals, turning, 0.1), ours(intervals, turning, 0.1, parallel_form))


def test_intervals_without_duration_change_nothing() -> None:
    intervals = random_intervals(9)
    empty = jnp.arange(COUNT) % 3 == 1
    padded = dataclasses.replace(intervals, duration=jnp.where(empty, 0.0, intervals.duration))
    kept = [jax.tree.map(lambda x: x[~np.asarray(empty)] if x.ndim else x, padded)]
    assert_equal(ours(padded, True, 0.1), ours(kept[0], True, 0.1))
    assert_equal(ours(padded, True, 0.1, parallel_form), ours(kept[0], True, 0.1))


@pytest.mark.parametrize("form", [preintegrate, preintegrate_parallel])
def test_it_batches_over_intervals(form) -> None:
    singles = [random_intervals(seed) for seed in (1, 2, 3)]
    batch = jax.tree.map(lambda *x: jnp.stack(x), *singles)
    biases = jnp.asarray(GYRO_BIAS), jnp.asarray(ACCEL_BIAS)
    many = quick_jit(jax.vmap(lambda piece: form(piece, *biases, imu_params(0.1))))(batch)
    for i, single in enumerate(singles):
        assert_equal(jax.tree.map(lambda x, i=i: x[i], many), ours(single, True, 0.1))


def test_pieces_compose_in_any_grouping() -> None:
    intervals = random_intervals(10)
    cuts = [slice(0, 4), slice(4, 8), slice(8, 12)]
    a, b, c = (
        ours(
            jax.tree.map(lambda x, cut=cut: jnp.asarray(np.asarray(x)[cut]) if x.ndim else x, intervals),
            True,
            0.1,
            parallel_form,
        )
        for cut in cuts
    )
    whole = ours(intervals, True, 0.1)
    join = quick_jit(compose)
    assert_equal(join(join(a, b), c), whole)
    assert_equal(join(a, join(b, c)), whole)


def test_without_measurements_the_velocity_stays() -> None:
    intervals = dataclasses.replace(
        random_intervals(11), known=jnp.zeros(COUNT, bool), measured=jnp.asarray(False)
    )
    nav: NavState = nav_at(0.3)
    gained = ours(intervals, True)
    after = predict(gained, nav)
    np.testing.assert_allclose(after.velocity, nav.velocity, atol=1e-14)
    np.testing.assert_array_equal(gained.bias_jacobian, 0)
    assert np.all(np.diag(gained.covariance)[:9] > 1e-3)


@pytest.fixture(scope="module", params=["reverse", "forward"])
def along_a_line(request):
    """Return a scalar of all results along a line through the inputs, and its derivative.

    The scan is differentiated in reverse, the parallel form forwards: each compiles for seconds.
    """
    form = preintegrate if request.param == "reverse" else preintegrate_parallel
    direction = jnp.asarray(np.random.default_rng(0).normal(size=(2, COUNT, 3)))

    def value(x, intervals):
        moved = dataclasses.replace(
            intervals,
            gyro=intervals.gyro + x * direction[0],
            accel=intervals.accel + x * direction[1],
        )
        got = form(moved, jnp.zeros(3), jnp.asarray(ACCEL_BIAS), imu_params(0.1))
        motion = jnp.sum(got.position) + jnp.sum(got.velocity) + got.rotation.log()[0]
        return motion + 1e3 * jnp.sum(got.covariance)

    if request.param == "reverse":
        return quick_jit(jax.value_and_grad(value))
    return quick_jit(lambda x, intervals: jax.jvp(lambda x: value(x, intervals), (x,), (jnp.ones_like(x),)))


@pytest.mark.parametrize("still", [False, True])
def test_gradients_are_finite_differences(along_a_line, still: bool) -> None:
    """At rest the rotations are zero, where a careless logarithm or angle has no derivative."""
    intervals = random_intervals(12)
    if still:
        intervals = dataclasses.replace(intervals, gyro=jnp.zeros_like(intervals.gyro))
    step = 1e-6
    high, low = (along_a_line(jnp.asarray(x), intervals)[0] for x in (step, -step))
    gradient = along_a_line(jnp.asarray(0.0), intervals)[1]
    np.testing.assert_allclose(gradient, (high - low) / (2 * step), rtol=1e-6)
