"""Bags hold what the sequence held, in the drivers' own layouts."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation

from lio_jax.data import bag_writer
from lio_jax.data.bag_writer import write_bag
from lio_jax.data.config import DataConfig
from lio_jax.data.enu import geodetic_to_enu
from lio_jax.data.native import NativeSequence
from lio_jax.data.native_writer import write_native
from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.sequence import LidarScan
from lio_jax.data.trajectory import pose_matrices
from tests.data import bags
from tests.data.recorded import (
    COLUMNS,
    FIRING_NS,
    FORMATS,
    LAYOUTS,
    ORIGIN,
    PERIOD,
    RINGS,
    SCANS,
    START,
    Recorded,
    recorded_sequence,
    write,
)


@pytest.fixture(scope="module")
def recorded() -> Recorded:
    return recorded_sequence()


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", FORMATS)
def test_native_to_bag_to_reader_gives_the_same(tmp_path: Path, name: str, layout: str) -> None:
    whole = recorded_sequence()
    write_native(
        tmp_path / "native",
        whole.scans(),
        T_imu_lidar=whole.info.T_imu_lidar,
        imu=whole.imu(),
        gps=whole.gps(),
        truth=whole.truth(),
    )
    native = NativeSequence(tmp_path / "native", DataConfig())
    count = write_bag(tmp_path / name, native, bag_format=FORMATS[name], layout=layout)
    assert count == SCANS
    read = RosbagSequence(tmp_path / name, DataConfig())
    assert read.info.scan_count == SCANS
    scans = list(read.scans())
    assert read.warnings_so_far == ()
    extrinsic, note = read.info.notes
    assert note.endswith("header stamp at scan start")
    assert extrinsic.startswith("T_imu_lidar: /tf_static states")
    np.testing.assert_allclose(read.info.T_imu_lidar, whole.info.T_imu_lidar, atol=1e-12)
    for expected, scan in zip(whole.all_scans, scans, strict=True):
        assert scan.stamp_ns == expected.stamp_ns
        np.testing.assert_array_equal(scan.points, expected.points)
        np.testing.assert_array_equal(scan.time, expected.time)
        np.testing.assert_array_equal(scan.ring, expected.ring)
        np.testing.assert_array_equal(scan.intensity, expected.intensity)
    imu = read.imu()
    assert imu is not None
    assert whole.imu_data is not None
    for key in ("stamp_ns", "gyro", "accel"):
        np.testing.assert_array_equal(getattr(imu, key), getattr(whole.imu_data, key))
    assert imu.orientation is None
    gps = read.gps()
    assert gps is not None
    assert whole.gps_data is not None
    np.testing.assert_array_equal(gps.stamp_ns, whole.gps_data.stamp_ns)
    np.testing.assert_array_equal(gps.covariance, whole.gps_data.covariance)
    # the reader's frame begins at the first fix: compare the same points of the earth
    np.testing.assert_allclose(
        geodetic_to_enu(np.array([gps.origin]), ORIGIN)[0], whole.gps_data.position[0], atol=1e-6
    )
    steps = np.linalg.norm(gps.position, axis=1)
    expected = np.linalg.norm(whole.gps_data.position - whole.gps_data.position[0], axis=1)
    np.testing.assert_allclose(steps, expected, atol=1e-6)


def _messages(path: Path) -> dict[str, list[tuple[str, int, Any]]]:
    found: dict[str, list[tuple[str, int, Any]]] = {}
    with AnyReader([path], default_typestore=bags.store(True)) as reader:
        for connection, received, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            found.setdefault(connection.topic, []).append((connection.msgtype, received, message))
    return found


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
@pytest.mark.parametrize(
    ("layout", "topics", "frames"),
    [
        ("velodyne", ("/velodyne_points", "/imu/data"), ("velodyne", "imu_link")),
        ("ouster", ("/os_cloud_node/points", "/os_cloud_node/imu"), ("os_sensor", "os_imu")),
        ("livox", ("/livox/lidar", "/livox/imu"), ("livox_frame", "livox_imu")),
    ],
)
def test_topics_frames_and_order_of_receipt(tmp_path, recorded, name, layout, topics, frames) -> None:
    write(tmp_path / name, recorded, layout)
    found = _messages(tmp_path / name)
    counts = {topic: len(messages) for topic, messages in found.items()}
    assert counts == {
        topics[0]: SCANS,
        topics[1]: 90,
        "/gps/fix": 4,
        "/ground_truth": 41,
        "/tf_static": 1,
    }
    for topic, frame in zip(topics, frames, strict=True):
        assert {message.header.frame_id for _, _, message in found[topic]} == {frame}
    for _, received, message in found[topics[0]]:
        stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
        assert received == stamp + PERIOD + 5_000_000
    first = min(received for messages in found.values() for _, received, _ in messages)
    assert first == found["/tf_static"][0][1] == START - 50_000_000


def test_ground_truth_and_extrinsic(tmp_path: Path, recorded: Recorded) -> None:
    write(tmp_path / "a.bag", recorded)
    found = _messages(tmp_path / "a.bag")
    assert found["/ground_truth"][0][0] == "geometry_msgs/msg/PoseStamped"
    poses = [message.pose for _, _, message in found["/ground_truth"]]
    positions = np.array([[p.position.x, p.position.y, p.position.z] for p in poses])
    turns = np.array([[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in poses])
    truth = recorded.truth_data
    assert truth is not None
    np.testing.assert_array_equal(positions, truth.positions)
    np.testing.assert_allclose(Rotation.from_quat(turns).as_matrix(), truth.poses[:, :3, :3], atol=1e-12)
    ((kind, _, message),) = found["/tf_static"]
    assert kind == "tf2_msgs/msg/TFMessage"
    (stamped,) = message.transforms
    assert (stamped.header.frame_id, stamped.child_frame_id) == ("imu_link", "velodyne")
    move, turn = stamped.transform.translation, stamped.transform.rotation
    made = pose_matrices(np.array([[move.x, move.y, move.z]]), np.array([[turn.x, turn.y, turn.z, turn.w]]))
    np.testing.assert_allclose(made[0], recorded.info.T_imu_lidar, atol=1e-12)


@pytest.mark.parametrize(
    ("layout", "fields", "step"),
    [
        (
            "velodyne",
            [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7)],
            22,
        ),
        (
            "ouster",
            [
                ("x", 0, 7),
                ("y", 4, 7),
                ("z", 8, 7),
                ("intensity", 16, 7),
                ("t", 20, 6),
                ("reflectivity", 24, 4),
                ("ring", 26, 2),
                ("ambient", 28, 4),
                ("range", 32, 6),
            ],
            48,
        ),
    ],
)
def test_fields_are_those_of_the_driver(tmp_path, recorded, layout, fields, step) -> None:
    write(tmp_path / "a.bag", recorded, layout)
    clouds = next(messages for topic, messages in _messages(tmp_path / "a.bag").items() if "points" in topic)
    message = clouds[0][2]
    assert [(field.name, field.offset, field.datatype) for field in message.fields] == fields
    assert {field.count for field in message.fields} == {1}
    points = COLUMNS * RINGS
    assert (message.height, message.width, message.point_step) == (1, points, step)
    assert (message.row_step, len(message.data)) == (points * step, points * step)
    # LIO-SAM refuses clouds that are not dense
    assert message.is_dense
    assert not message.is_bigendian


def test_ouster_ranges_in_mm(tmp_path: Path, recorded: Recorded) -> None:
    write(tmp_path / "a.bag", recorded, "ouster")
    message = _messages(tmp_path / "a.bag")["/os_cloud_node/points"][0][2]
    ranges = np.frombuffer(message.data, np.uint8).reshape(-1, 48)[:, 32:36].copy().view(np.uint32).ravel()
    expected = np.linalg.norm(recorded.all_scans[0].points, axis=1) * 1000
    assert np.abs(ranges - expected).max() < 0.51


@pytest.mark.parametrize("name", ["a.bag", "a.mcap"])
def test_livox_messages_decode_by_their_definition(tmp_path: Path, recorded: Recorded, name: str) -> None:
    write(tmp_path / name, recorded, "livox")
    kind, _, message = _messages(tmp_path / name)["/livox/lidar"][1]
    assert kind == f"livox_ros_driver{'' if name == 'a.bag' else '2'}/msg/CustomMsg"
    scan = recorded.all_scans[1]
    assert message.timebase == scan.stamp_ns
    assert message.point_num == len(message.points) == len(scan.points)
    values = [(p.offset_time, p.x, p.y, p.z, p.reflectivity, p.tag, p.line) for p in message.points]
    offsets, x, y, z, reflectivity, tags, lines = (np.array(column) for column in zip(*values, strict=True))
    # float32 seconds resolve 7.5 ns at 0.1 s
    assert np.abs(offsets - np.repeat(np.arange(COLUMNS) * FIRING_NS, RINGS)).max() <= 4
    np.testing.assert_array_equal(np.stack([x, y, z], axis=1).astype(np.float32), scan.points)
    np.testing.assert_array_equal(reflectivity, scan.intensity)
    np.testing.assert_array_equal(lines, scan.ring)
    assert set(tags) == {0x10}


def test_types_have_the_checksums_that_ros_nodes_expect(tmp_path: Path, recorded: Recorded) -> None:
    """Checksums as the drivers' own builds publish them; a subscriber refuses any other."""
    published = {
        "livox_ros_driver/msg/CustomMsg": "e4d6829bdfe657cb6c21a746c86b21a6",
        "sensor_msgs/msg/Imu": "6a62c6daae103f4ff57a132d6f95cec2",
        "sensor_msgs/msg/NavSatFix": "2d3a8cd499b9b4a0249fb98fd05cfa48",
        "sensor_msgs/msg/PointCloud2": "1158d486dd51d683ce2f1be655c3c181",
        "geometry_msgs/msg/PoseStamped": "d3812c3cbc69362b77dc0b19b345f8f5",
        "tf2_msgs/msg/TFMessage": "94810edda583a504dfda3829e70d7eec",
    }
    seen = {}
    for number, layout in enumerate(("velodyne", "livox")):
        path = tmp_path / str(number) / "a.bag"
        write(path, recorded, layout)
        with AnyReader([path]) as reader:
            seen |= {connection.msgtype: connection.digest for connection in reader.connections}
    assert seen == published


