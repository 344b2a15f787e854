"""Bags of every format and layout become the same scans; every fault is said in one sentence."""

import gc
import re
import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lio_jax.core.config import DataConfig
from lio_jax.core.errors import LioJaxError
from lio_jax.data import rosbag
from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.sequence import LidarScan
from tests.data import bags
from tests.shared_data import SHARED_DATA, needs_shared

AUTO = DataConfig()
SEEN = bags.sweep()
FORMATS = ["a.bag", "a.db3", "a.mcap"]

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


def _stamps(count: int) -> list[int]:
    return [bags.START_NS + number * bags.PERIOD_NS for number in range(count)]


def _received(start_ns: int) -> int:
    return start_ns + bags.PERIOD_NS + 3_000_000


def _clouds(path: Path, clouds: list[np.ndarray], topic: str = "/points") -> list[bags.Message]:
    """Return one message a cloud, at 10 Hz."""
    stamps = _stamps(len(clouds))
    return [
        (topic, _received(stamp), bags.cloud_message(stamp, cloud, bags.is_ros2(path)))
        for stamp, cloud in zip(stamps, clouds, strict=True)
    ]


def _imu_rows(count: int, ros2: bool, gravity: float = 9.8) -> list[bags.Message]:
    step = 10_000_000
    return [
        (
            "/imu",
            bags.START_NS + number * step,
            bags.imu_message(bags.START_NS + number * step, ros2, accel=(0.0, 0.0, gravity)),
        )
        for number in range(count)
    ]


def _sorted(messages: list[bags.Message]) -> list[bags.Message]:
    return sorted(messages, key=lambda message: message[1])


def _check_seen(scan: LidarScan, start_ns: int, tolerance_ns: int = 0) -> None:
    assert abs(scan.stamp_ns - start_ns) <= tolerance_ns
    np.testing.assert_array_equal(scan.points, SEEN.points)
    np.testing.assert_allclose(scan.time, SEEN.time, atol=1e-6)
    np.testing.assert_array_equal(scan.ring, SEEN.ring)
    np.testing.assert_array_equal(scan.intensity, SEEN.intensity)
    assert scan.duration == pytest.approx(SEEN.time.max(), abs=1e-6)
    assert scan.points.dtype == scan.time.dtype == scan.intensity.dtype == np.float32
    assert scan.ring.dtype == np.int32


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", FORMATS)
def test_every_layout_in_every_format(tmp_path: Path, name: str, layout: str) -> None:
    dtype, ticks, said = LAYOUTS[layout]
    clouds = [bags.fill(dtype, SEEN, ticks(stamp)) for stamp in _stamps(3)]
    path = bags.write_bag(tmp_path / name, _clouds(tmp_path / name, clouds))
    sequence = RosbagSequence(path, AUTO)
    assert sequence.info.format == "rosbag"
    assert sequence.info.scan_count == 3
    assert sequence.info.name == "a"
    assert sequence.info.notes == (
        f"per-point time: field {said}, 0.0989 s a scan, header stamp at scan start",
    )
    scans = list(sequence.scans())
    assert len(scans) == 3
    for scan, stamp in zip(scans, _stamps(3), strict=True):
        _check_seen(scan, stamp, 256 if "absolute" in said else 0)
    assert sequence.warnings_so_far == ()
    assert sequence.imu() is None
    assert sequence.gps() is None
    assert sequence.truth() is None
    assert list(sequence.header_stamps()) == _stamps(3)


@pytest.mark.parametrize("kind", bags.LIVOX)
@pytest.mark.parametrize("name", FORMATS)
def test_livox_custom_messages(tmp_path: Path, name: str, kind: str) -> None:
    ros2 = bags.is_ros2(tmp_path / name)
    seen = bags.sweep(rings=4, columns=50)
    cloud = bags.fill(bags.LIVOX_OFFSET_CLOUD, seen, np.round(seen.time * 1e9))
    messages = [
        ("/livox/lidar", _received(stamp), bags.custom_message(stamp, cloud, ros2, kind))
        for stamp in _stamps(3)
    ]
    sequence = RosbagSequence(bags.write_bag(tmp_path / name, messages), AUTO)
    assert "field 'offset_time', uint32 ns relative, 0.0980 s a scan" in sequence.info.notes[0]
    scans = list(sequence.scans())
    assert [scan.stamp_ns for scan in scans] == _stamps(3)
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


