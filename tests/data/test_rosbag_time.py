"""When a bag's points were measured, and the order of its scans."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data.rosbag import RosbagSequence
from tests.data import bags
from tests.data.bag_recordings import AUTO, SEEN, cloud_messages, received, scan_starts


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
