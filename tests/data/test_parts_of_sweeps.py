"""Messages that hold parts of a turn become the scans of whole turns; nothing else is joined."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lio_jax.data.config import DataConfig
from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.sequence import LidarScan
from tests.data import bags, part_recordings
from tests.data.bag_recordings import AUTO
from tests.data.part_recordings import (
    FIFTH_NS,
    Driver,
    Firings,
    firings,
    is_joined,
    joined_note,
    opened,
    parts,
    recorded,
    simulated,
)
from tests.shared_data import SHARED_DATA, needs_shared


def check_same(scans: Sequence[LidarScan], expected: Sequence[LidarScan], time_ulps: int = 0) -> None:
    assert len(scans) == len(expected)
    for scan, whole in zip(scans, expected, strict=True):
        assert abs(scan.stamp_ns - whole.stamp_ns) <= 2 * time_ulps
        np.testing.assert_array_equal(scan.points, whole.points)
        np.testing.assert_array_equal(scan.ring, whole.ring)
        np.testing.assert_array_equal(scan.intensity, whole.intensity)
        np.testing.assert_allclose(scan.time, whole.time, rtol=0.0, atol=8e-9 * time_ulps)
        assert scan.duration == pytest.approx(whole.duration, rel=0.0, abs=8e-9 * time_ulps)
        assert scan.dropped == whole.dropped


# the rounding of float32 seconds differs where they count from another instant
DRIVERS: dict[str, tuple[Driver, int]] = {
    "velodyne": (part_recordings.velodyne, 1),
    "velodyne at end": (part_recordings.velodyne_at_end, 1),
    "hesai": (part_recordings.hesai, 0),
    "ouster": (part_recordings.ouster, 0),
}


@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_parts_are_joined_to_the_scans_of_whole_sweeps(tmp_path: Path, driver: str, name: str) -> None:
    """Five messages a turn by velodyne_driver (npackets), or packet-wise clouds in the layouts of others."""
    make, ulps = DRIVERS[driver]
    seen, ros2 = firings(), bags.is_ros2(tmp_path / name)
    whole = recorded(seen, parts(seen, bags.PERIOD_NS), bags.PERIOD_NS, make, ros2)
    cut = recorded(seen, parts(seen, FIFTH_NS), FIFTH_NS, make, ros2)
    expected = opened(tmp_path / f"whole{Path(name).suffix}", whole)
    sequence = opened(tmp_path / name, cut)
    assert not is_joined(expected)
    assert joined_note(sequence) == (
        "each message holds a part of a turn: 5 messages are joined to a scan of 0.1 s, which starts at 0 "
        "deg of azimuth; --set config.data.messages_per_scan=1 reads each message as a scan"
    )
    (times,) = (note for note in sequence.info.notes if note.startswith("per-point time"))
    assert "s a message, header stamp at message " in times
    assert "scan" not in times
    scans = list(expected.scans())
    check_same(list(sequence.scans()), scans, ulps)
    assert sequence.info.scan_count == len(scans) == 12
    check_same(list(sequence.scans(4, 3)), scans[4:7], ulps)
    check_same(list(sequence.scans(10)), scans[10:], ulps)
    assert list(sequence.scans(12)) == []
    assert list(sequence.scans(0, 0)) == []
    assert sequence.warnings_so_far == ()


def test_organised_clouds_of_parts(tmp_path: Path) -> None:
    """velodyne_pointcloud with organize_cloud: a row a firing, a column a laser, NaN without a return."""
    seen = firings()
    silent = np.arange(len(seen.points)) % 7 == 3

    def organised(of: Firings, begin: int, end: int, kept: np.ndarray, ros2: bool) -> bags.Message:
        cloud = of.seen(kept, begin)
        filled = bags.fill(bags.VELODYNE, cloud, cloud.time)
        for axis in "xyz":
            filled[axis][silent[kept]] = np.nan
        stamp, height = bags.START_NS + begin, len(kept) // part_recordings.RINGS
        message = bags.cloud_message(stamp, filled, ros2, height=height)
        return "/velodyne_points", bags.START_NS + end + 2_000_000, message

    whole = recorded(seen, parts(seen, bags.PERIOD_NS), bags.PERIOD_NS, organised)
    cut = recorded(seen, parts(seen, FIFTH_NS), FIFTH_NS, organised)
    expected = list(opened(tmp_path / "whole.db3", whole).scans())
    assert expected[3].dropped > 0
    check_same(list(opened(tmp_path / "a.db3", cut).scans()), expected, 1)


@pytest.mark.parametrize("clockwise", [True, False])
@pytest.mark.parametrize("number", [2, 3, 4, 10, 36])
def test_any_number_of_messages_in_either_direction(tmp_path: Path, number: int, clockwise: bool) -> None:
    seen = firings(clockwise=clockwise)
    length = bags.PERIOD_NS // number
    messages = recorded(seen, parts(seen, length), length, part_recordings.hesai)
    sequence = opened(tmp_path / "a.db3", messages)
    assert f": {number} messages are joined to a scan of 0.1 s" in joined_note(sequence)
    scans = list(sequence.scans())
    assert [len(scan.points) for scan in scans] == [360 * part_recordings.RINGS] * 12


def test_packets_that_do_not_divide_a_turn(tmp_path: Path) -> None:
    """A VLP-16 at 10 Hz, one message a UDP packet: 24 firings in 1.327 ms, 75.35 packets in a turn."""
    columns, packet_ns = 1808, 1_327_104
    seen = firings(turns=8, columns=columns)
    sequence = opened(
        tmp_path / "a.db3", recorded(seen, parts(seen, packet_ns), packet_ns, part_recordings.velodyne)
    )
    assert "75.35 messages are joined to a scan of 0.1 s" in joined_note(sequence)
    scans = list(sequence.scans())
    assert sum(len(scan.points) for scan in scans) == len(seen.points)
    assert len(scans) == 8
    for number, scan in enumerate(scans):
        # a sweep starts with the packet whose middle is the first behind the start
        assert abs(scan.stamp_ns - bags.START_NS - number * bags.PERIOD_NS) <= 0.51 * packet_ns
        since = scan.stamp_ns - bags.START_NS
        mine = seen.since_ns[np.searchsorted(seen.since_ns, since - 1000) :][: len(scan.points)]
        np.testing.assert_allclose(scan.time, (mine - since) * 1e-9, atol=1e-7)


def test_packets_without_times_and_rings(tmp_path: Path) -> None:
    """The bags of Cartographer's backpack: x, y, z and intensity of each UDP packet, stamped at its start."""
    seen = firings(columns=1808)
    packet_ns = 1_327_104
    messages = recorded(seen, parts(seen, packet_ns), packet_ns, part_recordings.bare, ros2=False)
    sequence = opened(tmp_path / "a.bag", messages, AUTO)
    assert any("rin" in note and "16 beams" in note for note in sequence.info.notes)
    scan = list(sequence.scans())[3]
    begin = np.searchsorted(seen.since_ns, scan.stamp_ns - bags.START_NS - 1000)
    kept = slice(begin, begin + len(scan.points))
    np.testing.assert_array_equal(scan.points, seen.points[kept])
    np.testing.assert_array_equal(scan.ring, seen.ring[kept])
    truth = (seen.since_ns[kept] - (scan.stamp_ns - bags.START_NS)) * 1e-9
    # the first firing comes up to one firing after the stamp
    np.testing.assert_allclose(scan.time, truth, atol=bags.PERIOD_NS * 1e-9 / 1808)


