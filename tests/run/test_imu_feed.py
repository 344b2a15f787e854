"""Inertial samples become one padded batch per scan."""

import jax
import numpy as np
import pytest

from lio_jax.data.sequence import ImuData, LidarScan
from lio_jax.run.scan_inputs import ImuFeed

EPOCH_NS = 1_700_000_000_000_000_000
BUCKETS = (32, 64, 128)
PERIOD_NS = 100_000_000


def recorded(seconds: np.ndarray) -> ImuData:
    """Return samples whose x rate is their own time in s."""
    count = len(seconds)
    gyro = np.stack([seconds, np.zeros(count), np.ones(count)], axis=1)
    return ImuData(
        EPOCH_NS + np.round(seconds * 1e9).astype(np.int64), gyro, np.tile([0.0, 0.0, 9.8], (count, 1))
    )


def scan_at(seconds: float, duration: float = 0.1) -> LidarScan:
    return LidarScan(
        stamp_ns=EPOCH_NS + round(seconds * 1e9),
        points=np.zeros((1, 3), np.float32),
        time=np.zeros(1, np.float32),
        ring=np.zeros(1, np.int32),
        intensity=np.zeros(1, np.float32),
        duration=duration,
    )


STEADY = recorded(np.arange(0, 20, 0.005))


def times(feed: ImuFeed, scan: LidarScan, last_end_ns: int | None) -> np.ndarray:
    batch = feed.batch(scan, last_end_ns)
    return np.asarray(batch.time)[np.asarray(batch.mask)]


def test_samples_reach_from_the_last_end_to_this_end_with_one_neighbour_each():
    scan = scan_at(5.0021)
    covered = times(ImuFeed(STEADY, BUCKETS, margin_s=0.0), scan, EPOCH_NS + 4_952_100_000)
    np.testing.assert_allclose(covered + 5.0021, np.arange(4.950, 5.1051, 0.005), atol=1e-9)


def test_a_sample_exactly_at_an_end_is_neighbour_enough():
    covered = times(ImuFeed(STEADY, BUCKETS, margin_s=0.0), scan_at(5.0), None)
    np.testing.assert_allclose(covered + 5.0, np.arange(5.0, 5.1001, 0.005), atol=1e-9)


def test_first_scan_is_covered_from_its_start():
    covered = times(ImuFeed(STEADY, BUCKETS, margin_s=0.0), scan_at(5.001), None)
    assert covered[0] == pytest.approx(-0.001, abs=1e-9)


def test_margin_holds_samples_for_an_offset_that_drifts():
    covered = times(ImuFeed(STEADY, BUCKETS), scan_at(5.001), None)
    assert covered[0] <= -0.05
    assert covered[-1] >= 0.15
    assert len(covered) == 42


def test_scans_that_overlap_are_covered_whole():
    scan = scan_at(5.001)
    covered = times(ImuFeed(STEADY, BUCKETS, margin_s=0.0), scan, scan.stamp_ns + 40_000_000)
    assert covered[0] <= 0


def test_rows_belong_together_and_time_is_on_the_imus_clock():
    feed = ImuFeed(STEADY, BUCKETS, time_offset=3.0)
    batch = feed.batch(scan_at(5.001), None)
    mask = np.asarray(batch.mask)
    np.testing.assert_allclose(
        np.asarray(batch.gyro)[mask, 0], np.asarray(batch.time)[mask] + 5.001, atol=1e-9
    )
    assert np.asarray(batch.time)[mask][0] == pytest.approx(3.0 - 0.051, abs=1e-9)
    np.testing.assert_array_equal(np.asarray(batch.accel)[:, 2], 9.8)


def test_stamps_of_today_keep_their_nanoseconds():
    imu = ImuData(EPOCH_NS + np.array([0, 17, 5_000_017]), np.zeros((3, 3)), np.zeros((3, 3)))
    covered = times(ImuFeed(imu, BUCKETS, margin_s=0.0), scan_at(0.0, 1e-3), None)
    np.testing.assert_allclose(covered, [0, 17e-9, 5_000_017e-9], rtol=1e-12)


@pytest.mark.parametrize(("rate", "size"), [(200, 32), (400, 64), (1000, 128)])
def test_smallest_size_that_holds_the_samples(rate, size):
    feed = ImuFeed(recorded(np.arange(0, 2, 1 / rate)), BUCKETS, margin_s=0.0)
    assert feed.batch(scan_at(1.0), None).mask.shape == (size,)


def test_padding_repeats_the_last_sample_and_is_masked():
    batch = ImuFeed(STEADY, BUCKETS, margin_s=0.0).batch(scan_at(5.001), None)
    mask = np.asarray(batch.mask)
    assert 0 < mask.sum() < 32
    assert np.all(np.diff(mask.astype(int)) <= 0)
    np.testing.assert_array_equal(np.asarray(batch.time)[~mask], np.asarray(batch.time)[mask][-1])
    assert np.isfinite(np.asarray(batch.gyro)).all()


