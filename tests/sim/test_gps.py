"""The simulated GPS: noise as reported, slow errors as asked, outages, east-north-up positions."""

import math
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.sim.gps import GpsModel, simulate_gps
from lio_jax.sim.trajectory import motion_along, pose_at
from tests.sim.routes import LAP

HOUR = 3600.0
WHITE = GpsModel(multipath=0.0)


@pytest.fixture(scope="module")
def drive():
    return motion_along(LAP, duration_s=HOUR)


@pytest.fixture(scope="module")
def errors_of(drive):
    def errors(data):
        times = jnp.asarray(data.stamp_ns * 1e-9)
        return data.position - np.asarray(positions(times))

    positions = jax.jit(jax.vmap(lambda t: pose_at(drive, t).translation()))
    return errors


def test_white_noise_is_what_the_covariance_says(drive, errors_of):
    data = simulate_gps(drive, WHITE, HOUR, seed=0)
    assert len(data.stamp_ns) == 18_001
    assert data.stamp_ns[-1] == 3_600_000_000_000
    errors = errors_of(data)
    np.testing.assert_allclose(np.std(errors, axis=0), WHITE.noise, rtol=0.02)
    np.testing.assert_allclose(data.covariance[7], np.diag(np.square(WHITE.noise)))
    distance = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(data.covariance), errors)
    assert np.mean(distance) / 3 == pytest.approx(1, abs=0.02)
    assert data.origin == WHITE.origin


def test_multipath_wanders_slowly(drive, errors_of):
    model = GpsModel(noise=(1e-6, 1e-6, 1e-6), multipath=2.0, multipath_time=10.0)
    errors = errors_of(simulate_gps(drive, model, HOUR, seed=0))
    # 3600 s hold 180 independent values of each axis (correlation twice the time constant)
    np.testing.assert_allclose(np.std(errors, axis=0), [2, 2, 4], rtol=0.2)
    for lag in (5, 25, 50):
        found = np.mean(errors[lag:] * errors[:-lag]) / np.mean(errors**2)
        assert found == pytest.approx(math.exp(-lag / 50), abs=0.12)


def test_outages_take_their_share(drive):
    model = replace(WHITE, outage_every=60.0, outage_length=20.0)
    data = simulate_gps(drive, model, HOUR, seed=0)
    gaps = np.diff(data.stamp_ns) * 1e-9
    assert len(data.stamp_ns) / 18_001 == pytest.approx(0.75, abs=0.12)
    assert 25 < np.sum(gaps > 0.25) < 65
    everywhere = simulate_gps(drive, WHITE, HOUR, seed=0)
    kept = np.isin(everywhere.stamp_ns, data.stamp_ns)
    np.testing.assert_array_equal(everywhere.position[kept], data.position)


def test_a_longer_recording_begins_the_same(drive):
    model = GpsModel(outage_every=60.0)
    longer, shorter = (
        simulate_gps(drive, model, duration, seed=3, start_ns=7) for duration in (300.0, 120.0)
    )
    count = len(shorter.stamp_ns)
    assert 100 < count < len(longer.stamp_ns)
    np.testing.assert_array_equal(longer.stamp_ns[:count], shorter.stamp_ns)
    np.testing.assert_array_equal(longer.position[:count], shorter.position)
    assert shorter.stamp_ns[0] == 7


def test_the_seed_decides(drive):
    same, again, other = (simulate_gps(drive, GpsModel(), 10.0, seed) for seed in (0, 0, 1))
    assert same.position.tobytes() == again.position.tobytes()
    assert not np.array_equal(same.position, other.position)


def test_numbers_do_not_depend_on_the_x64_mode(drive):
    with jax.enable_x64(False):
        single = simulate_gps(drive, GpsModel(), 10.0, seed=0)
    np.testing.assert_array_equal(single.position, simulate_gps(drive, GpsModel(), 10.0, seed=0).position)


def test_no_duration_is_refused(drive):
    with pytest.raises(UsageError, match="duration of 0 s holds no fixes"):
        simulate_gps(drive, WHITE, 0, seed=0)


def test_an_impossible_rate_is_refused(drive):
    with pytest.raises(UsageError, match=r"gps\.rate: -5"):
        simulate_gps(drive, replace(WHITE, rate=-5.0), 1.0, seed=0)


def test_impossible_noise_is_refused(drive):
    with pytest.raises(UsageError, match=r"noise .* must be greater than zero"):
        simulate_gps(drive, replace(WHITE, noise=(0.0, 1.0, 1.0)), 1.0, seed=0)