@pytest.mark.parametrize("driver", [part_recordings.bare, part_recordings.ouster, part_recordings.hesai])
def test_stamps_at_the_end_of_each_message(tmp_path: Path, driver: Driver) -> None:
    """A driver that stamps a message when it is full, as config.data.stamp_at=end states."""

    def at_end(seen: Firings, begin: int, end: int, kept: np.ndarray, ros2: bool) -> bags.Message:
        topic, received_ns, message = driver(seen, begin, end, kept, ros2)
        # the last firing ends the message
        last = bags.START_NS + int(seen.since_ns[kept[-1]])
        return topic, received_ns, replace(message, header=bags.header(last, ros2))

    seen = firings()
    cut = parts(seen, FIFTH_NS)
    expected = list(opened(tmp_path / "w.db3", recorded(seen, cut, FIFTH_NS, driver)).scans())
    messages = recorded(seen, cut, FIFTH_NS, at_end)
    sequence = opened(tmp_path / "a.db3", messages, DataConfig(stamp_at="end"))
    scans = list(sequence.scans())
    assert len(scans) == len(expected) == 12
    for scan, from_start in zip(scans, expected, strict=True):
        np.testing.assert_array_equal(scan.points, from_start.points)
        np.testing.assert_allclose(scan.time, from_start.time, rtol=0.0, atol=1e-6)
        assert abs(scan.stamp_ns - from_start.stamp_ns) < 1000


