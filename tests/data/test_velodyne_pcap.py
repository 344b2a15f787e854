"""Captures of Velodyne lidars, written byte by byte, give back the walls of a box and the times of firing."""

import struct
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data import open_sequence
from lio_jax.data.sequence import LidarScan
from tests.data.captures import (
    COOKED,
    CYCLES,
    DUAL,
    HALF,
    HDL32E,
    HOUR_NS,
    RAW_IP,
    START_NS,
    VLP16,
    Model,
    Sent,
    box,
    box_ranges,
    packets,
    received,
    turning,
    write_pcap,
)

pytest.importorskip(
    "velodyne_decoder", reason="velodyne-decoder is not installed; it comes with lio-jax[pcap]"
)

QUANTISED = 1.2e-3
"""Half of the step of ranges (2 mm) and half of that of azimuths (0.01 deg), at the corners of the box, m."""


def scans_of(path: Path) -> list[LidarScan]:
    return list(open_sequence(path).scans())


def wall_distance(points: np.ndarray) -> np.ndarray:
    return np.abs(np.abs(points) - HALF).min(axis=1)


# the library shifts the lasers of an HDL-32E by up to 17 mm of height, which its manual does not state
@pytest.mark.parametrize(("model", "tolerance"), [(VLP16, QUANTISED), (HDL32E, 0.018)])
def test_points_lie_on_the_walls_in_the_order_of_firing(
    tmp_path: Path, model: Model, tolerance: float
) -> None:
    sequence = open_sequence(write_pcap(tmp_path / "box.pcap", received(box(model))))
    assert (sequence.info.format, sequence.info.scan_count) == ("velodyne_pcap", 3)
    assert sequence.info.sensor == {VLP16.code: "Velodyne VLP16", HDL32E.code: "Velodyne HDL32E"}[model.code]
    number = 0
    for scan in sequence.scans():
        assert scan.points.shape == (CYCLES // model.cycles * 384, 3)
        assert wall_distance(scan.points).max() < tolerance
        # each firing is where the manual's tables place it
        cycle, laser = np.divmod(np.arange(len(scan.points)), model.lasers)
        np.testing.assert_array_equal(scan.ring, model.ring[laser])
        expected = (cycle * model.cycle_ns + laser * model.delay_ns) * 1e-9
        np.testing.assert_allclose(scan.time, expected, atol=2e-6)
        elevation = np.degrees(np.arctan2(scan.points[:, 2], np.hypot(*scan.points[:, :2].T)))
        # at 3 m the heights of the lasers change the elevation by up to a quarter of the beams' distance
        assert np.abs(elevation - model.elevation[laser]).max() < 0.34
        azimuth = np.degrees(-np.arctan2(scan.points[:, 1], scan.points[:, 0]))
        head = 360 / CYCLES * (cycle + laser * model.delay_ns / model.cycle_ns)
        assert np.abs((azimuth - head + 180) % 360 - 180).max() < 0.011
        assert (scan.intensity == 60).all()
        # 75 packets of a turn of the VLP-16; stamps in whole us
        assert abs(scan.stamp_ns - START_NS - number * CYCLES * model.cycle_ns) < 1000
        assert abs(scan.duration - CYCLES * model.cycle_ns * 1e-9) < 2e-6
        assert scan.dropped == 0
        number += 1
    assert number == 3
    assert sequence.imu() is sequence.gps() is sequence.truth() is None
    assert sequence.warnings_so_far == ()


def test_scans_are_turns_from_straight_ahead_and_can_be_taken_from_the_middle(tmp_path: Path) -> None:
    # 0.75 of a turn before the first passage, 0.3 of a turn after the last one
    path = write_pcap(tmp_path / "box.pcap", received(box(turns=4.05, begin_deg=90.0)))
    sequence = open_sequence(path)
    found = list(sequence.scans())
    assert len(found) == sequence.info.scan_count == 4
    packet = 4.8
    for scan in found[1:]:
        first = np.degrees(-np.arctan2(scan.points[0, 1], scan.points[0, 0])) % 360
        assert first < 1e-3 or first > 360 - packet
    # without a gap and without an overlap
    for scan, following in pairwise(found):
        assert scan.end_ns == following.stamp_ns
    taken = list(sequence.scans(2, 1))
    assert len(taken) == 1
    for name in ("points", "time", "ring", "intensity"):
        np.testing.assert_array_equal(getattr(taken[0], name), getattr(found[2], name))
    assert taken[0].stamp_ns == found[2].stamp_ns
    assert list(sequence.scans(4)) == []


def test_a_part_of_a_turn_at_either_end_is_left_out(tmp_path: Path) -> None:
    # 1/4 of a turn, two turns, 1/4 of a turn
    found = scans_of(write_pcap(tmp_path / "a.pcap", received(box(turns=2.5, begin_deg=270.0))))
    assert len(found) == 2
    assert all(abs(scan.duration - 0.0995) < 0.002 for scan in found)
    # nothing else is there
    assert len(scans_of(write_pcap(tmp_path / "b.pcap", received(box(turns=0.25, begin_deg=270.0))))) == 1


def test_the_clock_of_the_sensor_gives_the_stamps_over_the_top_of_the_hour(tmp_path: Path) -> None:
    start_ns = (START_NS // HOUR_NS + 1) * HOUR_NS - 150_000_000
    # packets reach the computer late, and not equally late
    sent = [
        Sent(time_ns + 3_000_000 + 40_000_000 * (number % 7 == 3), 2368, data)
        for number, (time_ns, data) in enumerate(box(start_ns=start_ns))
    ]
    sequence = open_sequence(write_pcap(tmp_path / "box.pcap", sent))
    assert "which keeps the time of day" in sequence.info.notes[1]
    found = list(sequence.scans())
    period_ns = CYCLES * VLP16.cycle_ns
    for number, scan in enumerate(found):
        assert abs(scan.stamp_ns - start_ns - number * period_ns) < 2000
        assert abs(scan.time.max() - (period_ns - 20_000) * 1e-9) < 5e-6
        assert (np.diff(scan.time) >= 0).all()
    assert len(found) == 3
    assert sequence.warnings_so_far == ()


# half an hour apart, delays of some ms must not change the hour
@pytest.mark.parametrize("minutes", [17, 30, 59])
def test_a_sensor_without_the_time_of_day_takes_it_from_the_computer(tmp_path: Path, minutes: int) -> None:
    # the sensor counts from its start; its first hour ends within the recording
    start_ns = HOUR_NS - 150_000_000
    ahead_ns = START_NS // HOUR_NS * HOUR_NS + minutes * 60 * 1_000_000_000 - 3_000_000
    sent = received(box(start_ns=start_ns), ahead_ns, latency_ns=0)
    sent = [one._replace(received_ns=one.received_ns + 5_000_000 * (k % 3)) for k, one in enumerate(sent)]
    sequence = open_sequence(write_pcap(tmp_path / "box.pcap", sent))
    assert "set by the computer's" in sequence.info.notes[1]
    found = list(sequence.scans())
    assert len(found) == 3
    for number, scan in enumerate(found):
        expected = start_ns + ahead_ns + number * CYCLES * VLP16.cycle_ns
        assert abs(scan.stamp_ns - expected) < 3000


def test_of_two_returns_the_strongest_is_taken(tmp_path: Path) -> None:
    azimuth = turning(VLP16, 1.0)
    near = box_ranges(VLP16, azimuth, HALF)
    # a block holds two cycles; the last return is 2 m behind the strongest one
    pairs = np.stack([(near + 2.0).reshape(-1, 2, 16), near.reshape(-1, 2, 16)], axis=1)
    both = np.repeat(azimuth.reshape(-1, 1, 2), 2, axis=1)
    written = packets(VLP16, pairs.reshape(-1, 16), both.ravel(), START_NS, mode=DUAL)
    (scan,) = scans_of(write_pcap(tmp_path / "box.pcap", received(written)))
    assert len(scan.points) == near.size
    assert wall_distance(scan.points).max() < QUANTISED
    assert scan.dropped == 0


def test_firings_without_a_return_are_counted(tmp_path: Path) -> None:
    azimuth = turning(VLP16, 1.0)
    ranges = box_ranges(VLP16, azimuth, HALF)
    ranges[::3, 5] = 0.0
    path = write_pcap(tmp_path / "box.pcap", received(packets(VLP16, ranges, azimuth, START_NS)))
    (scan,) = scans_of(path)
    assert scan.dropped == 600
    assert len(scan.points) == ranges.size - 600
    assert np.count_nonzero(scan.ring == VLP16.ring[5]) == 1200


@pytest.mark.parametrize(
    "options",
    [
        {"order": ">"},
        {"nanoseconds": True},
        {"link": RAW_IP},
        {"link": COOKED},
        {"vlan": True},
        {"order": ">", "nanoseconds": True, "link": COOKED},
    ],
)
def test_every_kind_of_capture_gives_the_same_scans(tmp_path: Path, options: dict) -> None:
    # what else is on the line does not matter
    sent = [Sent(START_NS, 8308, bytes(512)), *received(box(turns=1.6)), Sent(START_NS, 53, b"x")]
    expected = scans_of(write_pcap(tmp_path / "plain.pcap", sent))
    found = scans_of(write_pcap(tmp_path / "other.PCAP", sent, **options))
    assert len(found) == len(expected) == 2
    for scan, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(scan.points, other.points)
        assert scan.stamp_ns == other.stamp_ns


def test_lost_packets_shorten_their_own_turn_alone(tmp_path: Path) -> None:
    sent = received(box(turns=4.0))
    # the end of the second turn and the begin of the third one
    found = scans_of(write_pcap(tmp_path / "box.pcap", sent[:140] + sent[155:]))
    assert [len(scan.points) for scan in found] == [75 * 384, 65 * 384, 70 * 384, 75 * 384]
    assert found[1].duration < 66 * 24 * VLP16.cycle_ns * 1e-9
    assert all(wall_distance(scan.points).max() < QUANTISED for scan in found)


def test_the_packets_of_a_second_sensor_are_left_out(tmp_path: Path) -> None:
    mine, other = received(box()), [one._replace(source="192.168.1.202") for one in received(box())]
    both = [one for pair in zip(mine, other, strict=True) for one in pair]
    sequence = open_sequence(write_pcap(tmp_path / "box.pcap", both))
    assert [len(scan.points) for scan in sequence.scans()] == [75 * 384] * 3
    (warning,) = sequence.warnings_so_far
    assert "holds the packets of 2 Velodynes; only those of 192.168.1.201 to port 2368 are read" in warning


def test_a_truncated_capture_gives_its_whole_packets(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "box.pcap", received(box()))
    content = path.read_bytes()
    for lost in (1, 500, 1250, 1255):
        path.write_bytes(content[:-lost])
        sequence = open_sequence(path)
        assert [len(scan.points) for scan in sequence.scans()] == [75 * 384, 75 * 384, 74 * 384]
        (warning,) = sequence.warnings_so_far
        assert "box.pcap: truncated within the packet at byte" in warning


def test_damage_ends_the_reading_with_a_warning(tmp_path: Path) -> None:
    path = write_pcap(tmp_path / "box.pcap", received(box()))
    content = bytearray(path.read_bytes())
    record = 16 + 14 + 20 + 8 + 1206
    at = 24 + 160 * record
    content[at + 8 : at + 12] = b"\xff\xff\xff\x7f"
    path.write_bytes(content)
    sequence = open_sequence(path)
    assert [len(scan.points) for scan in sequence.scans()] == [75 * 384, 75 * 384]
    assert f"box.pcap: damaged at byte {at}" in sequence.warnings_so_far[0]


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_pcap(tmp_path / "box.pcap", received(box(turns=0.2)))
    monkeypatch.setitem(sys.modules, "velodyne_decoder", None)
    with pytest.raises(LioJaxError, match=r"box\.pcap: .*install it with pip install 'lio-jax\[pcap\]'\.$"):
        open_sequence(path)


def test_a_model_that_is_not_decoded_is_an_error(tmp_path: Path) -> None:
    written = [(time_ns, data[:-1] + b"\x31") for time_ns, data in box(turns=0.5)]
    path = write_pcap(tmp_path / "box.pcap", received(written))
    with pytest.raises(LioJaxError, match=r"box\.pcap: .*Velarray.*let its driver write a ROS bag"):
        open_sequence(path)


def test_an_hdl64_needs_the_calibration_in_its_packets(tmp_path: Path) -> None:
    # it sends its state, byte by byte, where others state the kind of return and the model
    state = b"HMSDNYGTV"
    written = [
        (time_ns, data[:-2] + bytes([state[k % len(state)], k % 60]))
        for k, (time_ns, data) in enumerate(box())
    ]
    path = write_pcap(tmp_path / "box.pcap", received(written))
    with pytest.raises(LioJaxError, match=r"box\.pcap: .*HDL-64E, but do not hold its calibration"):
        open_sequence(path)


def hdl64_state(elevation: np.ndarray) -> list[bytes]:
    """Return the last two bytes of successive packets of an HDL-64E S2: what they state, and its value.

    Source: Velodyne, "HDL-64E S2 User's Manual" (63-HDL64ES2), appendix E: the time, the state, and the
    calibration of each laser in 28 bytes.
    """
    calibration = b"UNIT#" + bytes(2)
    for laser, angle in enumerate(elevation):
        numbers = (laser, round(angle * 100), *(0,) * 8, 0, 255)
        calibration += struct.pack("<BhhhhhhhhhBB", *numbers) + bytes([13, 5, 6, 10, 20, 30, 0])
    calibration += bytes(19) + struct.pack("<H", 1820)
    state = zip(b"HMSDNYGTV", (10, 20, 30, 6, 5, 13, 1, 20, 1), strict=True)
    return [bytes(pair) for pair in [*state, *((ord("1"), value) for value in calibration)]]


def test_an_hdl64_is_read_with_the_calibration_in_its_packets(tmp_path: Path) -> None:
    elevation = np.linspace(2.0, -24.0, 64).round(2)
    state = hdl64_state(elevation)
    # six firings of all lasers in a packet, 0.18 deg and 48 us apart; 2000 of them are a turn
    azimuth = 0.18 * np.arange(6 * len(state)) % 360
    ways = np.stack([np.cos(np.radians(elevation)), np.sin(np.radians(elevation))])
    sent = []
    for number, ending in enumerate(state):
        data = b""
        for degrees in azimuth[6 * number : 6 * number + 6]:
            sides = np.abs([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
            # the wall is met where the first of its coordinates is reached
            distance = 1 / np.maximum((sides / HALF[:2]).max() * ways[0], np.abs(ways[1]) / HALF[2])
            for flag, part in ((0xEEFF, distance[:32]), (0xDDFF, distance[32:])):
                data += struct.pack("<HH", flag, round(degrees * 100) % 36000)
                data += b"".join(struct.pack("<HB", round(one / 0.002), 9) for one in part)
        time_ns = START_NS + number * 288_000
        sent.append(Sent(time_ns, 2368, data + struct.pack("<I", time_ns % HOUR_NS // 1000) + ending))
    sequence = open_sequence(write_pcap(tmp_path / "a.pcap", sent))
    assert sequence.info.sensor == "Velodyne HDL64E_S2"
    first, *others = sequence.scans()
    assert len(others) == 4
    for scan in others:
        # the head turns by 0.17 deg between the lasers of a firing, for which these ranges do not account
        assert wall_distance(scan.points).max() < 0.02
        assert abs(scan.duration - 2000 * 48e-6) < 3e-4
        assert abs(len(scan.points) - 128_000) < 500
    # rings count from the lowest laser
    assert np.unique(first.ring).tolist() == list(range(64))
    angles = np.degrees(np.arctan2(first.points[:, 2], np.hypot(*first.points[:, :2].T)))
    np.testing.assert_allclose(angles, np.sort(elevation)[first.ring], atol=0.01)
