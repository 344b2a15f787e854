"""A KITTI raw drive's reference from INS attitude and integrated INS velocity, without GPS position jumps."""

from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from lio_jax.data.kitti_raw import read_oxts
from lio_jax.data.trajectory import Trajectory

_VELOCITY_NORTH, _VELOCITY_EAST, _VELOCITY_UP = 6, 7, 10
_STEP_NS = 2_000_000


def ins_reference(folder: Path) -> Trajectory:
    """Return T_world_imu every 2 ms: spline of the attitudes, integral of a spline of the velocities.

    Samples are dense, so that linear interpolation between them is as exact as the splines.

    Args:
        folder: folder of the drive's OXTS packets (data/ and timestamps.txt).
    """
    packets = read_oxts(folder, print)
    if packets is None:
        raise SystemExit(f"{folder}: holds no packets; there is no reference.")
    stamps, rows = packets.stamp_ns, packets.values
    seconds = (stamps - stamps[0]) * 1e-9
    dense = np.arange(stamps[0], stamps[-1], _STEP_NS)
    query = (dense - stamps[0]) * 1e-9
    velocity = CubicSpline(seconds, rows[:, [_VELOCITY_EAST, _VELOCITY_NORTH, _VELOCITY_UP]])
    attitude = RotationSpline(seconds, Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]))
    poses = np.tile(np.eye(4), (len(dense), 1, 1))
    poses[:, :3, :3] = attitude(query).as_matrix()
    poses[:, :3, 3] = velocity.antiderivative()(query)
    return Trajectory(dense, poses)
