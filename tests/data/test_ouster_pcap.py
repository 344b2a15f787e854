"""Captures of an Ouster give back the walls of a box, its times and its inertial samples."""

import json
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data import open_sequence
from tests.data.captures import COOKED, HALF, START_NS
from tests.data.ouster_captures import (
    COLUMNS,
    LIDAR_PORT,
    PERIOD_NS,
    box_ranges,
    frames,
    imu_packet,
    lidar_packets,
    metadata,
    write_capture,
)

pytest.importorskip(
    "ouster.sdk", reason="ouster-sdk is not installed; it comes with pip install --no-deps ouster-sdk"
)


def fault(path: Path) -> str:
    with pytest.raises(LioJaxError) as raised:
        open_sequence(path)
    return str(raised.value)


# whole packets of the older profile need nine fragments each
@pytest.mark.parametrize("profile", ["LEGACY", "RNG19_RFL8_SIG16_NIR16"])
@pytest.mark.parametrize("options", [{}, {"mtu": 65535}, {"link": COOKED}])
def test_points_lie_on_the_walls_in_the_order_of_the_columns(
    tmp_path: Path, profile: str, options: dict
) -> None:
    sequence = open_sequence(write_capture(tmp_path / "box.pcap", *frames(profile=profile), **options))
    info = sequence.info
    assert (info.format, info.scan_count, info.sensor) == ("ouster_pcap", 4, "Ouster OS-1-64")
    column, row = np.divmod(np.arange(COLUMNS * 64), 64)
    number = 0
    for scan in sequence.scans():
        # ranges are in whole mm
        assert np.abs(np.abs(scan.points) - HALF).min(axis=1).max() < 0.6e-3
        np.testing.assert_array_equal(scan.ring, row)
        np.testing.assert_allclose(scan.time, column * PERIOD_NS / COLUMNS * 1e-9, atol=1e-8)
        assert scan.stamp_ns == START_NS + number * PERIOD_NS
        assert scan.duration == pytest.approx(0.1, abs=1e-6)
        assert (scan.intensity == 77).all()
        assert scan.dropped == 0
        number += 1
    assert number == 4
    # the first column looks straight back in the sensor's frame and the sensor turns clockwise
    middle = scan.points[scan.ring == 31]
    assert middle[0, 0] < -4.9
    assert middle[COLUMNS // 4, 1] > 3.9
    assert sequence.imu() is sequence.gps() is sequence.truth() is None
    assert sequence.warnings_so_far == ()


def test_the_sensors_own_imu_is_read(tmp_path: Path) -> None:
    described, sent = frames(2)
    stamps = START_NS + 10_000_000 * np.arange(20)
    samples = [imu_packet(int(stamp), [0.1, -0.2, 1.0], [90.0, k, -180.0]) for k, stamp in enumerate(stamps)]
    sequence = open_sequence(write_capture(tmp_path / "box.pcap", described, sent + samples))
    imu = sequence.imu()
    assert imu is not None
    np.testing.assert_array_equal(imu.stamp_ns, stamps)
    np.testing.assert_allclose(imu.accel, np.tile([0.980665, -1.96133, 9.80665], (20, 1)), rtol=1e-6)
    expected = np.stack([np.full(20, np.pi / 2), np.radians(np.arange(20)), np.full(20, -np.pi)], axis=1)
    np.testing.assert_allclose(imu.gyro, expected, rtol=1e-6)
    # the metadata say where the IMU is in the sensor, in mm
    T_imu_lidar = sequence.info.T_imu_lidar
    assert T_imu_lidar is not None
    at = np.array(described["imu_intrinsics"]["imu_to_sensor_transform"]).reshape(4, 4)[:3, 3] * 1e-3
    np.testing.assert_allclose(T_imu_lidar @ [*at, 1.0], [0, 0, 0, 1], atol=1e-12)
    np.testing.assert_array_equal(T_imu_lidar[:3, :3], np.eye(3))
    assert len(list(sequence.scans())) == 2


def test_newer_packets_of_the_imu_hold_several_samples(tmp_path: Path) -> None:
    described = metadata("RNG19_RFL8_SIG16_NIR16")
    described["lidar_data_format"]["udp_profile_imu"] = "ACCEL32_GYRO32_NMEA"
    described["imu_data_format"] = {"imu_measurements_per_packet": 8, "imu_packets_per_frame": 8}
    ranges = box_ranges(described, HALF)
    sent = [one for number in range(2) for one in lidar_packets(described, ranges, number)]
    sequence = open_sequence(write_capture(tmp_path / "box.pcap", described, sent))
    imu = sequence.imu()
    assert imu is not None
    measured = np.delete(np.arange(64), 5) * PERIOD_NS // 64
    np.testing.assert_array_equal(imu.stamp_ns, np.r_[START_NS + measured, START_NS + PERIOD_NS + measured])
    # these are in m/s^2 and rad/s already
    np.testing.assert_array_equal(imu.accel, np.tile([0.5, -1.5, 9.75], (126, 1)))
    np.testing.assert_array_equal(imu.gyro, np.tile([0.25, -0.5, 1.0], (126, 1)))
    assert [len(scan.points) for scan in sequence.scans()] == [COLUMNS * 64] * 2


def test_a_profile_without_signal_gives_reflectivity(tmp_path: Path) -> None:
    sequence = open_sequence(write_capture(tmp_path / "box.pcap", *frames(1, "RNG15_RFL8_NIR8")))
    (scan,) = sequence.scans()
    assert (scan.intensity == 77).all()
    # ranges are in 8 mm
    assert np.abs(np.abs(scan.points) - HALF).min(axis=1).max() < 9e-3


def test_an_imu_that_is_turned_in_the_sensor(tmp_path: Path) -> None:
    described, sent = frames(1)
    # x of the IMU is y of the sensor
    described["imu_intrinsics"]["imu_to_sensor_transform"] = [
        0,
        -1,
        0,
        10,
        1,
        0,
        0,
        20,
        0,
        0,
        1,
        30,
        0,
        0,
        0,
        1,
    ]
    T_imu_lidar = open_sequence(write_capture(tmp_path / "box.pcap", described, sent)).info.T_imu_lidar
    assert T_imu_lidar is not None
    np.testing.assert_allclose(T_imu_lidar @ [0.010, 1.020, 0.030, 1.0], [1, 0, 0, 1], atol=1e-12)


def test_a_transform_that_is_no_rotation_is_refused(tmp_path: Path) -> None:
    described, sent = frames(1)
    described["imu_intrinsics"]["imu_to_sensor_transform"][0] = 2.0
    message = fault(write_capture(tmp_path / "box.pcap", described, sent))
    assert "box.json: imu_to_sensor_transform is no rotation with a translation; put the" in message


def test_the_last_row_of_a_transform_does_not_matter(tmp_path: Path) -> None:
    described, sent = frames(1)
    described["imu_intrinsics"]["imu_to_sensor_transform"][15] = 1e-320
    T_imu_lidar = open_sequence(write_capture(tmp_path / "box.pcap", described, sent)).info.T_imu_lidar
    assert T_imu_lidar is not None
    np.testing.assert_allclose(T_imu_lidar[:3, 3], [-0.006253, 0.011775, -0.007645], atol=1e-12)
    np.testing.assert_array_equal(T_imu_lidar[3], [0, 0, 0, 1])


def test_points_that_are_not_finite_are_dropped(tmp_path: Path) -> None:
    described, sent = frames(1)
    described["beam_intrinsics"]["lidar_origin_to_beam_origin_mm"] = 1e300
    described["beam_intrinsics"]["beam_to_lidar_transform"][3] = 1e300
    for scan in open_sequence(write_capture(tmp_path / "box.pcap", described, sent)).scans():
        assert np.isfinite(scan.points).all()
        assert len(scan.points) == len(scan.ring) == len(scan.time) == len(scan.intensity)
        assert len(scan.points) + scan.dropped == COLUMNS * 64


@pytest.mark.parametrize("wrong_ns", [0, START_NS - 10**12, START_NS + 10**12, 2**64 - 1])
def test_a_damaged_stamp_of_a_column_costs_this_column_alone(tmp_path: Path, wrong_ns: int) -> None:
    described, sent = frames(2)
    # the first column of the third packet begins with its time
    data = struct.pack("<Q", wrong_ns) + sent[2].data[8:]
    sent[2] = sent[2]._replace(data=data)
    found = list(open_sequence(write_capture(tmp_path / "box.pcap", described, sent)).scans())
    assert [len(scan.points) for scan in found] == [(COLUMNS - 1) * 64, COLUMNS * 64]
    assert [scan.stamp_ns for scan in found] == [START_NS, START_NS + PERIOD_NS]
    assert found[0].duration == pytest.approx(0.1, abs=1e-6)


def test_a_sensor_that_counts_from_its_start_is_named(tmp_path: Path) -> None:
    described, sent = frames(1)
    early = [
        one._replace(
            data=b"".join(
                struct.pack("<Q", int.from_bytes(one.data[at : at + 8], "little") - START_NS + 10**10)
                + one.data[at + 8 : at + 788]
                for at in range(0, 12608, 788)
            )
        )
        for one in sent
    ]
    sequence = open_sequence(write_capture(tmp_path / "box.pcap", described, early))
    assert "stamps: the time since the sensor's start" in sequence.info.notes
    (scan,) = sequence.scans()
    assert scan.stamp_ns == 10**10
    assert len(scan.points) == COLUMNS * 64


def test_scans_can_be_taken_from_the_middle(tmp_path: Path) -> None:
    described = metadata()
    ranges = box_ranges(described, HALF)
    sent = [one for k in range(4) for one in lidar_packets(described, ranges + 0.1 * k, k)]
    sequence = open_sequence(write_capture(tmp_path / "box.pcap", described, sent))
    found = list(sequence.scans())
    taken = list(sequence.scans(2, 1))
    assert [scan.stamp_ns for scan in taken] == [found[2].stamp_ns]
    np.testing.assert_array_equal(taken[0].points, found[2].points)
    assert [len(list(sequence.scans(start))) for start in (1, 3, 4, 9)] == [3, 1, 0, 0]


def test_lost_packets_and_missing_returns(tmp_path: Path) -> None:
    described = metadata()
    ranges = box_ranges(described, HALF)
    ranges[10, ::2] = 0.0
    sent = [one for k in range(3) for one in lidar_packets(described, ranges, k)]
    # the third of 64 packets of the second frame: 16 columns
    sequence = open_sequence(write_capture(tmp_path / "box.pcap", described, sent[:66] + sent[67:]))
    found = list(sequence.scans())
    assert [scan.dropped for scan in found] == [512, 512 - 8, 512]
    assert len(found[1].points) == (COLUMNS - 16) * 64 - 504
    for scan in found:
        assert np.abs(np.abs(scan.points) - HALF).min(axis=1).max() < 0.6e-3
        assert scan.duration == pytest.approx(0.1, abs=1e-6)


def test_a_truncated_capture_gives_what_is_there(tmp_path: Path) -> None:
    path = write_capture(tmp_path / "box.pcap", *frames(3))
    path.write_bytes(path.read_bytes()[:-20_000])
    sequence = open_sequence(path)
    found = list(sequence.scans())
    assert [len(scan.points) for scan in found[:2]] == [COLUMNS * 64] * 2
    assert 0 < len(found[2].points) < COLUMNS * 64
    assert any("box.pcap: truncated within the packet at byte" in one for one in sequence.warnings_so_far)


def test_the_metadata_with_the_most_similar_name_are_taken(tmp_path: Path) -> None:
    path = write_capture(tmp_path / "drive_3-000.pcap", *frames(1))
    (tmp_path / "drive_3-000.json").rename(tmp_path / "drive_3.json")
    other = json.loads((tmp_path / "drive_3.json").read_text())
    other["sensor_info"]["prod_line"] = "OS-2-64"
    (tmp_path / "drive_1.json").write_text(json.dumps(other))
    (tmp_path / "drive_3-000.yaml").write_text("nothing")
    info = open_sequence(path).info
    assert info.sensor == "Ouster OS-1-64"
    assert "with the metadata of drive_3.json" in info.notes[0]


def test_metadata_that_are_missing_or_wrong_are_named(tmp_path: Path) -> None:
    described, sent = frames(1)
    path = write_capture(tmp_path / "box.pcap", None, sent)
    assert "box.pcap: is the capture of an Ouster, which cannot be read without" in (message := fault(path))
    assert message.endswith("put the .json file that was written with the capture beside it, as box.json.")
    (tmp_path / "box.json").write_text('{"name": 3}')
    assert "box.json: is no metadata of an Ouster (" in (message := fault(path))
    assert message.endswith("put the metadata of box.pcap in its place.")
    # packets of another size
    (tmp_path / "box.json").write_text(json.dumps(metadata("RNG19_RFL8_SIG16_NIR16")))
    assert "or box.json is the metadata of another sensor" in fault(path)
    # other ports
    (tmp_path / "box.json").write_text(json.dumps(metadata(udp_port_lidar=7777)))
    assert "or box.json is the metadata of another sensor" in fault(path)
    (tmp_path / "box.json").write_text(json.dumps(described))
    assert open_sequence(path).info.scan_count == 1


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_capture(tmp_path / "box.pcap", *frames(1))
    for name in ("ouster", "ouster.sdk", "ouster.sdk.core"):
        monkeypatch.setitem(sys.modules, name, None)
    message = fault(path)
    assert message.endswith("is not installed; install it with pip install --no-deps 'ouster-sdk>=1.0'.")
    assert "box.pcap: " in message


def test_only_inertial_samples_are_no_recording(tmp_path: Path) -> None:
    samples = [imu_packet(START_NS + k, [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]) for k in range(9)]
    message = fault(write_capture(tmp_path / "box.pcap", metadata(), samples))
    assert "box.pcap: most of its UDP packets hold 48 bytes" in message


def test_packets_that_go_to_another_port_are_read_if_the_metadata_say_so(tmp_path: Path) -> None:
    described, sent = frames(2)
    described["config_params"]["udp_port_lidar"] = 9000
    moved = [one._replace(port=9000) if one.port == LIDAR_PORT else one for one in sent]
    assert len(list(open_sequence(write_capture(tmp_path / "box.pcap", described, moved)).scans())) == 2
