"""Poses at the rate of the inertial sensor, propagated from the latest corrected state.

The module covers LIO-SAM's IMU odometry and its TransformFusion: the corrected states may be those of the
filter or those of the map.
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
"""Least padded size of a batch. Larger batches are padded to a power of two, so that few shapes compile."""


def poses_at_samples(
    nav: NavState, imu: ImuBatch, start: Float[Array, ""], end: Float[Array, ""]
) -> tuple[jaxlie.SE3, Bool[Array, " m"]]:
    """Return T_world_imu at each of m samples, propagated from the state at ``start``.

    Args:
        nav: the corrected state at ``start``.
        imu: m samples, from the last one before ``start`` to the first one after ``end``. They are in
            ascending order, with the padding last, and all values are finite.
        start: on the lidar's clock, s, from the same origin as the samples' times.
        end: time of the next correction, on the lidar's clock, s.

    Returns:
        The poses (m), and a mask of the valid ones: those of real samples after ``start`` and not after
        ``end``. Elsewhere the pose is that at the nearer end of the span.
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
        stamps_ns: (k,) times of the states on the lidar's clock, ns, ascending.
        states: the k corrected states, at the scans' ends.
        imu_stamps_ns: (n,) times of the samples on the IMU's clock, ns, ascending.
        gyro: (n, 3) angular rates in the IMU frame, rad/s.
        accel: (n, 3) specific forces in the IMU frame, m/s^2.

    Returns:
        (r,) times on the lidar's clock, ns, and the (r, 7) poses T_world_imu there: the quaternion w x y z,
        then the position in m.

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