def test_compensated_messages_are_joined_by_hand_alone(tmp_path: Path) -> None:
    """Points that are compensated to their own message's stamp have no times in the sweep."""
    seen = firings()
    messages = recorded(seen, parts(seen, FIFTH_NS), FIFTH_NS, part_recordings.ouster)
    alone = opened(tmp_path / "a.db3", messages, DataConfig(compensated="yes"))
    assert not is_joined(alone)
    assert alone.info.scan_count == 60
    joined = opened(tmp_path / "b.db3", messages, DataConfig(compensated="yes", messages_per_scan=5))
    scans = list(joined.scans())
    assert [len(scan.points) for scan in scans] == [360 * part_recordings.RINGS] * 12
    assert {(scan.duration, float(scan.time.max())) for scan in scans} == {(0.0, 0.0)}


def test_a_lost_message_shortens_its_own_sweep_alone(tmp_path: Path) -> None:
    seen = firings()
    cut = parts(seen, FIFTH_NS)
    whole = list(opened(tmp_path / "w.db3", recorded(seen, cut, FIFTH_NS, part_recordings.hesai)).scans())
    lost = [7, 20, 34, 41, 42, 43, 44, 45, 46]
    left = [piece for number, piece in enumerate(cut) if number not in lost]
    sequence = opened(tmp_path / "a.db3", recorded(seen, left, FIFTH_NS, part_recordings.hesai))
    scans = list(sequence.scans())
    assert sequence.info.scan_count == len(scans) == 12
    counts = np.array([len(scan.points) for scan in scans]) / (72 * part_recordings.RINGS)
    np.testing.assert_array_equal(counts, [5, 4, 5, 5, 4, 5, 4, 5, 1, 3, 5, 5])
    for number in (0, 2, 3, 5, 7, 10, 11):
        check_same([scans[number]], [whole[number]])
    # the second sweep has no third part, the fifth begins late
    first = seen.since_ns[len(seen.points) // 12 * 4 + 72 * part_recordings.RINGS]
    assert scans[4].stamp_ns == pytest.approx(bags.START_NS + first, abs=300)
    assert scans[1].stamp_ns == whole[1].stamp_ns
    np.testing.assert_array_equal(scans[1].points[: 144 * 16], whole[1].points[: 144 * 16])
    np.testing.assert_array_equal(scans[1].points[144 * 16 :], whole[1].points[216 * 16 :])
    np.testing.assert_array_equal(scans[1].time[144 * 16 :], whole[1].time[216 * 16 :])
    check_same(list(sequence.scans(8, 2)), scans[8:10])


def test_a_gap_of_many_turns_joins_nothing(tmp_path: Path) -> None:
    """A recorder that lost 3.46 s: the message behind the gap lies in the sector after that before it."""
    seen = firings(turns=45)
    cut = parts(seen, FIFTH_NS)
    left = cut[:27] + cut[202:]
    sequence = opened(tmp_path / "a.db3", recorded(seen, left, FIFTH_NS, part_recordings.ouster))
    scans = list(sequence.scans())
    assert max(scan.duration for scan in scans) < 0.1
    assert len(scans) == 6 + 5


def test_duplicates_and_late_messages_are_left_out(tmp_path: Path) -> None:
    seen = firings()
    messages = recorded(seen, parts(seen, FIFTH_NS), FIFTH_NS, part_recordings.hesai)
    expected = list(opened(tmp_path / "w.db3", messages).scans())
    again, late = messages[22], messages[31]
    messages.insert(23, (again[0], again[1] + 1_000_000, again[2]))
    messages.insert(40, (late[0], messages[39][1] + 1_000_000, late[2]))
    sequence = opened(tmp_path / "a.db3", messages)
    check_same(list(sequence.scans()), expected)
    duplicate, skipped = sequence.warnings_so_far
    assert "a: message 23 has the same stamp as a: message 22" in duplicate
    assert "a: message 40" in skipped
    assert "out of order" in skipped


def test_a_damaged_message_is_a_lost_one(tmp_path: Path) -> None:
    seen = firings()
    messages = recorded(seen, parts(seen, FIFTH_NS), FIFTH_NS, part_recordings.hesai)
    messages[26][2].height = 50_000
    sequence = opened(tmp_path / "a.db3", messages)
    counts = [len(scan.points) // (72 * part_recordings.RINGS) for scan in sequence.scans()]
    assert counts == [5, 5, 5, 5, 5, 4, 5, 5, 5, 5, 5, 5]
    assert "a: message 26 cannot be read and was skipped" in sequence.warnings_so_far[0]


def test_wrong_stamps_and_times_of_a_few_messages(tmp_path: Path) -> None:
    """Message 3 is stamped a day ahead, and a point of message 21 in the year 1970."""
    seen = firings()
    cut = parts(seen, FIFTH_NS)
    whole = list(opened(tmp_path / "w.db3", recorded(seen, cut, FIFTH_NS, part_recordings.ouster)).scans())
    messages = recorded(seen, cut, FIFTH_NS, part_recordings.ouster)
    day_ns = 24 * 3600 * 1_000_000_000
    header = bags.header(bags.START_NS + 3 * FIFTH_NS + day_ns, ros2=True)
    messages[3] = (*messages[3][:2], replace(messages[3][2], header=header))
    broken = bags.fill(bags.OUSTER, seen.seen(cut[21][1]), seen.since_ns[cut[21][1]] - cut[21][0])
    broken["t"][5] = 4_000_000_000
    messages[21] = (*messages[21][:2], bags.cloud_message(bags.START_NS + cut[21][0], broken))
    sequence = opened(tmp_path / "a.db3", messages)
    scans = list(sequence.scans())
    assert sequence.info.scan_count == len(scans) == 12
    check_same(scans[1:4] + scans[5:], whole[1:4] + whole[5:])
    assert len(scans[0].points) == 4 * 72 * part_recordings.RINGS
    assert len(scans[4].points) == 5 * 72 * part_recordings.RINGS - 1
    assert scans[4].duration == whole[4].duration
    assert any("a: message 3" in warning and "wrong stamp" in warning for warning in sequence.warnings_so_far)
    assert any("1 points with impossible times" in warning for warning in sequence.warnings_so_far)


def test_a_recording_that_begins_inside_a_sweep(tmp_path: Path) -> None:
    """Messages begin at the same azimuths in each turn; one of them is straight ahead, where drivers cut."""
    seen = firings()
    cut = parts(seen, FIFTH_NS)
    whole = list(opened(tmp_path / "w.db3", recorded(seen, cut, FIFTH_NS, part_recordings.hesai)).scans())
    more = opened(tmp_path / "more.db3", recorded(seen, cut[2:], FIFTH_NS, part_recordings.hesai))
    scans = list(more.scans())
    check_same(scans[1:], whole[1:])
    assert len(scans[0].points) == 3 * 72 * part_recordings.RINGS
    sliver = opened(tmp_path / "less.db3", recorded(seen, cut[3:-3], FIFTH_NS, part_recordings.hesai))
    check_same(list(sliver.scans()), whole[1:-1])
    assert sliver.info.scan_count == 10


def test_times_that_run_on_show_where_a_sweep_starts(tmp_path: Path) -> None:
    """A driver that cuts a sweep into messages with one stamp, times counted from the sweep's start."""
    seen = firings(start_deg=-130.0)

    def one_stamp(of: Firings, begin: int, end: int, kept: np.ndarray, ros2: bool) -> bags.Message:
        sweep = (begin + 2 * FIFTH_NS) // bags.PERIOD_NS * bags.PERIOD_NS - 2 * FIFTH_NS
        cloud = bags.fill(bags.OUSTER, of.seen(kept), of.since_ns[kept] - sweep)
        return "/points", bags.START_NS + end, bags.cloud_message(bags.START_NS + sweep, cloud, ros2)

    cut = parts(seen, FIFTH_NS)[3:]
    sequence = opened(tmp_path / "a.db3", recorded(seen, cut, FIFTH_NS, one_stamp))
    scans = list(sequence.scans())
    # two parts of the last sweep are less than half
    assert len(scans) == 11
    for number, scan in enumerate(scans):
        assert scan.stamp_ns == bags.START_NS + (number + 1) * bags.PERIOD_NS - 2 * FIFTH_NS
        assert len(scan.points) == 360 * part_recordings.RINGS
        np.testing.assert_allclose(scan.time.max(), 0.1 * 359 / 360, atol=1e-6)


def test_messages_are_scans_if_the_settings_say_so(tmp_path: Path) -> None:
    seen = firings()
    messages = recorded(seen, parts(seen, FIFTH_NS), FIFTH_NS, part_recordings.hesai)
    sequence = opened(tmp_path / "a.db3", messages, DataConfig(messages_per_scan=1))
    assert sequence.info.scan_count == len(list(sequence.scans())) == 60
    assert not any("joined" in note or "part of a sweep" in note for note in sequence.info.notes)


def test_any_number_is_joined_by_hand(tmp_path: Path) -> None:
    """A Livox sensor whose driver publishes at 50 Hz, read as scans of 0.1 s; the 8th message is lost."""
    seen = firings()

    def livox(of: Firings, begin: int, end: int, kept: np.ndarray, ros2: bool) -> bags.Message:
        cloud = bags.fill(bags.LIVOX_OFFSET_CLOUD, of.seen(kept), of.since_ns[kept] - begin)
        stamp = bags.START_NS + begin
        return "/livox/lidar", stamp + FIFTH_NS, bags.custom_message(stamp, cloud, ros2)

    cut = [(begin, kept[::8]) for begin, kept in parts(seen, FIFTH_NS)]
    del cut[7]
    messages = recorded(seen, cut, FIFTH_NS, livox, ros2=False)
    alone = opened(tmp_path / "a.bag", messages)
    assert not is_joined(alone)
    assert alone.info.scan_count == 59
    sequence = opened(tmp_path / "b.bag", messages, DataConfig(messages_per_scan=5))
    scans = list(sequence.scans())
    assert joined_note(sequence).endswith("(config.data.messages_per_scan)")
    assert [round(len(scan.points) / len(cut[0][1])) for scan in scans] == [5, 4, *[5] * 10]
    for number, scan in enumerate(scans):
        assert scan.stamp_ns == bags.START_NS + number * bags.PERIOD_NS
    assert scans[3].time.max() == pytest.approx(0.1, abs=5e-4)


def test_a_number_that_is_no_turn_is_joined_by_hand(tmp_path: Path) -> None:
    seen = firings()
    cut = parts(seen, FIFTH_NS)
    messages = recorded(seen, cut, FIFTH_NS, part_recordings.ouster)
    sequence = opened(tmp_path / "a.db3", messages, DataConfig(messages_per_scan=3))
    whole = list(sequence.scans())
    assert len(whole) == sequence.info.scan_count == 20
    assert {len(scan.points) for scan in whole} == {3 * 72 * part_recordings.RINGS}
    # messages 7, 30 and 31 are lost, 40 and 52 are stamped late
    for number in (40, 52):
        late = bags.header(bags.START_NS + number * FIFTH_NS + FIFTH_NS // 2 - 1_000_000, ros2=True)
        messages[number] = (*messages[number][:2], replace(messages[number][2], header=late))
    left = [message for number, message in enumerate(messages) if number not in (7, 30, 31)]
    lossy = opened(tmp_path / "b.db3", left, DataConfig(messages_per_scan=3))
    scans = list(lossy.scans())
    counts = [len(scan.points) // (72 * part_recordings.RINGS) for scan in scans]
    assert counts == [3, 3, 2, *[3] * 7, 1, *[3] * 9]
    intact = [number for number in range(20) if number not in (2, 10, 13, 17)]
    check_same([scans[number] for number in intact], [whole[number] for number in intact])


@pytest.mark.parametrize("number", [2, 16, 75.35])
def test_beams_that_differ_in_azimuth(tmp_path: Path, number: float) -> None:
    """An OS1-64: the four azimuths of a column differ by up to 6.3 deg, more than a packet turns."""
    sequence = opened(tmp_path / "a.db3", simulated("os1_64", number))
    found = re.search(r"turn: ([0-9.]+) messages", joined_note(sequence))
    assert found is not None
    assert float(found[1]) == pytest.approx(number, rel=2e-4)
    assert sequence.info.scan_count == 8


@pytest.mark.parametrize(("number", "jitter"), [(5, 0.1), (75.35, 0.3)])
def test_stamps_that_are_not_even(tmp_path: Path, number: float, jitter: float) -> None:
    sequence = opened(tmp_path / "a.db3", simulated("os1_64", number, jitter))
    assert is_joined(sequence)
    scans = list(sequence.scans())
    assert len(scans) == 8
    assert {round(scan.duration, 2) for scan in scans} == {0.1}


@needs_shared
def test_the_real_ouster_recording_in_parts(tmp_path: Path) -> None:
    """Three real sweeps cut into the 16 packets of an OS1: 64 columns each."""
    whole, cut = [], []
    for scan in RosbagSequence(SHARED_DATA / "ouster" / "os1_128_3scans.bag", AUTO).scans():
        since = np.round(scan.time.astype(np.float64) * 1e9).astype(np.int64)
        order = np.argsort(since, kind="stable")
        length = bags.PERIOD_NS // 16
        for messages, number, each in ((whole, 1, bags.PERIOD_NS), (cut, 16, length)):
            for part in range(number):
                kept = order[np.minimum(since[order] // each, number - 1) == part]
                seen = bags.Sweep(scan.points[kept], scan.time[kept], scan.ring[kept], scan.intensity[kept])
                stamp = scan.stamp_ns + part * each
                cloud = bags.fill(bags.OUSTER, seen, since[kept] - part * each)
                messages.append(("/points", stamp + each + 1_000_000, bags.cloud_message(stamp, cloud)))
    expected = opened(tmp_path / "whole.db3", whole)
    assert not is_joined(expected)
    sequence = opened(tmp_path / "a.db3", cut)
    assert ": 16 messages are joined to a scan of 0.1 s" in joined_note(sequence)
    check_same(list(sequence.scans()), list(expected.scans()))


def test_a_blocked_quarter_does_not_shift_the_sweeps(tmp_path: Path) -> None:
    """A fifth of the turn and a half of another see the vehicle alone, and give no points."""
    seen = firings()
    azimuth = -np.arctan2(seen.points[:, 1], seen.points[:, 0]) / (2 * np.pi) % 1.0
    free = (azimuth < 0.2) | (azimuth > 0.5)
    cut = parts(seen, FIFTH_NS, free)
    sequence = opened(tmp_path / "a.db3", recorded(seen, cut, FIFTH_NS, part_recordings.ouster))
    assert ": 5 messages" in joined_note(sequence)
    scans = list(sequence.scans())
    assert len(scans) == 12
    for number, scan in enumerate(scans):
        mine = free & (seen.since_ns // bags.PERIOD_NS == number)
        np.testing.assert_array_equal(scan.points, seen.points[mine])
        since = scan.stamp_ns - bags.START_NS
        np.testing.assert_allclose(scan.time, (seen.since_ns[mine] - since) * 1e-9, atol=1e-8)


def test_a_part_of_the_recording_counts_its_own_sweeps(tmp_path: Path) -> None:
    seen = firings()
    messages = recorded(seen, parts(seen, FIFTH_NS), FIFTH_NS, part_recordings.hesai)
    sequence = opened(tmp_path / "a.db3", messages)
    whole = list(sequence.scans())
    begin_ns = bags.START_NS + 4 * bags.PERIOD_NS
    part = sequence.within(begin_ns + FIFTH_NS, begin_ns + 5 * bags.PERIOD_NS + FIFTH_NS)
    assert part.info.scan_count == 12
    check_same(list(part.scans()), whole[4:9])
    check_same(list(part.scans(1, 2)), whole[5:7])
