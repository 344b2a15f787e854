"""Allan deviation against allantools, noise densities against simulated noise."""

import numpy as np
import pytest

from lio_jax.imu.allan import (
    NoiseFit,
    allan_deviation,
    averaging_factors,
    fit_noise,
    noise_in_motion,
)
from tests.shared_data import SHARED_DATA, needs_shared

RATE = 50.0


def simulated(seconds: float, white: float, walk: float, columns: int = 3, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    count = round(seconds * RATE)
    bias = np.cumsum(rng.normal(0, walk / RATE**0.5, (count, columns)), axis=0)
    return bias + rng.normal(0, white * RATE**0.5, (count, columns))


def fitted(samples: np.ndarray) -> list[NoiseFit]:
    factors = averaging_factors(len(samples))
    deviation = allan_deviation(samples, 1 / RATE, factors)
    duration = len(samples) / RATE
    return [fit_noise(factors / RATE, column, duration) for column in deviation.T]


def test_deviation_equals_allantools():
    allantools = pytest.importorskip("allantools")
    samples = simulated(100, 2e-3, 1e-3) + np.array([0.1, -9.8, 3.0])
    factors = averaging_factors(len(samples))
    ours = allan_deviation(samples, 1 / RATE, factors)
    for axis in range(3):
        taus, theirs, _, _ = allantools.oadev(
            samples[:, axis], rate=RATE, data_type="freq", taus=factors / RATE
        )
        np.testing.assert_allclose(taus, factors / RATE, rtol=1e-9)
        np.testing.assert_allclose(ours[:, axis], theirs, rtol=1e-8)


def test_two_neighbours_by_hand():
    samples = np.array([[1.0], [3.0], [2.0], [6.0]])
    by_hand = np.sqrt(np.mean([2.0**2, 1.0**2, 4.0**2]) / 2)
    assert allan_deviation(samples, 0.1, np.array([1]))[0, 0] == pytest.approx(by_hand, rel=1e-12)


def test_averaging_factors_are_dense_ascending_and_leave_nine_averages():
    factors = averaging_factors(100_000)
    assert factors[0] == 1
    assert factors[-1] == 100_000 // 9
    assert np.all(np.diff(factors) > 0)
    assert len(averaging_factors(5)) == 0


def test_white_noise_is_found_and_no_walk_is_made_up():
    for white in (2e-3, 2e-2):
        for fit in fitted(simulated(1200, white, 0.0)):
            assert fit.white == pytest.approx(white, rel=0.03)
            assert fit.walk is None


def test_both_densities_are_found_in_a_long_recording():
    fits = fitted(simulated(7200, 2e-3, 2e-4, seed=1))
    for fit in fits:
        assert fit.white == pytest.approx(2e-3, rel=0.03)
    walks = [fit.walk for fit in fits]
    assert None not in walks
    assert np.mean(walks) == pytest.approx(2e-4, rel=0.15)


def test_a_short_recording_shows_no_walk():
    assert [fit.walk for fit in fitted(simulated(60, 2e-3, 2e-5))] == [None] * 3


def test_quantisation_does_not_pass_for_white_noise():
    step = 5e-3
    samples = np.round(simulated(1200, 2e-4, 0.0) / step + 0.3 * np.sin(np.arange(60_000))[:, None]) * step
    clean = fitted(simulated(1200, 2e-4, 0.0))[0].white
    assert fitted(samples)[0].quantisation > 0
    assert clean == pytest.approx(2e-4, rel=0.03)


def test_vibration_at_one_frequency_does_not_spoil_the_white_noise():
    samples = simulated(2400, 2e-3, 0.0)
    samples += 5e-3 * np.sin(2 * np.pi * 11.0 * np.arange(len(samples)) / RATE)[:, None]
    for fit in fitted(samples):
        assert fit.white == pytest.approx(2e-3, rel=0.1)


def test_the_fitted_curve_follows_the_deviation():
    samples = simulated(3600, 2e-3, 2e-4, columns=1)
    factors = averaging_factors(len(samples))
    deviation = allan_deviation(samples, 1 / RATE, factors)[:, 0]
    tau = factors / RATE
    fit = fit_noise(tau, deviation, 3600.0)
    early = tau < 30
    np.testing.assert_allclose(fit.deviation(tau)[early], deviation[early], rtol=0.1)


def test_a_dead_axis_has_no_noise():
    fit = fitted(np.zeros((3000, 1)))[0]
    assert (fit.white, fit.walk, fit.flicker, fit.quantisation) == (0.0, None, 0.0, 0.0)


def driven(rate: float, seconds: float, density: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Return stamps and samples of white noise on the turns of a walk and the hum of a motor."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(rate * seconds)) / rate
    steps = np.stack([np.sin(2 * np.pi * f * time + f) for f in (0.3, 1.1, 2.0)], axis=1)
    return time, 1.0 + 0.5 * steps + rng.normal(0, density * rate**0.5, (len(time), 3))


@pytest.mark.parametrize("rate", [100.0, 200.0, 1000.0])
@pytest.mark.parametrize("density", [2e-3, 2e-2])
def test_noise_is_found_in_motion(rate, density):
    assert noise_in_motion(*driven(rate, 30.0, density)) == pytest.approx(density, rel=0.1)


def test_gaps_and_a_short_shock_do_not_count():
    time, samples = driven(200.0, 30.0, 2e-3)
    samples[2000:2400] += np.random.default_rng(1).normal(0, 20.0, (400, 3))
    kept = (time < 7.0) | (time > 9.5)
    assert noise_in_motion(time[kept], samples[kept]) == pytest.approx(2e-3, rel=0.15)


def test_no_noise_is_told_of_slow_or_few_samples():
    assert noise_in_motion(*driven(10.0, 60.0, 2e-3)) is None
    assert noise_in_motion(*driven(200.0, 2.0, 2e-3)) is None
    assert noise_in_motion(np.zeros(1), np.zeros((1, 3))) is None


@needs_shared
def test_noise_of_a_real_sensor_at_rest_is_that_of_its_allan_deviation():
    gyro = np.radians(
        np.load(SHARED_DATA / "imu_static" / "adis16405_unit1.npz")["gyro_dps"][:60_000].astype(np.float64)
    )
    factors = averaging_factors(len(gyro))
    deviation = allan_deviation(gyro, 0.01, factors)
    by_allan = [fit_noise(factors * 0.01, column, 600.0).white for column in deviation.T]
    found = noise_in_motion(np.arange(len(gyro)) * 0.01, gyro)
    assert found == pytest.approx(np.sqrt(np.mean(np.square(by_allan))), rel=0.2)
