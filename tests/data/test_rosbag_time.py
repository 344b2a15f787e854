"""When a bag's points were measured, and the order of its scans."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.rosbag import RosbagSequence
from tests.data import bags
from tests.data.bag_recordings import (
    AUTO,
    SEEN,
    cloud_messages,
    imu_messages,
    in_order,
    received,
    scan_starts,
)


def test_duplicate_and_backward_stamps_are_left_out(tmp_path: Path) -> None:
    messages = [
        (
            "/points",
            received(bags.START_NS) + place,
            bags.cloud_message(stamp, bags.fill(bags.VELODYNE, SEEN, SEEN.time)),
        )
        for place, stamp in enumerate([scan_starts(5)[k] for k in (0, 1, 1, 3, 2, 4)])
    ]
    sequence = RosbagSequence(bags.write_bag(tmp_path / "a.mcap", messages), replace(AUTO, stamp_at="start"))
    assert [scan.stamp_ns for scan in sequence.scans()] == [scan_starts(5)[k] for k in (0, 1, 3, 4)]
    assert len(sequence.warnings_so_far) == 2
    assert "scan 2 has the same stamp" in sequence.warnings_so_far[0]
    assert "scan 4" in sequence.warnings_so_far[1]
    assert "out of order" in sequence.warnings_so_far[1]


def test_a_time_field_with_a_single_value_is_as_good_as_none(tmp_path: Path) -> None:
    cloud = bags.fill(bags.VELODYNE, SEEN, np.zeros(len(SEEN.time)))
    path = bags.write_bag(tmp_path / "a.bag", cloud_messages(tmp_path / "a.bag", [cloud] * 3))
    sequence = RosbagSequence(path, AUTO)
    assert "field 'time' holds a single value, reconstructed from azimuth" in sequence.info.notes[0]
    assert next(sequence.scans()).time.max() > 0.09


def test_compensated_points_have_no_duration(tmp_path: Path) -> None:
    path = bags.write_bag(tmp_path / "a.bag", bags.velodyne_messages(2, ros2=False))
    sequence = RosbagSequence(path, replace(AUTO, compensated="yes"))
    assert "motion compensated" in sequence.info.notes[0]
    scan = next(sequence.scans())
    assert scan.duration == 0.0
    assert scan.stamp_ns == bags.START_NS
    assert not scan.time.any()


def test_impossible_times_do_not_stretch_the_scan(tmp_path: Path) -> None:
    clouds = [bags.fill(bags.HESAI, SEEN, stamp * 1e-9 + SEEN.time) for stamp in scan_starts(4)]
    clouds[2]["timestamp"][5] = 0.0
    sequence = RosbagSequence(
        bags.write_bag(tmp_path / "a.bag", cloud_messages(tmp_path / "a.bag", clouds)), AUTO
    )
    scans = list(sequence.scans())
    assert [len(scan.points) for scan in scans] == [1440, 1440, 1439, 1440]
    assert all(scan.duration < 0.1 for scan in scans)
    assert sequence.warnings_so_far == ("a.bag: scan 2: 1 points with impossible times were dropped.",)


def test_times_can_be_overridden(tmp_path: Path) -> None:
    path = bags.write_bag(tmp_path / "a.bag", bags.velodyne_messages(3, ros2=False))
    late = RosbagSequence(path, replace(AUTO, stamp_at="end"))
    first = next(late.scans())
    assert first.end_ns == pytest.approx(bags.START_NS, abs=2)
    with pytest.raises(LioJaxError, match=r"a.bag: topic /points: config.data.time_field='t' is not a field"):
        RosbagSequence(path, replace(AUTO, time_field="t"))


def _with_imu_clock(path: Path, difference_ns: int) -> Path:
    """Write a bag whose IMU's stamps are late or early, although its messages arrive with the scans."""
    ros2 = bags.is_ros2(path)
    samples = [
        (topic, stamp, bags.imu_message(stamp + difference_ns, ros2, accel=(0.0, 0.0, 9.8)))
        for topic, stamp, _ in imu_messages(100, ros2)
    ]
    clouds = cloud_messages(path, [bags.fill(bags.VELODYNE, SEEN, SEEN.time)] * 8)
    return bags.write_bag(path, in_order(clouds + samples))


@pytest.mark.parametrize("difference_s", [-1.7e9, -2.5, 40.0])
@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_clocks_that_differ_by_more_than_a_second_are_aligned_if_asked_for(
    tmp_path: Path, name: str, difference_s: float
) -> None:
    difference = int(difference_s * 1e9)
    path = _with_imu_clock(tmp_path / name, difference)
    as_they_are = RosbagSequence(path, AUTO).imu()
    aligned = RosbagSequence(path, replace(AUTO, align_clocks=True))
    imu = aligned.imu()
    assert as_they_are is not None
    assert imu is not None
    assert as_they_are.stamp_ns[0] == bags.START_NS + difference
    # a scan is received 3 ms after its end, and a sample every 10 ms
    assert abs(imu.stamp_ns[0] - bags.START_NS) < 15_000_000
    np.testing.assert_array_equal(np.diff(imu.stamp_ns), np.diff(as_they_are.stamp_ns))
    assert any("were added to its stamps, to align the clocks" in note for note in aligned.info.notes)


def test_clocks_that_differ_by_less_stay_as_they_are(tmp_path: Path) -> None:
    path = _with_imu_clock(tmp_path / "a.bag", 900_000_000)
    sequence = RosbagSequence(path, replace(AUTO, align_clocks=True))
    imu = sequence.imu()
    assert imu is not None
    assert imu.stamp_ns[0] == bags.START_NS + 900_000_000
    assert not any("clocks" in note for note in sequence.info.notes)
