"""Carry the correction of keyframes over to all poses of the odometry."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

_Array = NDArray[np.float64]


def corrected_poses(
    stamp_ns: NDArray[np.int64],
    T_odom_imu: _Array,
    keyframe_stamp_ns: NDArray[np.int64],
    keyframes_T_odom_imu: _Array,
    keyframes_T_world_imu: _Array,
) -> _Array:
    """Return T_world_imu (n, 4, 4) of poses of the odometry.

    A pose between two keyframes is where each of them sees it, weighed by time; one before the first or
    behind the last is where that one sees it. Keyframes themselves get their own corrected pose.

    Args:
        stamp_ns: (n,) of the poses.
        T_odom_imu: (n, 4, 4).
        keyframe_stamp_ns: (k,) ascending, k > 0.
        keyframes_T_odom_imu: (k, 4, 4).
        keyframes_T_world_imu: (k, 4, 4) as corrected.
    """
    last = len(keyframe_stamp_ns) - 1
    before = np.clip(np.searchsorted(keyframe_stamp_ns, stamp_ns, side="right") - 1, 0, last)
    after = np.minimum(before + 1, last)
    span = (keyframe_stamp_ns[after] - keyframe_stamp_ns[before]).astype(np.float64)
    share = np.clip((stamp_ns - keyframe_stamp_ns[before]) / np.where(span > 0, span, 1.0), 0.0, 1.0)
    T_world_odom = keyframes_T_world_imu @ np.linalg.inv(keyframes_T_odom_imu)
    seen_before, seen_after = T_world_odom[before] @ T_odom_imu, T_world_odom[after] @ T_odom_imu
    turn = Rotation.from_matrix(seen_before[:, :3, :3].transpose(0, 2, 1) @ seen_after[:, :3, :3])
    poses = seen_before.copy()
    part_of_turn = Rotation.from_rotvec(turn.as_rotvec() * share[:, None]).as_matrix()
    poses[:, :3, :3] = seen_before[:, :3, :3] @ part_of_turn
    poses[:, :3, 3] += share[:, None] * (seen_after[:, :3, 3] - seen_before[:, :3, 3])
    return poses


def levelled_onto(T_a_imu: _Array, T_b_imu: _Array) -> _Array:
    """Return T_b_a, a turn about the vertical and a shift, that lays one pose of z-up frame a onto b's.

    The heading agrees as far as a turn about the vertical can make it; the position agrees.

    Args:
        T_a_imu: (4, 4).
        T_b_imu: (4, 4).
    """
    between = T_b_imu[:3, :3] @ T_a_imu[:3, :3].T
    yaw = np.arctan2(between[1, 0] - between[0, 1], between[0, 0] + between[1, 1])
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = Rotation.from_euler("z", yaw).as_matrix()
    T_b_a[:3, 3] = T_b_imu[:3, 3] - T_b_a[:3, :3] @ T_a_imu[:3, 3]
    return T_b_a
