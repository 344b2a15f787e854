"""Poses at the inertial sensor's rate, propagated from the latest corrected state anew after each correction.

LIO-SAM's IMU odometry and TransformFusion in one: the corrected states are the filter's or the map's.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.types import ImuBatch, NavState
from lio_jax.imu.strapdown import path_along

_SMALLEST_BATCH = 32
"""Samples a batch is padded to at least; longer ones to a power of two, so that few shapes are compiled."""


def poses_at_samples(
    nav: NavState, imu: ImuBatch, start: Float[Array, ""], end: Float[Array, ""]
) -> tuple[jaxlie.SE3, Bool[Array, " m"]]:
    """Return T_world_imu at each of m samples, propagated from the state at ``start``.

    Args:
        nav: at ``start``, just corrected.
        imu: from the last sample before ``start`` to the first one after ``end``; in ascending order, padding
            last, all values finite.
        start: s, same origin as the samples' times.
        end: when the next correction arrives, s.

    Returns:
        The poses, and where they hold: at real samples after ``start`` and not after ``end``. Elsewhere the
        pose is that at the nearer end.
    """
    path = path_along(nav, imu, start, end)
    time = imu.time.astype(path.time.dtype) - nav.time_offset
    inside = imu.mask & (time > start) & (time <= end)
    # the path's knots are the samples, between its two ends
    return jaxlie.SE3(path.T_world_imu.wxyz_xyz[1:-1]), inside


_poses_at_samples = jax.jit(poses_at_samples)


def imu_rate_trajectory(
    stamps_ns: NDArray[np.int64],
    states: Sequence[NavState],
    imu_stamps_ns: NDArray[np.int64],
    gyro: NDArray[np.float64],
    accel: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the pose at every inertial sample between the first and the last corrected state.

    Args:
        stamps_ns: times of the k states on the lidar's clock, ascending.
        states: corrected, at the scans' ends.
        imu_stamps_ns: times of n samples on the IMU's clock, ascending.
        gyro: (n, 3) rad/s.
        accel: (n, 3) m/s^2.

    Returns:
        Times on the lidar's clock, and as many rows w x y z, position in m, of T_world_imu.

    Raises:
        LioJaxError: if the numbers of stamps and states differ, or times do not ascend.
    """
    if len(stamps_ns) != len(states):
        raise LioJaxError(f"{len(stamps_ns)} stamps were given for {len(states)} states; give one for each.")
    for name, stamps in (("states", stamps_ns), ("inertial samples", imu_stamps_ns)):
        if np.any(np.diff(stamps) < 0):
            raise LioJaxError(f"The times of the {name} do not ascend; sort them.")
    times: list[NDArray[np.int64]] = [np.zeros(0, np.int64)]
    poses: list[NDArray[np.float64]] = [np.zeros((0, 7))]
    for begin, end, nav in zip(stamps_ns[:-1], stamps_ns[1:], states[:-1], strict=True):
        offset = round(float(nav.time_offset) * 1e9)
        first, last = np.searchsorted(imu_stamps_ns, [begin + offset, end + offset], side="right")
        chosen = slice(max(first - 1, 0), min(last + 1, len(imu_stamps_ns)))
        batch = _padded(imu_stamps_ns[chosen] - begin, gyro[chosen], accel[chosen], nav)
        duration = np.asarray((end - begin) * 1e-9, nav.time_offset.dtype)
        found, _ = _poses_at_samples(nav, batch, np.zeros_like(duration), duration)
        # which samples belong to this span is decided on whole nanoseconds: each one exactly once
        rows = np.asarray(found.wxyz_xyz)[first - chosen.start : last - chosen.start]
        times.append(imu_stamps_ns[first:last] - offset)
        poses.append(rows.astype(np.float64))
    return np.concatenate(times), np.concatenate(poses)


def _padded(
    since_ns: NDArray[np.int64], gyro: NDArray[np.float64], accel: NDArray[np.float64], nav: NavState
) -> ImuBatch:
    count = len(since_ns)
    missing = max(_SMALLEST_BATCH, 1 << max(count - 1, 0).bit_length()) - count
    dtype = nav.time_offset.dtype
    # host arrays: jit takes them as they are
    arrays: dict[str, Any] = {
        "time": np.pad(since_ns * 1e-9, (0, missing)).astype(dtype),
        "gyro": np.pad(gyro, ((0, missing), (0, 0))).astype(dtype),
        "accel": np.pad(accel, ((0, missing), (0, 0))).astype(dtype),
        "mask": np.arange(count + missing) < count,
    }
    return ImuBatch(**arrays)
