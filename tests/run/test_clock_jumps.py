"""Jumps of the IMU's clock are told from missing samples by the scans, and taken out."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest

from lio_jax.data.sequence import ImuData
from lio_jax.run.clock_jumps import clock_steps
from lio_jax.run.run import imu_feed, settings_for
from lio_jax.settings.settings import recipe_settings
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence

AT_S = 8.0


@cache
def drive():
    sequence = SimulatedSequence("city", duration_s=14.0, seed=3, imu=ImuModel(), beams=16, columns=512)
    return sequence, list(sequence.scans())


def fed(imu):
    """Return the samples that a run of the drive uses when its samples are others, and the sentences."""
    sequence, scans = drive()
    replayed = SimpleNamespace(
        info=sequence.info,
        scans=lambda first=0, count=100: iter(scans[first : first + count]),
        imu=lambda: imu,
        warnings_so_far=(),
    )
    settings, _ = settings_for(replayed, recipe_settings("default"))
    feed, sentences = imu_feed(replayed, settings)
    return feed.samples, sentences


def seconds(imu):
    return (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9


def part(imu, kept):
    return ImuData(imu.stamp_ns[kept], imu.gyro[kept], imu.accel[kept])


@pytest.mark.parametrize("size", [0.02, 0.4, -0.2])
def test_a_jump_is_taken_out_and_named(size):
    imu = drive()[0].imu()
    late = seconds(imu) >= AT_S
    used, sentences = fed(replace(imu, stamp_ns=imu.stamp_ns + np.where(late, round(size * 1e9), 0)))
    # the interval at the jump is known to the jitter of the stamps
    np.testing.assert_allclose(used.stamp_ns - imu.stamp_ns, 0.0, atol=1e5)
    (sentence,) = (one for one in sentences if "as the scans show" in one)
    assert f"jumped by {size:+.3f} s at 7.9" in sentence


def test_a_second_jump_back_is_taken_out_too():
    imu = drive()[0].imu()
    between = (seconds(imu) >= 6.0) & (seconds(imu) < 9.0)
    used, sentences = fed(replace(imu, stamp_ns=imu.stamp_ns + np.where(between, round(0.3e9), 0)))
    np.testing.assert_allclose(used.stamp_ns - imu.stamp_ns, 0.0, atol=1e5)
    assert sum("as the scans show" in one for one in sentences) == 2


@pytest.mark.parametrize("size", [0.02, 0.4])
def test_missing_samples_are_no_jump(size):
    imu = drive()[0].imu()
    kept = (seconds(imu) < AT_S) | (seconds(imu) > AT_S + size)
    used, sentences = fed(part(imu, kept))
    np.testing.assert_array_equal(used.stamp_ns, imu.stamp_ns[kept])
    assert not any("as the scans show" in one for one in sentences)


def test_a_block_that_is_sent_again_and_many_gaps_are_no_steps():
    imu = drive()[0].imu()
    assert clock_steps(imu) == []
    order = np.concatenate([np.arange(400), np.arange(360, len(imu.stamp_ns))])
    assert clock_steps(part(imu, order)) == []
    kept = np.random.default_rng(0).random(len(imu.stamp_ns)) > 0.2
    assert clock_steps(part(imu, kept)) == []
    (step,) = clock_steps(part(imu, np.r_[0:400, 420 : len(imu.stamp_ns)]))
    assert step.after == 399
    assert step.size_ns == pytest.approx(0.1e9, rel=0.01)
