"""The extrinsic from /tf_static: the tree of frames by hand; bags that state it well, badly or not at all."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.data.config import DataConfig
from lio_jax.data.rosbag import RosbagSequence
from lio_jax.data.static_transforms import transform_between
from tests.data import bags
from tests.data.bag_recordings import FORMATS, SEEN, cloud_messages, imu_messages, in_order

HALF = 0.5**0.5
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
TREE = {
    ("base_link", "imu_link"): ((0.1, 0.0, 0.5), (0.0, 0.0, HALF, HALF)),
    ("base_link", "mast"): ((0.0, 0.0, 1.0), UPRIGHT),
    ("mast", "lidar"): ((0.3, 0.2, 0.4), (HALF, 0.0, 0.0, HALF)),
}


def pose(position, quaternion) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(quaternion).as_matrix(), position
    return T


def opened(tmp_path, name: str, transforms) -> RosbagSequence:
    path = tmp_path / name
    ros2 = bags.is_ros2(path)
    clouds = [bags.fill(bags.VELODYNE, SEEN)] * 3
    messages = cloud_messages(path, clouds) + imu_messages(60, ros2)
    if transforms:
        said = bags.transform_message(bags.START_NS, transforms, ros2)
        messages.append(("/tf_static", bags.START_NS, said))
    return RosbagSequence(bags.write_bag(path, in_order(messages)), DataConfig())


@pytest.mark.parametrize("name", FORMATS)
def test_extrinsic_along_the_tree_of_frames(tmp_path, name):
    sequence = opened(tmp_path, name, TREE)
    by_hand = (
        np.linalg.inv(pose(*TREE["base_link", "imu_link"]))
        @ pose(*TREE["base_link", "mast"])
        @ pose(*TREE["mast", "lidar"])
    )
    np.testing.assert_allclose(sequence.info.T_imu_lidar, by_hand, atol=1e-15)
    assert "T_imu_lidar: /tf_static states the pose of lidar in imu_link" in sequence.info.notes


def test_leading_slashes_are_ros_1s(tmp_path):
    tree = {(f"/{parent}", f"/{child}"): value for (parent, child), value in TREE.items()}
    named, plain = opened(tmp_path, "a.bag", tree), opened(tmp_path, "b.bag", TREE)
    np.testing.assert_array_equal(named.info.T_imu_lidar, plain.info.T_imu_lidar)


def repeated(tmp_path, name: str, trees, static=None) -> RosbagSequence:
    """Open a bag in which /tf sends one tree after another."""
    path = tmp_path / name
    ros2 = bags.is_ros2(path)
    messages = cloud_messages(path, [bags.fill(bags.VELODYNE, SEEN)] * 3) + imu_messages(60, ros2)
    for number, tree in enumerate(trees):
        at = bags.START_NS + number * 10_000_000
        messages.append(("/tf", at, bags.transform_message(at, tree, ros2)))
    if static:
        said = bags.transform_message(bags.START_NS, static, ros2)
        messages.append(("/tf_static", bags.START_NS, said))
    return RosbagSequence(bags.write_bag(path, in_order(messages)), DataConfig())


def driving(number: int) -> dict:
    return {("odom", "base_link"): ((0.1 * number, 0.0, 0.0), UPRIGHT)}


@pytest.mark.parametrize("name", FORMATS)
def test_what_tf_repeats_without_change_is_static(tmp_path, name):
    """tf/static_transform_publisher of ROS 1 sends on /tf, with the moving frames of the odometry."""
    sequence = repeated(tmp_path, name, [TREE | driving(number) for number in range(30)])
    expected = opened(tmp_path, f"static_{name}", TREE).info.T_imu_lidar
    np.testing.assert_allclose(sequence.info.T_imu_lidar, expected, atol=1e-15)
    assert "T_imu_lidar: /tf states the pose of lidar in imu_link" in sequence.info.notes


def test_tf_completes_tf_static(tmp_path):
    mast = {key: value for key, value in TREE.items() if "mast" in key}
    rest = {key: value for key, value in TREE.items() if "mast" not in key}
    sequence = repeated(tmp_path, "a.mcap", [rest] * 30, static=mast)
    expected = opened(tmp_path, "b.mcap", TREE).info.T_imu_lidar
    np.testing.assert_allclose(sequence.info.T_imu_lidar, expected, atol=1e-15)


def test_a_frame_that_moves_ties_nothing(tmp_path):
    """The IMU's frame stands at first and moves later, as a second vehicle's would."""
    moves = [
        TREE | {("base_link", "imu_link"): ((0.1 + 0.01 * max(number - 15, 0), 0.0, 0.5), UPRIGHT)}
        for number in range(30)
    ]
    sequence = repeated(tmp_path, "a.bag", moves)
    assert sequence.info.T_imu_lidar is None
    assert "T_imu_lidar: /tf does not tie lidar to imu_link" in sequence.info.notes


def test_frames_that_nothing_ties_together_are_named(tmp_path):
    tree = {key: value for key, value in TREE.items() if "imu_link" not in key}
    sequence = opened(tmp_path, "a.mcap", tree)
    assert sequence.info.T_imu_lidar is None
    assert "T_imu_lidar: /tf_static does not tie lidar to imu_link" in sequence.info.notes


@pytest.mark.parametrize(
    "wrong",
    [((np.nan, 0.0, 0.0), UPRIGHT), ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))],
    ids=["NaN", "no rotation"],
)
def test_what_is_no_rigid_motion_is_left_out(tmp_path, wrong):
    sequence = opened(tmp_path, "a.bag", TREE | {("mast", "lidar"): wrong})
    assert sequence.info.T_imu_lidar is None
    assert any("does not tie" in note for note in sequence.info.notes)


def test_without_static_transforms_nothing_is_reported(tmp_path):
    sequence = opened(tmp_path, "a.bag", None)
    assert sequence.info.T_imu_lidar is None
    assert not any("T_imu_lidar" in note for note in sequence.info.notes)


def test_a_ring_of_frames_ends():
    T = np.eye(4)
    ring = {("a", "b"): T, ("b", "c"): T, ("c", "a"): T}
    assert transform_between(ring, "a", "elsewhere") is None
    np.testing.assert_array_equal(transform_between(ring, "a", "c"), T)