def test_orientation_of_a_nine_axis_unit_is_kept(tmp_path: Path, recorded: Recorded) -> None:
    assert recorded.imu_data is not None
    quaternions = Rotation.random(90, random_state=1).as_quat()
    write(
        tmp_path / "a.mcap", replace(recorded, imu_data=replace(recorded.imu_data, orientation=quaternions))
    )
    imu = RosbagSequence(tmp_path / "a.mcap", DataConfig()).imu()
    assert imu is not None
    assert imu.orientation is not None
    np.testing.assert_allclose(imu.orientation, quaternions, atol=1e-15)


def test_scans_alone_and_an_empty_scan(tmp_path: Path, recorded: Recorded) -> None:
    nothing = np.zeros(0, np.float32)
    empty = LidarScan(
        START + PERIOD, np.zeros((0, 3), np.float32), nothing, np.zeros(0, np.int32), nothing, 0.1
    )
    scans = [recorded.all_scans[0], empty, recorded.all_scans[2]]
    bare = Recorded(replace(recorded.info, T_imu_lidar=None), scans, None, None, None)
    for layout in LAYOUTS:
        for name in ("a.bag", "a.mcap"):
            write(tmp_path / name, bare, layout, overwrite=True)
            read = RosbagSequence(tmp_path / name, DataConfig())
            assert [len(scan.points) for scan in read.scans()] == [960, 0, 960]
            assert read.imu() is None
            assert read.gps() is None
            assert len(_messages(tmp_path / name)) == 1


