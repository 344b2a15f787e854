"""Bulk decoding of Imu messages against rosbags' generic decoder."""

from typing import Any

import numpy as np
import pytest

from lio_jax.data.navigation_messages import ImuCollector
from tests.data import bags


def _collect(messages: list[Any], ros2: bool = True) -> ImuCollector:
    collector, types = ImuCollector(ros2), bags.store(ros2)
    for message in messages:
        raw = types.serialize_cdr(message, bags.IMU) if ros2 else types.serialize_ros1(message, bags.IMU)
        collector.add(bytes(raw))
    return collector


@pytest.mark.parametrize("ros2", [False, True])
@pytest.mark.parametrize("frame", ["", "i", "im", "imu", "imu_", "imu_link"])
def test_values_are_those_of_the_messages(ros2: bool, frame: str) -> None:
    rng = np.random.default_rng(3)
    messages = [
        bags.imu_message(
            bags.START_NS + k,
            ros2,
            tuple(rng.normal(size=3)),
            tuple(rng.normal(size=3)),
            tuple(rng.normal(size=4)),
            0.1,
        )
        for k in range(5)
    ]
    for message in messages:
        message.header.frame_id = frame
    imu, repairs = _collect(messages, ros2).imu()
    assert imu is not None
    assert repairs == ()
    np.testing.assert_array_equal(imu.stamp_ns, bags.START_NS + np.arange(5))
    for k, message in enumerate(messages):
        rate, force, rotation = message.angular_velocity, message.linear_acceleration, message.orientation
        assert imu.gyro[k].tolist() == [rate.x, rate.y, rate.z]
        assert imu.accel[k].tolist() == [force.x, force.y, force.z]
        quaternion = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
        np.testing.assert_allclose(imu.orientation[k], quaternion / np.linalg.norm(quaternion))


@pytest.mark.parametrize(
    ("orientation", "covariance"),
    [((0.1, 0.2, 0.3, 0.9), -1.0), ((0.0, 0.0, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0, 1.0), 0.0)],
    ids=["stated as absent", "all zero", "all identity"],
)
def test_an_orientation_that_is_none_is_left_out(orientation: Any, covariance: float) -> None:
    messages = [
        bags.imu_message(k, orientation=orientation, orientation_covariance=covariance) for k in range(3)
    ]
    imu, _ = _collect(messages).imu()
    assert imu is not None
    assert imu.orientation is None


def test_stamps_are_brought_into_order_and_repeats_dropped() -> None:
    order = [10, 30, 20, 20, 40]
    imu, repairs = _collect([bags.imu_message(k, gyro=(float(k), 0.0, 0.0)) for k in order]).imu()
    assert imu is not None
    assert imu.stamp_ns.tolist() == [10, 20, 30, 40]
    assert imu.gyro[:, 0].tolist() == [10.0, 20.0, 30.0, 40.0]
    (repair,) = repairs
    assert repair.startswith(
        "IMU stamps step back in time 1 times and repeat 1 times: the samples were sorted"
    )


def test_samples_that_are_no_numbers_are_dropped() -> None:
    nan = float("nan")
    imu, repairs = _collect([bags.imu_message(1), bags.imu_message(2, gyro=(nan, 0.0, 0.0))]).imu()
    assert imu is not None
    assert imu.stamp_ns.tolist() == [1]
    assert repairs == ("1 IMU samples held NaN or infinity and were dropped.",)


def test_cut_messages_and_no_messages() -> None:
    collector = ImuCollector(True)
    assert collector.imu() == (None, ())
    raw = bytes(bags.store(True).serialize_cdr(bags.imu_message(1), bags.IMU))
    with pytest.raises(ValueError, match="cut short"):
        collector.add(raw[:-1])