def test_too_many_samples_are_thinned_evenly_and_said():
    feed = ImuFeed(recorded(np.arange(0, 20, 0.001)), BUCKETS)
    covered = times(feed, scan_at(15.0), EPOCH_NS + 10_000_000_000)
    assert len(covered) == 128
    assert (covered[0], covered[-1]) == (pytest.approx(-5.05), pytest.approx(0.15))
    assert np.ptp(np.diff(covered)) < 2e-3
    assert any("more than 128 IMU samples" in s and "config.imu.buckets" in s for s in feed.warnings())


def test_dtype_follows_double_precision():
    assert ImuFeed(STEADY, BUCKETS).batch(scan_at(5.0), None).time.dtype == np.float64
    with jax.enable_x64(False):
        batch = ImuFeed(STEADY, BUCKETS).batch(scan_at(5.0), None)
    assert {leaf.dtype for leaf in (batch.time, batch.gyro, batch.accel)} == {np.dtype(np.float32)}


@pytest.mark.parametrize("imu", [None, recorded(np.zeros(0))], ids=["none", "empty"])
def test_without_samples_everything_is_masked_and_said(imu):
    feed = ImuFeed(imu, BUCKETS)
    batch = feed.batch(scan_at(5.0), None)
    assert batch.mask.shape == (32,)
    assert not np.any(batch.mask)
    assert not np.any(feed.before(scan_at(5.0)).mask)
    assert feed.warnings() == ["the recording holds no IMU samples: constant velocity predicts the motion."]


def test_full_coverage_is_not_worth_a_word():
    feed = ImuFeed(STEADY, BUCKETS)
    for number in range(10, 20):
        scan = scan_at(number * 0.1)
        feed.batch(scan, None)
    assert feed.warnings() == []


def test_a_gap_of_some_tenths_of_a_second_is_bridged():
    seconds = np.concatenate([np.arange(0, 5, 0.005), np.arange(5.3, 10, 0.005)])
    covered = times(ImuFeed(recorded(seconds), BUCKETS, margin_s=0.0), scan_at(5.1), EPOCH_NS + 5_100_000_000)
    np.testing.assert_allclose(covered, [4.995 - 5.1, 5.3 - 5.1], atol=1e-9)


def test_the_line_between_its_ends_bridges_a_longer_gap_where_a_recipe_wants_it():
    seconds = np.concatenate([np.arange(0, 5, 0.005), np.arange(8, 10, 0.005)])
    feed = ImuFeed(recorded(seconds), BUCKETS, margin_s=0.0, bridge_s=5.0)
    for at in (5.1, 6.4, 7.9):
        covered = times(feed, scan_at(at), EPOCH_NS + round(at * 1e9))
        np.testing.assert_allclose(covered, [4.995 - at, 8.0 - at], atol=1e-6)
    assert feed.warnings() == []


def test_inside_a_long_gap_there_is_nothing_to_go_by():
    seconds = np.concatenate([np.arange(0, 5, 0.005), np.arange(10.5, 12, 0.005)])
    feed = ImuFeed(recorded(seconds), BUCKETS, bridge_s=5.0)
    assert len(times(feed, scan_at(6.4), EPOCH_NS + 6_400_000_000)) == 0
    assert len(times(feed, scan_at(5.1), EPOCH_NS + 5_100_000_000)) == 1
    assert any("1 of 2 scans have no IMU sample within 0.2 s" in s for s in feed.warnings())


def test_late_start_and_early_end_are_said():
    feed = ImuFeed(recorded(np.arange(1, 3, 0.005)), BUCKETS)
    last_end_ns = None
    for number in range(50):
        scan = scan_at(number * 0.1)
        batch = feed.batch(scan, last_end_ns)
        assert np.isfinite(np.asarray(batch.time)).all()
        last_end_ns = scan.end_ns
    late, early, without = feed.warnings()
    assert "starts 1.000 s after the first scan" in late
    assert "ends 2.005 s before the last scan" in early
    assert "of 50 scans have no IMU sample" in without


def test_clocks_that_share_no_instant_are_said_with_the_offset_that_joins_them():
    feed = ImuFeed(STEADY, BUCKETS, time_offset=1.0)
    feed.batch(scan_at(100.0), None)
    assert "params.extrinsics.time_offset=-100.000" in feed.warnings()[0]
    joined = ImuFeed(STEADY, BUCKETS, time_offset=-100.0)
    assert len(times(joined, scan_at(100.0), None)) > 20
    assert not [sentence for sentence in joined.warnings() if "overlap" in sentence]


def test_samples_before_the_first_scan_serve_a_start_at_rest():
    batch = ImuFeed(STEADY, (32, 256)).before(scan_at(5.0), 1.0)
    covered = np.asarray(batch.time)[np.asarray(batch.mask)]
    assert len(covered) == 200
    assert (covered[0], covered[-1]) == (pytest.approx(-0.9), pytest.approx(0.095))


def test_a_recording_that_begins_with_the_scan_has_only_the_scans_samples_before_its_end():
    batch = ImuFeed(STEADY, (32, 256)).before(scan_at(0.0), 1.0)
    assert np.asarray(batch.mask).sum() == 20
