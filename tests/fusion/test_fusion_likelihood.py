"""The likelihood of a fusion's noise: its derivative, and the noise that it finds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.fusion.prepare import prepare_fusion
from lio_jax.fusion.solve import negative_log_likelihood, search
from lio_jax.fusion.tune import NOISES, read, replaced, tune
from tests.fusion import made_drive as made

NAMES = ("odometry.rotation_drift", "odometry.translation_noise", "imu.gyro_noise", "imu.accel_noise")


@pytest.mark.parametrize("exact", [pytest.param(True, marks=pytest.mark.long), False])
def test_the_gradient_of_the_likelihood_is_that_of_central_differences(exact):
    drive = made.made_drive(seed=3, seconds=3.0)
    params = made.true_params()
    problem, states = prepare_fusion(drive.odometry, drive.imu, drive.gps, params)
    logs = np.log(read(params, NAMES))
    most, kernel = jnp.asarray(50, jnp.int32), params.gps.kernel

    def value(logs, exact=False):
        trial = replaced(params, NAMES, jnp.exp(jnp.asarray(logs)))
        found = states
        for _ in range(2):
            found, *_ = search(problem, jax.lax.stop_gradient(trial), found, kernel, most)
        return trial, found

    def nll(logs, states, exact):
        return negative_log_likelihood(problem, replaced(params, NAMES, jnp.exp(logs)), states, kernel, exact)

    _, found = value(logs)
    gradient = eqx.filter_jit(jax.grad(nll))(jnp.asarray(logs), found, exact)
    score = eqx.filter_jit(nll)
    step, slopes = 1e-2, []
    for index in range(len(logs)):
        ends = [logs + sign * step * np.eye(len(logs))[index] for sign in (1, -1)]
        up, down = (float(score(jnp.asarray(end), value(end)[1], False)) for end in ends)
        slopes.append((up - down) / (2 * step))
    tolerance = 2e-3 if exact else 2e-2
    np.testing.assert_allclose(gradient, slopes, rtol=tolerance, atol=tolerance * np.abs(slopes).max())


@pytest.mark.long
def test_the_noise_is_found_from_ten_times_too_large_and_too_small():
    drive = made.made_drive(seed=5, seconds=30.0)
    true = made.true_params()
    factors = jnp.asarray([10, 0.1, 10, 0.1, 10, 0.1, 1, 1])
    start = replaced(true, NOISES, jnp.asarray(read(true, NOISES)) * factors)
    problem, states = prepare_fusion(drive.odometry, drive.imu, None, start)
    found = tune(problem, start, states, trials=120)
    ratio = read(found.params, NOISES) / read(true, NOISES)
    assert np.all(np.abs(np.log(ratio[2:6])) < np.log(1.25)), ratio
    assert np.all(np.abs(np.log(ratio[:2])) < np.log(2.0)), ratio
    values = [one["negative_log_likelihood"] for one in found.history]
    assert np.nanmin(values) < values[0] - 100


def test_a_trial_that_does_not_converge_is_refused_and_the_best_one_returned(monkeypatch):
    drive = made.made_drive(seed=5, seconds=30.0)
    true = made.true_params()
    names = ("imu.gyro_noise",)
    start = replaced(true, names, jnp.asarray([10 * made.GYRO_NOISE]))
    problem, states = prepare_fusion(drive.odometry, drive.imu, None, start)
    calls = []

    def failing(*arguments):
        calls.append(arguments)
        states, status, iterations, cost = search(*arguments)
        return states, status if len(calls) <= 2 else status + 2, iterations, cost

    monkeypatch.setattr("lio_jax.fusion.tune.search", failing)
    found = tune(problem, start, states, names, trials=4)
    values = [one["negative_log_likelihood"] for one in found.history]
    assert np.isfinite(values[0])
    assert len(values) > 1
    assert np.isnan(values[1:]).all()
    assert read(found.params, names) == pytest.approx(read(start, names))