@pytest.mark.parametrize("name", FORMATS)
def test_imu_and_gps_come_in_one_pass(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ros2 = bags.is_ros2(tmp_path / name)
    fixes = [
        ("/fix", stamp, bags.fix_message(stamp, 49.0 + 1e-5 * number, 8.0, ros2=ros2))
        for number, stamp in enumerate(_stamps(3))
    ]
    messages = _sorted(bags.velodyne_messages(3, ros2) + _imu_rows(30, ros2, gravity=1.0) + fixes)
    sequence = RosbagSequence(bags.write_bag(tmp_path / name, messages), AUTO)
    opened = []
    real = rosbag.open_bag
    monkeypatch.setattr(rosbag, "open_bag", lambda paths: opened.append(paths) or real(paths))
    imu, gps = sequence.imu(), sequence.gps()
    assert sequence.imu() is imu
    assert len(opened) == 1
    assert imu is not None
    assert gps is not None
    assert imu.stamp_ns.tolist() == [bags.START_NS + 10_000_000 * number for number in range(30)]
    np.testing.assert_allclose(imu.accel, np.tile([0, 0, 9.80665], (30, 1)))
    np.testing.assert_allclose(imu.gyro, np.tile([0.01, -0.02, 0.03], (30, 1)))
    assert gps.stamp_ns.tolist() == _stamps(3)
    np.testing.assert_allclose(gps.position[:, 1], [0, 1.1121, 2.2242], atol=1e-3)
    assert any("accelerometer in g" in note for note in sequence.info.notes)


def test_storage_files_open_alone(tmp_path: Path) -> None:
    for name, suffix in (("a.db3", ".db3"), ("b.mcap", ".mcap")):
        folder = bags.write_bag(tmp_path / name, bags.velodyne_messages(3))
        file = next(folder.glob(f"*{suffix}"))
        for path in (file, folder / "metadata.yaml"):
            assert [scan.stamp_ns for scan in RosbagSequence(path, AUTO).scans()] == _stamps(3)
        (folder / "metadata.yaml").unlink()
        assert [scan.stamp_ns for scan in RosbagSequence(folder, AUTO).scans()] == _stamps(3)


def test_a_database_without_message_definitions(tmp_path: Path) -> None:
    """ROS 2 before Iron stored no definitions: the types rosbags knows must do, and Livox needs none."""
    import sqlite3

    seen = bags.fill(bags.LIVOX_OFFSET_CLOUD, SEEN, np.round(SEEN.time * 1e9))
    livox = [("/livox", _received(stamp), bags.custom_message(stamp, seen, True)) for stamp in _stamps(2)]
    for name, messages in (("a.db3", bags.velodyne_messages(2) + _imu_rows(5, True)), ("b.db3", livox)):
        folder = bags.write_bag(tmp_path / name, messages)
        file = next(folder.glob("*.db3"))
        with sqlite3.connect(file) as database:
            database.executescript("DROP TABLE message_definitions; DROP TABLE schema;")
        database.close()
        sequence = RosbagSequence(file, AUTO)
        assert [scan.stamp_ns for scan in sequence.scans()] == _stamps(2)
        imu = sequence.imu()
        assert imu is None or len(imu.stamp_ns) == 5


@pytest.mark.parametrize("name", FORMATS)
def test_compressed_bags(tmp_path: Path, name: str) -> None:
    messages = bags.velodyne_messages(3, bags.is_ros2(tmp_path / name))
    path = bags.write_bag(tmp_path / name, messages, compressed=True)
    for scan, stamp in zip(RosbagSequence(path, AUTO).scans(), _stamps(3), strict=True):
        _check_seen(scan, stamp)


def test_split_bags_of_one_recording(tmp_path: Path) -> None:
    for number in range(3):
        bags.write_bag(
            tmp_path / f"split_{number}.bag", bags.velodyne_messages(2, ros2=False, first=2 * number)
        )
    bags.write_bag(tmp_path / "imu.bag", _imu_rows(7, ros2=False))
    sequence = RosbagSequence(tmp_path, AUTO)
    assert sequence.info.scan_count == 6
    assert sequence.info.notes[0] == "4 files read as one recording"
    assert [scan.stamp_ns for scan in sequence.scans()] == _stamps(6)
    imu = sequence.imu()
    assert imu is not None
    assert len(imu.stamp_ns) == 7


def test_start_and_count_skip_without_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = bags.write_bag(tmp_path / "a.bag", bags.velodyne_messages(8, ros2=False))
    sequence = RosbagSequence(path, AUTO)
    decoded = []
    real = rosbag.decode_cloud
    monkeypatch.setattr(rosbag, "decode_cloud", lambda *args: decoded.append(1) or real(*args))
    assert [scan.stamp_ns for scan in sequence.scans(5, 2)] == _stamps(8)[5:7]
    assert len(decoded) == 2
    assert list(sequence.scans(8)) == []
    assert list(sequence.scans(2, 0)) == []
    assert len(list(sequence.scans(6))) == 2
    list(sequence.header_stamps())
    assert len(decoded) == 4


def test_of_two_lidars_the_busier_is_taken_and_said(tmp_path: Path) -> None:
    few = bags.velodyne_messages(2, ros2=False, topic="/rear/points")
    path = bags.write_bag(
        tmp_path / "a.bag", _sorted(few + bags.velodyne_messages(3, ros2=False, topic="/front/points"))
    )
    sequence = RosbagSequence(path, AUTO)
    assert len(list(sequence.scans())) == 3
    assert sequence.info.notes[0] == (
        "lidar: topic /front/points was taken (3 messages); there is also "
        "/rear/points (sensor_msgs/msg/PointCloud2, 2): "
        "choose with --set config.data.lidar_topic=/rear/points"
    )
    for name in ("/rear/points", "rear/points"):
        chosen = RosbagSequence(path, replace(AUTO, lidar_topic=name))
        assert len(list(chosen.scans())) == 2
        assert not any("was taken" in note for note in chosen.info.notes)


@pytest.mark.parametrize("key", ["lidar_topic", "imu_topic", "gps_topic"])
def test_a_topic_that_does_not_exist_lists_those_that_do(tmp_path: Path, key: str) -> None:
    path = bags.write_bag(
        tmp_path / "a.bag", _sorted(bags.velodyne_messages(2, ros2=False) + _imu_rows(3, ros2=False))
    )
    with pytest.raises(LioJaxError) as caught:
        RosbagSequence(path, replace(AUTO, **{key: "/none"}))
    assert str(caught.value) == (
        f"{path}: config.data.{key}='/none' is not in the bag; its topics are "
        "/imu (sensor_msgs/msg/Imu, 3), /points (sensor_msgs/msg/PointCloud2, 2)."
    )


def test_a_topic_of_the_wrong_type(tmp_path: Path) -> None:
    path = bags.write_bag(
        tmp_path / "a.bag", _sorted(bags.velodyne_messages(2, ros2=False) + _imu_rows(3, ros2=False))
    )
    with pytest.raises(
        LioJaxError, match=r"'/imu' is sensor_msgs/msg/Imu, not a point cloud; .* are /points"
    ):
        RosbagSequence(path, replace(AUTO, lidar_topic="/imu"))
    with pytest.raises(LioJaxError, match=r"not a NavSatFix or an Odometry; .* are not in the bag"):
        RosbagSequence(path, replace(AUTO, gps_topic="/imu"))


def test_a_bag_without_point_clouds_lists_its_topics(tmp_path: Path) -> None:
    path = bags.write_bag(tmp_path / "a.bag", _imu_rows(3, ros2=False))
    with pytest.raises(
        LioJaxError, match=r"a.bag: no topic holds point clouds .* /imu \(sensor_msgs/msg/Imu, 3\)"
    ):
        RosbagSequence(path, AUTO)


def test_an_empty_bag(tmp_path: Path) -> None:
    for name in ("a.bag", "b.db3", "c.mcap"):
        path = bags.write_bag(tmp_path / name, [])
        with pytest.raises(LioJaxError, match=r"no topic holds point clouds .* its topics are none"):
            RosbagSequence(path, AUTO)


def test_odometry_is_gps_only_if_named_or_chosen(tmp_path: Path) -> None:
    def with_odometry(name: str, topic: str) -> Path:
        rows = [(topic, stamp, bags.odometry_message(stamp, (1.0, 2.0, 3.0), False)) for stamp in _stamps(2)]
        return bags.write_bag(tmp_path / name, _sorted(bags.velodyne_messages(2, ros2=False) + rows))

    estimate = with_odometry("a.bag", "/odom")
    sequence = RosbagSequence(estimate, AUTO)
    assert sequence.gps() is None
    assert any("--set config.data.gps_topic=/odom" in note for note in sequence.info.notes)
    for chosen in (
        RosbagSequence(estimate, replace(AUTO, gps_topic="/odom")),
        RosbagSequence(with_odometry("b.bag", "/odometry/gps"), AUTO),
    ):
        gps = chosen.gps()
        assert gps is not None
        np.testing.assert_array_equal(gps.position, [[1, 2, 3], [1, 2, 3]])


def test_an_empty_scan_in_the_middle_is_yielded_and_reported(tmp_path: Path) -> None:
    full = bags.fill(bags.VELODYNE, SEEN, SEEN.time)
    nothing = full.copy()
    for axis in "xyz":
        nothing[axis] = np.nan
    path = bags.write_bag(
        tmp_path / "a.db3", _clouds(tmp_path / "a.db3", [full, full[:0], full, nothing, full])
    )
    sequence = RosbagSequence(path, AUTO)
    scans = list(sequence.scans())
    assert [len(scan.points) for scan in scans] == [len(full), 0, len(full), 0, len(full)]
    assert [scan.stamp_ns for scan in scans] == _stamps(5)
    for scan in scans:
        assert scan.points.shape == (len(scan.time), 3)
        assert scan.duration == pytest.approx(0.0989, abs=1e-3)
    assert len(sequence.warnings_so_far) == 2
    assert "a: scan 1 (1700000000.223456789 s) holds no points." in sequence.warnings_so_far
    list(sequence.scans())
    assert len(sequence.warnings_so_far) == 2


def test_duplicate_and_backward_stamps_are_left_out(tmp_path: Path) -> None:
    messages = [
        (
            "/points",
            _received(bags.START_NS) + place,
            bags.cloud_message(stamp, bags.fill(bags.VELODYNE, SEEN, SEEN.time)),
        )
        for place, stamp in enumerate([_stamps(5)[k] for k in (0, 1, 1, 3, 2, 4)])
    ]
    sequence = RosbagSequence(bags.write_bag(tmp_path / "a.mcap", messages), replace(AUTO, stamp_at="start"))
    assert [scan.stamp_ns for scan in sequence.scans()] == [_stamps(5)[k] for k in (0, 1, 3, 4)]
    assert len(sequence.warnings_so_far) == 2
    assert "scan 2 has the same stamp" in sequence.warnings_so_far[0]
    assert "scan 4" in sequence.warnings_so_far[1]
    assert "out of order" in sequence.warnings_so_far[1]


def test_a_message_that_cannot_be_decoded_is_skipped(tmp_path: Path) -> None:
    messages = bags.velodyne_messages(4, ros2=False)
    messages[1][2].width += 1
    sequence = RosbagSequence(bags.write_bag(tmp_path / "a.bag", messages), AUTO)
    assert [scan.stamp_ns for scan in sequence.scans()] == [_stamps(4)[k] for k in (0, 2, 3)]
    (warning,) = sequence.warnings_so_far
    assert warning.startswith("a.bag: scan 1 cannot be read and was skipped: 1 x 1441 points of 22 bytes")


def test_only_messages_that_cannot_be_decoded(tmp_path: Path) -> None:
    messages = bags.velodyne_messages(2, ros2=False)
    for message in messages:
        message[2].width += 1
    path = bags.write_bag(tmp_path / "a.bag", messages)
    with pytest.raises(
        LioJaxError, match=r"a.bag: topic /points: no point cloud can be read \(1 x 1441 points"
    ):
        RosbagSequence(path, AUTO)


def test_a_cloud_without_coordinates(tmp_path: Path) -> None:
    cloud = np.zeros(4, np.dtype([("range", "<f4"), ("x", "<f4")]))
    path = bags.write_bag(tmp_path / "a.bag", _clouds(tmp_path / "a.bag", [cloud]))
    with pytest.raises(LioJaxError, match=r"a.bag: topic /points.*no field 'y' or 'z'.*range, x"):
        RosbagSequence(path, AUTO)


def test_missing_ring_and_time_are_reconstructed_and_said(tmp_path: Path) -> None:
    order = np.argsort(SEEN.time, kind="stable")
    cloud = bags.fill(bags.PLAIN, SEEN)[order]
    path = bags.write_bag(tmp_path / "a.bag", _clouds(tmp_path / "a.bag", [cloud] * 3))
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


def test_a_time_field_with_a_single_value_is_as_good_as_none(tmp_path: Path) -> None:
    cloud = bags.fill(bags.VELODYNE, SEEN, np.zeros(len(SEEN.time)))
    path = bags.write_bag(tmp_path / "a.bag", _clouds(tmp_path / "a.bag", [cloud] * 3))
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
    clouds = [bags.fill(bags.HESAI, SEEN, stamp * 1e-9 + SEEN.time) for stamp in _stamps(4)]
    clouds[2]["timestamp"][5] = 0.0
    sequence = RosbagSequence(bags.write_bag(tmp_path / "a.bag", _clouds(tmp_path / "a.bag", clouds)), AUTO)
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


def _many(path: Path, count: int) -> list[bags.Message]:
    """Return noise that does not compress, so that chunks of the file belong to few scans each."""
    rng = np.random.default_rng(0)
    clouds = []
    for _ in range(count):
        cloud = np.zeros(20_000, bags.VELODYNE)
        for axis in "xyz":
            cloud[axis] = rng.normal(size=cloud.size)
        cloud["time"] = np.linspace(0.0, 0.099, cloud.size)
        clouds.append(cloud)
    return _clouds(path, clouds)


def _storage(path: Path) -> Path:
    return (
        path if path.is_file() else next(file for file in path.iterdir() if file.suffix in (".db3", ".mcap"))
    )


def _spoil(file: Path, name: str) -> None:
    """Damage what the index of the file does not cover, in the middle of its data."""
    data = bytearray(file.read_bytes())
    middle = int(0.6 * len(data))
    if name.endswith(".bag"):
        for record in re.finditer(rb"op=\x02", bytes(data[middle : middle + 600_000])):
            data[middle + record.start() : middle + record.end()] = b"\xff" * 4
    elif name.endswith(".mcap"):
        data[middle : middle + 200_000] = bytes(200_000)
    else:
        # A page of a blob begins with the number of the next one; a page of the table with its kind, 13.
        page = next(p for p in range(middle // 4096 * 4096, len(data), 4096) if data[p] == 0)
        data[page : page + 4] = b"\xff\xff\xff\xff"
    file.write_bytes(data)


@pytest.mark.parametrize("name", FORMATS)
def test_damage_in_the_middle_ends_the_scans_with_a_warning(tmp_path: Path, name: str) -> None:
    messages = _sorted(_many(tmp_path / name, 30) + _imu_rows(300, bags.is_ros2(tmp_path / name)))
    path = bags.write_bag(tmp_path / name, messages, compressed=name.endswith(".mcap"))
    _spoil(_storage(path), name)
    sequence = RosbagSequence(path, AUTO)
    stamps = [scan.stamp_ns for scan in sequence.scans()]
    assert 10 < len(stamps) < 25
    assert stamps == _stamps(30)[: len(stamps)]
    (warning,) = sequence.warnings_so_far
    assert f"the bag is damaged after scan {len(stamps) - 1} of 30 (" in warning
    assert warning.startswith(str(path))


def test_damage_keeps_the_inertial_samples_before_it(tmp_path: Path) -> None:
    messages = _sorted(_many(tmp_path / "a.mcap", 30) + _imu_rows(300, ros2=True))
    path = bags.write_bag(tmp_path / "a.mcap", messages, compressed=True)
    _spoil(_storage(path), "a.mcap")
    sequence = RosbagSequence(path, AUTO)
    inertial = sequence.imu()
    assert inertial is not None
    assert 100 < len(inertial.stamp_ns) < 250
    assert "IMU and GPS samples end there" in sequence.warnings_so_far[0]


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def _big(path: Path, megabytes: int) -> Iterator[bags.Message]:
    cloud = bags.fill(bags.OUSTER, bags.sweep(64, 1024), np.round(bags.sweep(64, 1024).time * 1e9))
    message = bags.cloud_message(bags.START_NS, cloud, bags.is_ros2(path))
    number = 0
    while number * message.data.nbytes < megabytes * 1e6:
        stamp = bags.START_NS + number * bags.PERIOD_NS
        message.header = bags.header(stamp, bags.is_ros2(path))
        yield "/points", _received(stamp), message
        number += 1


@pytest.mark.parametrize(("name", "megabytes"), [("a.bag", 200), ("a.db3", 80), ("a.mcap", 80)])
def test_memory_stays_flat_while_streaming(tmp_path: Path, name: str, megabytes: int) -> None:
    path = bags.write_bag(tmp_path / name, _big(tmp_path / name, megabytes))
    assert _storage(path).stat().st_size > megabytes * 1e6
    sequence = RosbagSequence(path, AUTO)
    for _ in sequence.scans(0, 3):
        pass
    gc.collect()
    before = resident = _resident_mb()
    tracemalloc.start()
    try:
        count = 0
        for scan in sequence.scans():
            count += 1
            assert len(scan.points) == 65_536
            resident = max(resident, _resident_mb())
        peak_mb = tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()
    assert count == sequence.info.scan_count
    assert peak_mb < 30
    assert resident - before < 40