@pytest.mark.parametrize("name", FORMATS)
def test_same_input_same_bytes_under_any_name(tmp_path: Path, recorded: Recorded, name: str) -> None:
    other = tmp_path / f"other{Path(name).suffix}"
    write(tmp_path / name, recorded)
    write_bag(other, recorded, bag_format=FORMATS[name], layout="velodyne")

    def content(path: Path) -> dict[str, bytes]:
        files = [path] if path.is_file() else sorted(path.iterdir())
        return {"" if file == path else file.name: file.read_bytes() for file in files}

    assert content(tmp_path / name) == content(other)


def test_scans_are_streamed(tmp_path: Path, recorded: Recorded, monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan is serialised before the next but one is asked for."""
    packed: list[int] = []
    original = bag_writer.RosMessages.cloud

    def cloud(self: Any, topic: str, frame: str, stamp_ns: int, *rest: Any) -> Any:
        packed.append(stamp_ns)
        return original(self, topic, frame, stamp_ns, *rest)

    def asked() -> Iterator[LidarScan]:
        for number, scan in enumerate(recorded.all_scans):
            assert len(packed) >= number - 1
            yield scan

    monkeypatch.setattr(bag_writer.RosMessages, "cloud", cloud)
    assert write(tmp_path / "a.bag", recorded, scans=asked()) == SCANS
