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
