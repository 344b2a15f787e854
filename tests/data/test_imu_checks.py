"""Broken inertial samples are dropped or named, each by its own sentence."""

import numpy as np
import pytest

from lio_jax.data.imu_checks import cleaned, coverage
from lio_jax.data.sequence import ImuData
from tests.data.inertial_samples import EPOCH_NS, GRAVITY, RATE, drive, replaced


def test_a_good_recording_passes_untouched_and_in_silence():
    imu = drive()
    result, said = cleaned(imu, "imu.npz")
    assert said == ()
    np.testing.assert_array_equal(result.stamp_ns, imu.stamp_ns)
    np.testing.assert_array_equal(result.gyro, imu.gyro)
    np.testing.assert_array_equal(result.accel, imu.accel)


@pytest.mark.parametrize("poison", [np.nan, np.inf, -np.inf])
def test_samples_that_are_not_finite_are_dropped(poison):
    imu = drive()
    imu.gyro[300, 1] = poison
    imu.accel[301, 2] = poison
    result, said = cleaned(imu, "imu.npz")
    assert len(result.stamp_ns) == len(imu.stamp_ns) - 2
    assert np.isfinite(result.gyro).all()
    assert np.isfinite(result.accel).all()
    assert said == ("imu.npz: 2 IMU sample(s) held NaN or infinity, the first at 1.500 s, and were dropped.",)


def test_two_samples_with_one_stamp_leave_the_first():
    imu = drive()
    stamps = imu.stamp_ns.copy()
    stamps[500] = stamps[499]
    result, said = cleaned(replaced(imu, stamp_ns=stamps), "imu.npz")
    np.testing.assert_array_equal(result.gyro, np.delete(imu.gyro, 500, axis=0))
    (sentence,) = said
    assert "1 IMU sample(s) repeat a stamp, the first at 2.495 s" in sentence


def test_a_block_from_the_past_is_dropped():
    imu = drive()
    stamps = imu.stamp_ns.copy()
    stamps[500:520] -= 1_000_000_001
    result, said = cleaned(replaced(imu, stamp_ns=stamps), "imu.npz")
    np.testing.assert_array_equal(result.stamp_ns, np.delete(imu.stamp_ns, slice(500, 520)))
    backwards, gap = said
    assert "runs backwards 1 time(s), first at 2.495 s by 0.995 s: 20 sample(s) out of order" in backwards
    assert "gap(s)" in gap


def test_one_stamp_from_the_future_costs_one_sample():
    imu = drive()
    stamps = imu.stamp_ns.copy()
    stamps[500] += 3_600_000_000_000
    result, said = cleaned(replaced(imu, stamp_ns=stamps), "imu.npz")
    np.testing.assert_array_equal(result.stamp_ns, np.delete(imu.stamp_ns, 500))
    assert "runs backwards" in said[0]


def test_a_clock_set_back_for_good_keeps_what_came_before():
    imu = drive()
    stamps = imu.stamp_ns.copy()
    stamps[1000:] -= 2_000_000_001
    result, said = cleaned(replaced(imu, stamp_ns=stamps), "imu.npz")
    assert np.all(np.diff(result.stamp_ns) > 0)
    np.testing.assert_array_equal(result.stamp_ns[:1000], imu.stamp_ns[:1000])
    assert len(result.stamp_ns) == 1600
    assert "first at 4.995 s by 1.995 s: 400 sample(s)" in said[0]


def test_a_recording_played_twice_keeps_the_first_pass():
    imu = drive(2.0)
    twice = ImuData(
        np.concatenate([imu.stamp_ns, imu.stamp_ns + 1]),
        np.concatenate([imu.gyro, imu.gyro + 1]),
        np.concatenate([imu.accel, imu.accel]),
    )
    result, _ = cleaned(twice, "imu.npz")
    np.testing.assert_array_equal(result.gyro[:-1], imu.gyro[: len(result.gyro) - 1])


def test_the_longest_ascent_is_found_in_any_order():
    rng = np.random.default_rng(3)
    for _ in range(20):
        stamps = rng.integers(0, 30, 30)
        result, _ = cleaned(ImuData(stamps, np.zeros((30, 3)), np.ones((30, 3))), "x")
        best = np.ones(30, int)
        for i in range(30):
            for j in range(i):
                if stamps[j] < stamps[i]:
                    best[i] = max(best[i], best[j] + 1)
        assert len(result.stamp_ns) == best.max()
        assert np.all(np.diff(result.stamp_ns) > 0)


def test_orientation_stays_with_its_sample():
    imu = drive(2.0)
    orientation = np.tile(np.arange(400.0)[:, None], (1, 4))
    imu.gyro[7] = np.nan
    result, _ = cleaned(replaced(imu, orientation=orientation), "x")
    np.testing.assert_array_equal(result.orientation, np.delete(orientation, 7, axis=0))


