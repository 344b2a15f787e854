"""Bags of every format and field layout become the same scans."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lio_jax.data.rosbag import RosbagSequence
from tests.data import bags
from tests.data.bag_recordings import AUTO, FORMATS, SEEN, check_seen, cloud_messages, received, scan_starts
from tests.shared_data import SHARED_DATA, needs_shared

Layout = tuple[np.dtype, Any, str]
"""Field layout, ticks of a sweep that starts at given ns, unit and reference for the note."""

LAYOUTS: dict[str, Layout] = {
    "velodyne": (bags.VELODYNE, lambda start: SEEN.time, "'time', float32 s relative"),
    "ouster": (bags.OUSTER, lambda start: np.round(SEEN.time * 1e9), "'t', uint32 ns relative"),
    "hesai": (bags.HESAI, lambda start: start * 1e-9 + SEEN.time, "'timestamp', float64 s absolute"),
    "robosense": (
        bags.ROBOSENSE,
        lambda start: start * 1e-9 + SEEN.time,
        "'timestamp', float64 s absolute",
    ),
    "livox": (
        bags.LIVOX_CLOUD,
        lambda start: start + SEEN.time * 1e9,
        "'timestamp', float64 ns absolute",
    ),
    "livox offsets": (
        bags.LIVOX_OFFSET_CLOUD,
        lambda start: np.round(SEEN.time * 1e9),
        "'offset_time', uint32 ns relative",
    ),
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", FORMATS)
def test_every_layout_in_every_format(tmp_path: Path, name: str, layout: str) -> None:
    dtype, ticks, said = LAYOUTS[layout]
    clouds = [bags.fill(dtype, SEEN, ticks(stamp)) for stamp in scan_starts(3)]
    path = bags.write_bag(tmp_path / name, cloud_messages(tmp_path / name, clouds))
    sequence = RosbagSequence(path, AUTO)
    assert sequence.info.format == "rosbag"
    assert sequence.info.scan_count == 3
    assert sequence.info.name == "a"
    assert sequence.info.notes == (
        f"per-point time: field {said}, 0.0989 s a scan, header stamp at scan start",
    )
    scans = list(sequence.scans())
    assert len(scans) == 3
    for scan, stamp in zip(scans, scan_starts(3), strict=True):
        check_seen(scan, stamp, 256 if "absolute" in said else 0)
    assert sequence.warnings_so_far == ()
    assert sequence.imu() is None
    assert sequence.gps() is None
    assert sequence.truth() is None
    assert list(sequence.header_stamps()) == scan_starts(3)


@pytest.mark.parametrize("kind", bags.LIVOX)
@pytest.mark.parametrize("name", FORMATS)
def test_livox_custom_messages(tmp_path: Path, name: str, kind: str) -> None:
    ros2 = bags.is_ros2(tmp_path / name)
    seen = bags.sweep(rings=4, columns=50)
    cloud = bags.fill(bags.LIVOX_OFFSET_CLOUD, seen, np.round(seen.time * 1e9))
    messages = [
        ("/livox/lidar", received(stamp), bags.custom_message(stamp, cloud, ros2, kind))
        for stamp in scan_starts(3)
    ]
    sequence = RosbagSequence(bags.write_bag(tmp_path / name, messages), AUTO)
    assert "field 'offset_time', uint32 ns relative, 0.0980 s a scan" in sequence.info.notes[0]
    scans = list(sequence.scans())
    assert [scan.stamp_ns for scan in scans] == scan_starts(3)
    np.testing.assert_array_equal(scans[1].points, seen.points)
    np.testing.assert_array_equal(scans[1].ring, seen.ring)
    np.testing.assert_allclose(scans[1].time, seen.time, atol=1e-6)


@needs_shared
def test_the_real_ouster_recording() -> None:
    sequence = RosbagSequence(SHARED_DATA / "ouster" / "os1_128_3scans.bag", AUTO)
    assert sequence.info.scan_count == 3
    assert sequence.info.notes == (
        "per-point time: field 't', uint32 ns relative, 0.0999 s a scan, header stamp at scan start",
    )
    scans = list(sequence.scans())
    assert [scan.stamp_ns for scan in scans] == [
        1700000991587364520,
        1700000991687315250,
        1700000991787323080,
    ]
    for scan, following in pairwise(scans):
        # One sweep ends where the next begins, which only holds if unit and stamp are understood.
        assert abs(following.stamp_ns - scan.end_ns) < 200_000
    for scan in scans:
        assert 100_000 < len(scan.points) < 131_072
        assert np.isfinite(scan.points).all()
        assert (scan.ring.min(), scan.ring.max()) == (0, 127)
        assert 0.0 <= scan.time.min() < scan.time.max() <= scan.duration
        # Firing time and azimuth advance together, clockwise.
        row = scan.ring == 64
        turned = np.unwrap(-np.arctan2(scan.points[row, 1], scan.points[row, 0])[np.argsort(scan.time[row])])
        assert np.corrcoef(turned, np.sort(scan.time[row]))[0, 1] > 0.999
    imu = sequence.imu()
    assert imu is not None
    assert len(imu.stamp_ns) == 30
    np.testing.assert_allclose(np.diff(imu.stamp_ns), 1e7, atol=1e4)
    assert np.linalg.norm(imu.accel.mean(axis=0)) == pytest.approx(10.5, abs=1.0)
    assert imu.orientation is None
    assert sequence.gps() is None
    assert sequence.warnings_so_far == ()


def test_missing_ring_and_time_are_reconstructed_and_reported(tmp_path: Path) -> None:
    order = np.argsort(SEEN.time, kind="stable")
    cloud = bags.fill(bags.PLAIN, SEEN)[order]
    path = bags.write_bag(tmp_path / "a.bag", cloud_messages(tmp_path / "a.bag", [cloud] * 3))
    sequence = RosbagSequence(path, AUTO)
    time_note, ring_note = sequence.info.notes
    assert time_note.startswith(
        "per-point time: not recorded, reconstructed from azimuth over 0.1 s a scan, "
    )
    assert ring_note == (
        "ring: not recorded, reconstructed from elevation as of 16 beams (config.data.beams)"
    )
    scan = next(sequence.scans())
    assert scan.duration == pytest.approx(0.1)
    # The sweep's two ends are taken from its first and last point, one column short of a full turn.
    np.testing.assert_allclose(scan.time, SEEN.time[order] * 0.1 / SEEN.time.max(), atol=2e-3)
    np.testing.assert_array_equal(scan.ring, SEEN.ring[order])
    assert set(scan.intensity) == {0.0}


def test_an_empty_scan_in_the_middle_is_yielded_and_reported(tmp_path: Path) -> None:
    full = bags.fill(bags.VELODYNE, SEEN, SEEN.time)
    nothing = full.copy()
    for axis in "xyz":
        nothing[axis] = np.nan
    path = bags.write_bag(
        tmp_path / "a.db3", cloud_messages(tmp_path / "a.db3", [full, full[:0], full, nothing, full])
    )
    sequence = RosbagSequence(path, AUTO)
    scans = list(sequence.scans())
    assert [len(scan.points) for scan in scans] == [len(full), 0, len(full), 0, len(full)]
    assert [scan.stamp_ns for scan in scans] == scan_starts(5)
    for scan in scans:
        assert scan.points.shape == (len(scan.time), 3)
        assert scan.duration == pytest.approx(0.0989, abs=1e-3)
    assert len(sequence.warnings_so_far) == 2
    assert "a: scan 1 (1700000000.223456789 s) holds no points." in sequence.warnings_so_far
    list(sequence.scans())
    assert len(sequence.warnings_so_far) == 2


ROBOSENSE_PCL = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "timestamp"],
        "formats": ["<f4", "<f4", "<f4", "u1", "<u2", "<f8"],
        "offsets": [0, 4, 8, 16, 18, 24],
        "itemsize": 32,
    }
)


@pytest.mark.parametrize("padding_has_times", [True, False])
def test_robosense_clouds_padded_with_nan(tmp_path: Path, padding_has_times: bool) -> None:
    """rslidar_sdk of ROS 1: pcl::toROSMsg of an organised cloud of RsPointXYZIRT, NaN where nothing returned.

    Layout: PCL_ADD_POINT4D, uint8 intensity, uint16 ring, double timestamp, 16-byte aligned.
    """
    silent = np.arange(len(SEEN.points)) % 7 == 3
    messages = []
    for stamp in scan_starts(3):
        cloud = bags.fill(ROBOSENSE_PCL, SEEN, stamp * 1e-9 + SEEN.time)
        for axis in "xyz":
            cloud[axis][silent] = np.nan
        if not padding_has_times:
            cloud["timestamp"][silent] = 0.0
        message = bags.cloud_message(stamp, cloud, ros2=False, height=bags.RINGS)
        messages.append(("/rslidar_points", received(stamp), message))
    sequence = RosbagSequence(bags.write_bag(tmp_path / "a.bag", messages), AUTO)
    assert "field 'timestamp', float64 s absolute, 0.0989 s a scan" in sequence.info.notes[0]
    for scan, stamp in zip(sequence.scans(), scan_starts(3), strict=True):
        assert abs(scan.stamp_ns - stamp) <= 256
        np.testing.assert_array_equal(scan.points, SEEN.points[~silent])
        np.testing.assert_array_equal(scan.ring, SEEN.ring[~silent])
        np.testing.assert_allclose(scan.time, SEEN.time[~silent], atol=1e-6)
        assert scan.dropped == silent.sum()


@pytest.mark.parametrize("layout", ["velodyne", "hesai"])
def test_two_returns_of_a_firing_share_its_time_and_ring(tmp_path: Path, layout: str) -> None:
    """Dual return of a Velodyne or Hesai: each firing gives two points, one after the other."""
    dtype, ticks, said = LAYOUTS[layout]
    messages = []
    for stamp in scan_starts(3):
        one = bags.fill(dtype, SEEN, ticks(stamp))
        other = one.copy()
        for axis in "xyz":
            other[axis] *= np.float32(1.5)
        cloud = np.stack([one, other], axis=1).ravel()
        messages.append(("/points", received(stamp), bags.cloud_message(stamp, cloud, ros2=False)))
    sequence = RosbagSequence(bags.write_bag(tmp_path / "a.bag", messages), AUTO)
    assert said in sequence.info.notes[0]
    for scan in sequence.scans():
        np.testing.assert_array_equal(scan.points[::2], SEEN.points)
        np.testing.assert_array_equal(scan.points[1::2], SEEN.points * np.float32(1.5))
        np.testing.assert_allclose(scan.time[::2], SEEN.time, atol=1e-6)
        np.testing.assert_array_equal(scan.time[1::2], scan.time[::2])
        np.testing.assert_array_equal(scan.ring[1::2], SEEN.ring)


def test_messages_that_hold_parts_of_a_sweep_are_noticed(tmp_path: Path) -> None:
    """A Velodyne driver whose npackets is a fifth of a turn's packets; a single turn shows no rate."""
    messages = []
    for stamp in scan_starts(1):
        for part in range(5):
            inside = np.floor(SEEN.time / 0.02 + 1e-6) == part
            cloud = bags.fill(bags.VELODYNE, SEEN, SEEN.time - 0.02 * part)[inside]
            at = stamp + part * 20_000_000
            messages.append(("/points", at + 25_000_000, bags.cloud_message(at, cloud, ros2=False)))
    sequence = RosbagSequence(bags.write_bag(tmp_path / "a.bag", messages), AUTO)
    (note,) = [note for note in sequence.info.notes if "part of a sweep" in note]
    assert note.startswith("each cloud holds a part of a sweep only (at most 80 deg of azimuth)")


def test_a_narrow_view_is_no_part_of_a_sweep(tmp_path: Path) -> None:
    ahead = SEEN.points[:, 0] > np.abs(SEEN.points[:, 1])
    clouds = [bags.fill(bags.VELODYNE, SEEN, SEEN.time)[ahead]] * 4
    path = bags.write_bag(tmp_path / "a.bag", cloud_messages(tmp_path / "a.bag", clouds))
    assert not any("part of a sweep" in note for note in RosbagSequence(path, AUTO).info.notes)
