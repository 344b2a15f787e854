"""The extrinsic T_imu_lidar from the frames that a bag's /tf_static, or what is constant in /tf, connects."""

from collections import deque
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

TOPIC = "/tf_static"
TYPE = "tf2_msgs/msg/TFMessage"
REPEATED_TOPIC = "/tf"
"""Topic on which ROS 1's static_transform_publisher of the package tf repeats what is static."""
REPEATED_TYPES = (TYPE, "tf/msg/tfMessage")
_CONSTANT = 1e-6
"""Change of an entry of a transform (m, or of its rotation) up to which it counts as constant."""
_DEFINITION = "geometry_msgs/TransformStamped[] transforms\n"

_Array = NDArray[np.float64]
Transforms = dict[tuple[str, str], _Array]
"""Transforms T_parent_child, (4, 4), by (parent, child)."""


def register_type(typestore: Any) -> None:
    """Register the message type with a store of rosbags that lacks it."""
    from rosbags.typesys import get_types_from_msg

    if TYPE not in typestore.types:
        typestore.register(get_types_from_msg(_DEFINITION, TYPE))


def gathered(messages: Iterable[Any]) -> Transforms:
    """Return the transforms of deserialised TFMessages; a later transform replaces an earlier one.

    A transform that is not a rigid motion (not finite, quaternion not of unit length) is left out.
    """
    found: Transforms = {}
    for message in messages:
        for stamped in message.transforms:
            p, q = stamped.transform.translation, stamped.transform.rotation
            position, quaternion = np.array([p.x, p.y, p.z]), np.array([q.x, q.y, q.z, q.w])
            if not np.isfinite(position).all() or not abs(np.linalg.norm(quaternion) - 1) < 1e-2:
                continue
            T = np.eye(4)
            T[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
            T[:3, 3] = position
            found[frame_name(stamped.header.frame_id), frame_name(stamped.child_frame_id)] = T
    return found


def constant(messages: Iterable[Any]) -> Transforms:
    """Return the transforms that are equal in all deserialised messages: not those of a frame that moves."""
    found: Transforms = {}
    moving: set[tuple[str, str]] = set()
    for message in messages:
        for frames, T in gathered([message]).items():
            if np.abs(T - found.setdefault(frames, T)).max() > _CONSTANT:
                moving.add(frames)
    return {frames: T for frames, T in found.items() if frames not in moving}


def frame_name(name: str) -> str:
    """Return a frame's name as ROS 2 and tf2 write it, without ROS 1's leading slash."""
    return name.strip("/")


def transform_between(transforms: Transforms, target: str, source: str) -> _Array | None:
    """Return the (4, 4) T_target_source along the tree of frames; None where it does not connect them.

    Args:
        transforms: the known transforms.
        target: frame in which points are wanted.
        source: frame in which points are given.
    """
    neighbours: dict[str, list[tuple[str, _Array]]] = {}
    for (parent, child), T_parent_child in transforms.items():
        neighbours.setdefault(parent, []).append((child, T_parent_child))
        T_child_parent: _Array = np.linalg.inv(T_parent_child).astype(np.float64)
        neighbours.setdefault(child, []).append((parent, T_child_parent))
    reached = {target: np.eye(4)}
    waiting = deque([target])
    while waiting:
        frame = waiting.popleft()
        if frame == source:
            return reached[frame]
        for other, T_frame_other in neighbours.get(frame, []):
            if other not in reached:
                reached[other] = reached[frame] @ T_frame_other
                waiting.append(other)
    return None
