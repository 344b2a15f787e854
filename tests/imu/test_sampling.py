"""Cutting a span at the samples: exact ends, held samples, gaps, and rows that are not there."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.types import ImuBatch
from lio_jax.imu.sampling import LONGEST_GAP, sample_intervals
from tests.imu.motion import quick_jit

SLOPE = np.array([1.0, -2.0, 0.5])


def line(times: list[float]) -> ImuBatch:
    time = jnp.asarray(times)
    return ImuBatch(
        time=time,
        gyro=time[:, None] * SLOPE + 1,
        accel=-time[:, None] * SLOPE + 2,
        mask=jnp.ones(len(times), bool),
    )


intervals_of = quick_jit(sample_intervals)


def sampled(imu: ImuBatch, start: float, end: float, offset: float = 0.0):
    return intervals_of(imu, jnp.asarray(offset), jnp.asarray(start), jnp.asarray(end))


def integral(intervals) -> np.ndarray:
    return np.asarray(jnp.sum(intervals.gyro * intervals.duration[:, None], axis=0))


@quick_jit
def derivatives(offset, imu, start):
    def total(offset):
        intervals = sample_intervals(imu, offset, start, jnp.asarray(0.025))
        return jnp.sum(intervals.gyro * intervals.duration[:, None], axis=0)

    return jax.jacfwd(total)(offset), jax.jacrev(total)(offset)


def of_line(start: float, end: float) -> np.ndarray:
    return SLOPE * (end**2 - start**2) / 2 + (end - start)


TIMES = [-0.013, -0.004, 0.001, 0.009, 0.021, 0.03]


@pytest.mark.parametrize(("start", "end"), [(-0.01, 0.025), (-0.004, 0.021), (0.002, 0.003), (0.01, 0.01)])
def test_a_linear_signal_is_integrated_exactly(start: float, end: float) -> None:
    intervals = sampled(line(TIMES), start, end)
    np.testing.assert_allclose(integral(intervals), of_line(start, end), atol=1e-16)
    np.testing.assert_allclose(jnp.sum(intervals.duration), end - start, atol=1e-16)
    assert bool(jnp.all(intervals.duration >= 0))
    assert bool(jnp.all(intervals.known))


def test_the_time_offset_shifts_the_imus_clock_to_the_lidars() -> None:
    intervals = sampled(line(TIMES), -0.01, 0.02, offset=0.003)
    np.testing.assert_allclose(integral(intervals), of_line(-0.007, 0.023), atol=1e-16)


def test_the_nearest_sample_is_held_outside() -> None:
    imu = line([0.01, 0.02])
    intervals = sampled(imu, 0.0, 0.03)
    expected = 0.01 * (np.asarray(imu.gyro[0]) + np.asarray(imu.gyro[1])) + of_line(0.01, 0.02)
    np.testing.assert_allclose(integral(intervals), expected, atol=1e-16)


def test_order_masked_and_broken_rows_change_nothing() -> None:
    plain = sampled(line(TIMES), -0.01, 0.025)
    imu = line([0.5, *reversed(TIMES), 0.001, 0.004, 0.006])
    imu = dataclasses.replace(
        imu,
        mask=imu.mask.at[0].set(False).at[7].set(False),
        gyro=imu.gyro.at[7].set(jnp.nan).at[8, 1].set(jnp.nan),
        accel=imu.accel.at[9, 2].set(jnp.inf),
    )
    shuffled = sampled(imu, -0.01, 0.025)
    np.testing.assert_allclose(integral(shuffled), integral(plain), atol=1e-16)
    assert bool(jnp.all(jnp.isfinite(shuffled.accel)))


def test_two_samples_with_one_stamp_leave_no_nan() -> None:
    intervals = sampled(line([0.0, 0.01, 0.01, 0.02]), 0.01, 0.02)
    np.testing.assert_allclose(integral(intervals), of_line(0.01, 0.02), atol=1e-16)


def test_without_samples_nothing_is_measured() -> None:
    imu = line(TIMES)
    intervals = sampled(dataclasses.replace(imu, mask=jnp.zeros(6, bool)), 0.0, 0.1)
    assert not bool(intervals.measured)
    assert not bool(jnp.any(intervals.known[intervals.duration > 0]))
    np.testing.assert_array_equal(intervals.accel, 0)
    np.testing.assert_allclose(jnp.sum(intervals.duration), 0.1)


@pytest.mark.parametrize(("shift", "measured"), [(0.9 * LONGEST_GAP, True), (1.1 * LONGEST_GAP, False)])
def test_a_sample_is_not_held_for_long(shift: float, measured: bool) -> None:
    late = sampled(line([0.0]), shift, shift + 0.01)
    early = sampled(line([0.0]), -shift - 0.01, -shift)
    assert bool(late.measured) is measured
    assert bool(early.measured) is measured


def test_a_gap_is_bridged_but_not_known() -> None:
    intervals = sampled(line([-0.01, 0.0, 0.5, 0.51]), 0.1, 0.2)
    assert bool(intervals.measured)
    np.testing.assert_allclose(integral(intervals), of_line(0.1, 0.2), atol=1e-15)
    assert not bool(jnp.any(intervals.known[intervals.duration > 0]))


@pytest.mark.parametrize("start", [-0.01, -0.004])
def test_derivative_by_the_offset(start: float) -> None:
    """Also where a sample lies exactly on the start, on both sides of which other rows are in use."""
    rng = np.random.default_rng(0)
    imu = dataclasses.replace(line(TIMES), gyro=jnp.asarray(rng.normal(size=(6, 3))))
    step = 1e-7
    high, low = (integral(sampled(imu, start, 0.025, offset)) for offset in (step, -step))
    forward, backward = derivatives(jnp.asarray(0.0), imu, jnp.asarray(start))
    np.testing.assert_allclose(forward, (high - low) / (2 * step), atol=1e-5)
    np.testing.assert_allclose(backward, forward, atol=1e-12)
