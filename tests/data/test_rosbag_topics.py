"""Which topics of a bag are read, and what IMU and GPS topics become."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lio_jax.core.errors import LioJaxError
from lio_jax.data import rosbag
from lio_jax.data.rosbag import RosbagSequence
from tests.data import bags
from tests.data.bag_recordings import AUTO, FORMATS, imu_messages, in_order, scan_starts


@pytest.mark.parametrize("name", FORMATS)
def test_imu_and_gps_come_in_one_pass(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    ros2 = bags.is_ros2(tmp_path / name)
    fixes = [
        ("/fix", stamp, bags.fix_message(stamp, 49.0 + 1e-5 * number, 8.0, ros2=ros2))
        for number, stamp in enumerate(scan_starts(3))
    ]
    messages = in_order(bags.velodyne_messages(3, ros2) + imu_messages(30, ros2, gravity=1.0) + fixes)
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
    assert gps.stamp_ns.tolist() == scan_starts(3)
    np.testing.assert_allclose(gps.position[:, 1], [0, 1.1121, 2.2242], atol=1e-3)
    assert any("accelerometer in g" in note for note in sequence.info.notes)


def test_of_two_lidars_the_busier_is_taken_and_reported(tmp_path: Path) -> None:
    few = bags.velodyne_messages(2, ros2=False, topic="/rear/points")
    path = bags.write_bag(
        tmp_path / "a.bag", in_order(few + bags.velodyne_messages(3, ros2=False, topic="/front/points"))
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


def test_of_two_imus_the_faster_is_taken_and_reported(tmp_path: Path) -> None:
    """An Ouster publishes its own IMU at 100 Hz as /ouster/imu; another one is mounted beside it."""
    slow = imu_messages(40, ros2=False)
    fast = [("/imu/data", at + half, message) for _, at, message in slow for half in (0, 5_000_000)]
    slow = [("/ouster/imu", at, message) for _, at, message in slow]
    rows = in_order(bags.velodyne_messages(3, ros2=False) + slow + fast)
    path = bags.write_bag(tmp_path / "a.bag", rows)
    sequence = RosbagSequence(path, AUTO)
    assert sequence.info.notes[0] == (
        "imu: topic /imu/data was taken (80 messages); there is also "
        "/ouster/imu (sensor_msgs/msg/Imu, 40): choose with --set config.data.imu_topic=/ouster/imu"
    )
    chosen = RosbagSequence(path, replace(AUTO, imu_topic="/ouster/imu")).imu()
    assert chosen is not None
    assert len(chosen.stamp_ns) == 40


@pytest.mark.parametrize("key", ["lidar_topic", "imu_topic", "gps_topic"])
def test_a_topic_that_does_not_exist_lists_those_that_do(tmp_path: Path, key: str) -> None:
    path = bags.write_bag(
        tmp_path / "a.bag", in_order(bags.velodyne_messages(2, ros2=False) + imu_messages(3, ros2=False))
    )
    with pytest.raises(LioJaxError) as caught:
        RosbagSequence(path, replace(AUTO, **{key: "/none"}))
    assert str(caught.value) == (
        f"{path}: config.data.{key}='/none' is not in the bag; its topics are "
        "/imu (sensor_msgs/msg/Imu, 3), /points (sensor_msgs/msg/PointCloud2, 2)."
    )


def test_a_topic_of_the_wrong_type(tmp_path: Path) -> None:
    path = bags.write_bag(
        tmp_path / "a.bag", in_order(bags.velodyne_messages(2, ros2=False) + imu_messages(3, ros2=False))
    )
    with pytest.raises(
        LioJaxError, match=r"'/imu' is sensor_msgs/msg/Imu, not a point cloud; .* are /points"
    ):
        RosbagSequence(path, replace(AUTO, lidar_topic="/imu"))
    with pytest.raises(LioJaxError, match=r"not a NavSatFix or an Odometry; .* are not in the bag"):
        RosbagSequence(path, replace(AUTO, gps_topic="/imu"))


def test_a_bag_without_point_clouds_lists_its_topics(tmp_path: Path) -> None:
    path = bags.write_bag(tmp_path / "a.bag", imu_messages(3, ros2=False))
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
        rows = [
            (topic, stamp, bags.odometry_message(stamp, (1.0, 2.0, 3.0), False)) for stamp in scan_starts(2)
        ]
        return bags.write_bag(tmp_path / name, in_order(bags.velodyne_messages(2, ros2=False) + rows))

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
