"""A long recording is looked at in windows, a large bag only there."""

import numpy as np
import pytest

from lio_jax.data.config import DataConfig
from lio_jax.data.rosbag import RosbagSequence
from lio_jax.inspection import inspect_sequence, sampling
from lio_jax.inspection.sampling import WINDOW_SCANS, sampled
from tests.data import bags
from tests.data.bag_recordings import FORMATS, imu_messages, in_order


def long_bag(path, count=60):
    ros2 = bags.is_ros2(path)
    messages = in_order(bags.velodyne_messages(count, ros2) + imu_messages(10 * count, ros2))
    return RosbagSequence(bags.write_bag(path, messages), DataConfig())


@pytest.mark.parametrize("name", FORMATS)
def test_parts_of_a_bag_hold_what_was_received_in_them(tmp_path, name):
    bag = long_bag(tmp_path / name, 20)
    scans = list(bag.scans())
    contents = bag.contents()
    middle = (contents.start_ns + contents.end_ns) // 2
    first, second = bag.within(contents.start_ns, middle), bag.within(middle, contents.end_ns + 1)
    stamps = [scan.stamp_ns for part in (first, second) for scan in part.scans()]
    assert stamps == [scan.stamp_ns for scan in scans]
    halves = [part.imu().stamp_ns for part in (first, second)]
    assert all(len(half) > 50 for half in halves)
    np.testing.assert_array_equal(np.concatenate(halves), bag.imu().stamp_ns)
    assert bag.info.notes == first.info.notes


def test_a_long_bag_is_looked_at_in_windows(tmp_path):
    bag = long_bag(tmp_path / "a.bag")
    look = sampled(bag)
    windows = list(look.windows())
    assert look.whole
    assert "4 windows of 12 scans were looked at, of 60 scans" in look.summary
    assert all(len(window.scans) == WINDOW_SCANS for window in windows)
    stamps = [scan.stamp_ns for window in windows for scan in window.scans]
    everything = [scan.stamp_ns for scan in bag.scans()]
    assert stamps[0] == everything[0]
    assert stamps[-1] == everything[-1]


def test_of_a_large_bag_only_parts_are_read(tmp_path, monkeypatch):
    monkeypatch.setattr(sampling, "_LARGE_BYTES", 1000)
    bag = long_bag(tmp_path / "a.bag", 300)
    found = inspect_sequence(bag)
    assert "8 parts of 2 s were looked at" in found.sampled
    first, *_, last = bag.scans()
    assert found.duration == pytest.approx((last.end_ns - first.stamp_ns) * 1e-9)
    assert found.scans == 300
    assert found.imu_samples < 2000
    assert (found.imu_gaps, found.scan_gaps) == (0, 0)
    assert found.imu_rate == 100.0


def test_windows_lie_where_the_gyroscope_is_busy():
    from lio_jax.data.sequence import ImuData

    gyro = np.zeros((4000, 3))
    gyro[1000:1100, 2] = 1.0
    imu = ImuData(np.arange(4000) * 10_000_000, gyro, np.tile([0.0, 0.0, 9.8], (4000, 1)))
    shares = sampling._shares(imu)
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert 0.25 in shares
