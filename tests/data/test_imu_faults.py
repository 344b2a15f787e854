"""Samples that do not measure the motion are found, named and dropped, and real motion is not."""

import numpy as np
import pytest

from lio_jax.data.imu_checks import cleaned
from lio_jax.data.sequence import ImuData
from lio_jax.sim.imu import ImuModel
from lio_jax.sim.sequence import SimulatedSequence
from tests.data.inertial_samples import GRAVITY, RATE, drive, replaced


def kept_rows(imu: ImuData, rows: np.ndarray) -> ImuData:
    return ImuData(imu.stamp_ns[rows], imu.gyro[rows], imu.accel[rows])


@pytest.mark.parametrize(("column", "size"), [("gyro", 2.0), ("accel", 900.0)])
def test_single_spikes_are_dropped(column, size):
    imu = drive()
    values = getattr(imu, column).copy()
    at = np.array([300, 301, 777, 1500])
    values[at, 1] += size
    result, (sentence,) = cleaned(replaced(imu, **{column: values}), "/imu")
    np.testing.assert_array_equal(result.stamp_ns, np.delete(imu.stamp_ns, at))
    name = {"gyro": "gyroscope", "accel": "accelerometer"}[column]
    assert sentence.startswith(f"/imu: 4 sample(s) of the {name} are spikes, the first at 1.500 s (")


def test_a_spike_in_each_quarter_of_a_second_is_found():
    imu = drive()
    accel = imu.accel.copy()
    at = np.arange(20, 2000, 50)
    accel[at, 2] *= 100
    result, _ = cleaned(replaced(imu, accel=accel), "/imu")
    np.testing.assert_array_equal(result.stamp_ns, np.delete(imu.stamp_ns, at))


def test_a_shock_is_kept():
    """A robot that is dropped: 2 g for 20 ms, then the body rings."""
    imu = drive()
    accel = imu.accel.copy()
    after = np.arange(200) / RATE
    accel[800:804, 2] += 2 * GRAVITY
    accel[804:1004, 2] += GRAVITY * np.exp(-after / 0.05) * np.sin(2 * np.pi * 40 * after)
    assert cleaned(replaced(imu, accel=accel), "/imu")[1] == ()


def test_vibration_is_kept():
    """As of a drone: the size of its shaking changes from sample to sample."""
    imu = drive()
    rng = np.random.default_rng(1)
    accel = imu.accel + 4 * rng.standard_normal((2000, 3)) * rng.random((2000, 1))
    gyro = imu.gyro + 0.5 * rng.standard_normal((2000, 3)) * rng.random((2000, 1))
    assert cleaned(replaced(imu, gyro=gyro, accel=accel), "/imu")[1] == ()


@pytest.mark.parametrize(("column", "axis"), [("gyro", 2), ("accel", 0)])
@pytest.mark.parametrize("end", [1400, 2000])
def test_a_stuck_axis_is_dropped(column, axis, end):
    imu = drive()
    values = getattr(imu, column).copy()
    values[1000:end, axis] = values[1000, axis]
    result, said = cleaned(replaced(imu, **{column: values}), "/imu")
    np.testing.assert_array_equal(result.stamp_ns, np.delete(imu.stamp_ns, slice(1000, end)))
    until = "the end" if end == 2000 else "7.000 s"
    assert f"{'xyz'[axis]} axis is stuck at" in said[0]
    assert f"from 5.000 s to {until} while the others move" in said[0]


def test_an_axis_that_never_moves_leaves_no_sample():
    imu = drive()
    gyro = imu.gyro.copy()
    gyro[:, 2] = 0.0
    result, said = cleaned(replaced(imu, gyro=gyro), "/imu")
    assert len(result.stamp_ns) == 0
    assert "z axis is stuck at 0 rad/s from 0.000 s to the end" in said[0]
    assert "no IMU sample is left" in said[-1]


def test_a_coarse_resolution_is_not_stuck():
    imu = drive()
    gyro = np.round(imu.gyro / 0.02) * 0.02
    assert cleaned(replaced(imu, gyro=gyro), "/imu")[1] == ()


def test_a_planar_simulator_without_noise_is_not_stuck():
    seconds = np.arange(2000) / RATE
    gyro = np.stack([np.zeros(2000), np.zeros(2000), 0.3 * np.sin(seconds)], axis=1)
    accel = np.stack([np.sin(seconds), np.cos(0.7 * seconds), np.full(2000, GRAVITY)], axis=1)
    imu = ImuData((np.arange(2000) * 5_000_000).astype(np.int64), gyro, accel)
    assert cleaned(imu, "/imu")[1] == ()


def test_a_block_that_is_sent_again_is_dropped():
    """A driver that hands on an old buffer under new stamps."""
    imu = drive()
    gyro, accel = imu.gyro.copy(), imu.accel.copy()
    gyro[1040:1080], accel[1040:1080] = gyro[1000:1040], accel[1000:1040]
    result, said = cleaned(replaced(imu, gyro=gyro, accel=accel), "/imu")
    np.testing.assert_array_equal(result.stamp_ns, np.delete(imu.stamp_ns, slice(1040, 1080)))
    assert said[0] == (
        "/imu: 40 sample(s) repeat the values of an earlier block, the first at 5.200 s: they were dropped."
    )


def test_samples_of_an_axis_at_the_end_of_a_small_range_are_dropped():
    """A gyroscope of 0.3 rad/s; the vehicle turns at up to 0.4 rad/s."""
    imu = drive()
    clipped = np.clip(imu.gyro, -0.3, 0.3)
    result, said = cleaned(replaced(imu, gyro=clipped), "/imu")
    (sentence,) = (one for one in said if "dropped" in one)
    assert "the gyroscope's z axis stays at 0.3 rad/s for" in sentence
    lost = np.isin(imu.stamp_ns, result.stamp_ns, invert=True)
    assert (np.abs(clipped[lost, 2]) == 0.3).all()
    # where the rate is near the limit, noise breaks the time up into parts that are kept
    assert lost.sum() > 0.7 * np.count_nonzero(np.abs(clipped[:, 2]) == 0.3)


def test_values_that_are_held_are_no_block():
    """Samples of 100 Hz that a driver repeats at 200 Hz."""
    imu = drive()
    held = np.arange(2000) // 2 * 2
    assert cleaned(replaced(imu, gyro=imu.gyro[held], accel=imu.accel[held]), "/imu")[1] == ()


def test_missing_samples_are_counted():
    imu = drive()
    rows = np.random.default_rng(2).random(2000) > 0.2
    result, said = cleaned(kept_rows(imu, rows), "/imu")
    assert len(result.stamp_ns) == rows.sum()
    assert any(
        "20 % of the IMU samples are missing" in one or "19 % of" in one or "21 % of" in one for one in said
    )


def test_stamps_that_jitter_miss_nothing():
    imu = drive()
    jitter = np.random.default_rng(3).integers(-2_000_000, 2_000_000, 2000)
    assert cleaned(replaced(imu, stamp_ns=imu.stamp_ns + jitter), "/imu")[1] == ()


@pytest.mark.parametrize("world", ["street", "office", "field", "stairs"])
def test_simulated_motion_is_kept(world):
    sequence = SimulatedSequence(world, duration_s=20.0, seed=5, imu=ImuModel(), standstill_s=2.0)
    imu = sequence.imu()
    result, said = cleaned(imu, "/imu")
    assert said == ()
    assert len(result.stamp_ns) == len(imu.stamp_ns)