def test_gaps_are_named_with_place_and_length():
    imu = drive()
    keep = np.ones(len(imu.stamp_ns), bool)
    keep[601:701] = keep[1500:1504] = False
    result, said = cleaned(ImuData(imu.stamp_ns[keep], imu.gyro[keep], imu.accel[keep]), "/imu")
    assert len(result.stamp_ns) == keep.sum()
    (sentence,) = said
    assert sentence == (
        "/imu: 1 gap(s) without IMU samples (usually one every 5.0 ms): 0.505 s at 3.000 s; scans in there "
        "are predicted with little or no inertial data. If no sample is missing, the IMU's clock jumped by "
        "that much."
    )


def test_many_gaps_are_one_sentence():
    imu = drive()
    keep = (np.arange(2000) % 100) > 10
    _, said = cleaned(ImuData(imu.stamp_ns[keep], imu.gyro[keep], imu.accel[keep]), "/imu")
    (sentence,) = said
    assert sentence.count(" s at ") == 3
    assert "and 16 more, the longest 0.060 s" in sentence


def test_accelerometer_in_g_is_converted():
    imu = drive()
    result, said = cleaned(replaced(imu, accel=imu.accel / GRAVITY), "imu.npz")
    np.testing.assert_allclose(result.accel, imu.accel, rtol=1e-12)
    assert "accelerometer in g" in said[0]


@pytest.mark.parametrize("turn", [1.0, 0.01], ids=["turning", "straight ahead"])
def test_gyro_in_degrees_is_suspected(turn):
    imu = drive()
    _, said = cleaned(replaced(imu, gyro=np.degrees(imu.gyro * [1.0, 1.0, turn])), "imu.npz")
    (sentence,) = [s for s in said if "saturated" not in s]
    assert "it is suspected that the gyroscope is in deg/s" in sentence


def test_fast_handheld_rotation_is_not_suspected():
    seconds = np.arange(2000) / RATE
    angle = 2.0 * np.sin(2.0 * seconds)  # up to 4 rad/s about x
    gyro = np.stack([4.0 * np.cos(2.0 * seconds), np.zeros(2000), np.zeros(2000)], axis=1)
    accel = GRAVITY * np.stack([np.zeros(2000), np.sin(angle), np.cos(angle)], axis=1)
    imu = ImuData(EPOCH_NS + np.arange(2000) * 5_000_000, gyro, accel)
    assert cleaned(imu, "x")[1] == ()


def test_specific_force_that_points_down_is_reported():
    imu = drive()
    _, said = cleaned(replaced(imu, accel=-imu.accel), "imu.npz")
    (sentence,) = said
    assert "points down at rest (0.0 s): -9.81 m/s^2 along the IMU's z axis" in sentence
    assert "params.extrinsics.rotation" in sentence
    assert "negated" in sentence


def test_a_calibrated_upside_down_mounting_is_fine():
    imu = drive()
    assert cleaned(replaced(imu, accel=-imu.accel), "x", np.diag([1.0, -1.0, -1.0, 1.0]))[1] == ()
    assert "lidar's z axis" in cleaned(imu, "x", np.diag([1.0, -1.0, -1.0, 1.0]))[1][0]


@pytest.mark.parametrize(("column", "limit"), [("gyro", 0.3), ("accel", 10.2)])
def test_small_values_that_repeat_are_not_saturation(column, limit):
    imu = drive()
    values = np.round(np.clip(getattr(imu, column), -limit, limit), 1)
    assert not [s for s in cleaned(replaced(imu, **{column: values}), "x")[1] if "saturated" in s]


@pytest.mark.parametrize(
    ("column", "limit", "name"), [("gyro", 2.0, "gyroscope"), ("accel", 19.6, "accelerometer")]
)
def test_saturation_is_named(column, limit, name):
    imu = drive()
    values = getattr(imu, column).copy()
    values[:, 1] += 1.5 * limit * np.sin(np.arange(2000) / RATE * 5.0)
    values[:, 1] = np.clip(values[:, 1], -limit, limit)
    said = [s for s in cleaned(replaced(imu, **{column: values}), "x")[1] if "saturated" in s]
    assert len(said) == 1
    assert f"the {name}'s y axis stays at -{limit:g} and {limit:g}" in said[0]


def test_a_recording_without_valid_samples_is_reported():
    imu = drive(1.0)
    result, said = cleaned(replaced(imu, gyro=np.full((200, 3), np.nan)), "imu.npz")
    assert len(result.stamp_ns) == 0
    assert said[-1] == "imu.npz: no IMU sample is left."
    assert len(cleaned(result, "imu.npz")[0].stamp_ns) == 0


def test_coverage_counts_the_time_offset():
    imu = drive()
    first, last = int(imu.stamp_ns[0]), int(imu.stamp_ns[-1])
    assert coverage(imu, first, last) == []
    assert coverage(imu, first - 5_000_000_000, last - 5_000_000_000, 5.0) == []
    assert "starts 5.000 s after" in coverage(imu, first - 5_000_000_000, last)[0]
    assert "ends 5.000 s before" in coverage(imu, first, last + 5_000_000_000)[0]
