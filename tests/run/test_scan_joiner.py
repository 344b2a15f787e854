"""Pushed messages are joined as those of a bag are."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.sequence import LidarScan
from lio_jax.run.pushed import ScanJoiner
from tests.data import bags, part_recordings
from tests.data.bag_recordings import AUTO
from tests.data.part_recordings import firings, parts, recorded, scans_of

FIFTH_NS = bags.PERIOD_NS // 5


def pushed(joiner: ScanJoiner, messages: Iterable[LidarScan]) -> list[LidarScan]:
    scans = [scan for message in messages for scan in joiner.push(message)]
    return scans + joiner.finish()


def check_same(scans: list[LidarScan], expected: list[LidarScan]) -> None:
    assert len(scans) == len(expected)
    for scan, read in zip(scans, expected, strict=True):
        assert scan.stamp_ns == read.stamp_ns
        np.testing.assert_array_equal(scan.points, read.points)
        np.testing.assert_array_equal(scan.ring, read.ring)
        np.testing.assert_array_equal(scan.intensity, read.intensity)
        np.testing.assert_allclose(scan.time, read.time, rtol=0.0, atol=1.6e-8)


def test_pushed_parts_become_the_scans_of_a_bag(tmp_path: Path) -> None:
    """Messages 20 and 21 are lost, the first sweep lacks its first message."""
    seen = firings(turns=15)
    cut = parts(seen, FIFTH_NS)
    del cut[20:22], cut[0]
    messages = recorded(seen, cut, FIFTH_NS, part_recordings.velodyne)
    read = RosbagSequence(bags.write_bag(tmp_path / "a.db3", messages), AUTO)
    joiner = ScanJoiner()
    check_same(pushed(joiner, scans_of(seen, cut, FIFTH_NS)), list(read.scans()))
    (note,) = joiner.notes
    assert note in read.info.notes


def test_a_scan_comes_with_the_first_message_of_the_next(tmp_path: Path) -> None:
    seen = firings(turns=15)
    joiner = ScanJoiner()
    counts = [len(joiner.push(message)) for message in scans_of(seen, parts(seen, FIFTH_NS), FIFTH_NS)]
    # the first second shows what a sweep is
    assert sum(counts[:51]) == 0
    assert counts[51] == 10
    assert np.flatnonzero(counts[52:]).tolist() == [3, 8, 13, 18]
    assert len(joiner.finish()) == 1


def test_repeated_and_late_messages_are_left_out() -> None:
    seen = firings(turns=15)
    messages = scans_of(seen, parts(seen, FIFTH_NS), FIFTH_NS)
    expected = pushed(ScanJoiner(), messages)
    check_same(pushed(ScanJoiner(), [*messages[:60], messages[59], messages[30], *messages[60:]]), expected)


def test_messages_without_times() -> None:
    """A program that knows no times of points gives messages without a duration."""
    seen = firings(turns=15)
    messages = scans_of(seen, parts(seen, FIFTH_NS), FIFTH_NS)
    bare = [
        LidarScan(one.stamp_ns, one.points, np.zeros_like(one.time), one.ring, one.intensity, 0.0)
        for one in messages
    ]
    scan = pushed(ScanJoiner(), bare)[4]
    np.testing.assert_allclose(scan.time, seen.since_ns[: 360 * 16] * 1e-9, atol=1e-6)


@pytest.mark.parametrize("number", [0, 1])
def test_whole_scans_are_handed_on_as_they_are(number: int) -> None:
    seen = firings()
    messages = scans_of(seen, parts(seen, bags.PERIOD_NS), bags.PERIOD_NS)
    joiner = ScanJoiner(number)
    assert [id(scan) for scan in pushed(joiner, messages)] == [id(message) for message in messages]
    assert joiner.notes == ()


def test_a_number_by_hand() -> None:
    seen = firings()
    messages = scans_of(seen, parts(seen, FIFTH_NS), FIFTH_NS)
    scans = pushed(ScanJoiner(10), messages)
    assert [len(scan.points) for scan in scans] == [2 * 360 * 16] * 6
    assert pushed(ScanJoiner(10), []) == []
