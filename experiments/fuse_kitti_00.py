"""Fuse KISS-ICP's poses of KITTI odometry 00 with the drive's inertial samples and GPS fixes.

The samples and the fixes are those that the gtsam wheel brings (KittiEquivBiasedImu.txt and
KittiGps_converted.txt: the OXTS of raw drive 2011_10_03_drive_0027, times of day). KISS-ICP's poses have no
stamps. They get the samples' clock from the rates of rotation: an offset and a period for the whole drive,
then an offset that is linear between knots 20 s apart. The truth plays no part in it.

The file fills seven outages of 1 to 2 s by straight lines between its samples. Samples whose second
differences vanish are left out, and the odometry bridges the gaps.

    python experiments/fuse_kitti_00.py --data FOLDER_WITH_kiss_icp_kitti_00 [--tune] [--out DIR]
"""

import os
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from lio_jax.data.sequence import GpsData, ImuData
from lio_jax.data.trajectory import Trajectory

_PERIOD_S = 470.58 / 4540
"""Mean time between two scans of the sequence, s."""
_KNOTS_S = 20.0
_GPS_SIGMA = (0.5, 0.5, 1.0)

T_IMU_CAMERA = np.array([[0.0, 0, 1, 1.08], [-1, 0, 0, -0.32], [0, -1, 0, 0.72], [0, 0, 0, 1]])
"""Camera 0 in the OXTS frame: the axes' order, and the lever arm from the drive's calibration to 2 cm."""


def recording(folder: Path) -> tuple[Trajectory, Trajectory, ImuData, GpsData]:
    """Return KISS-ICP's poses, the true ones (both of camera 0), samples and fixes in one clock."""
    import gtsam

    source = Path(os.path.dirname(gtsam.__file__)) / "Data"
    table = np.loadtxt(source / "KittiEquivBiasedImu.txt", skiprows=1)
    fixes = np.loadtxt(source / "KittiGps_converted.txt", skiprows=1, delimiter=",")
    origin = table[0, 0]
    bent = np.abs(np.diff(table[:, 2:], 2, axis=0)).max(axis=1) > 1e-9
    real = np.ones(len(table), bool)
    real[1:-1] = bent
    table = table[_outside_of_straight_runs(real)]
    imu = ImuData(_ns(table[:, 0] - origin), table[:, 5:8], table[:, 2:5])
    poses, truth = (
        np.concatenate(
            [
                np.loadtxt(folder / "kiss_icp_kitti_00" / name).reshape(-1, 3, 4),
                np.tile([[[0.0, 0, 0, 1]]], (4541, 1, 1)),
            ],
            axis=1,
        )
        for name in ("00_poses_kitti.txt", "00_gt_kitti.txt")
    )
    stamps = _ns(stamps_of(poses, table[:, 0] - origin, table[:, 5:8]))
    covariance = np.tile(np.diag(np.square(_GPS_SIGMA)), (len(fixes), 1, 1))
    gps = GpsData(_ns(fixes[:, 0] - origin), fixes[:, 1:], covariance, (np.nan,) * 3)
    return Trajectory(stamps, poses), Trajectory(stamps, truth), imu, gps


def _outside_of_straight_runs(real: np.ndarray) -> np.ndarray:
    """Return the mask of samples that are not within a second of interpolated samples."""
    kept = np.ones(len(real), bool)
    share = np.convolve(~real, np.ones(21) / 21, mode="same")
    kept[share > 0.5] = False
    return kept


def _ns(seconds: np.ndarray) -> np.ndarray:
    return np.round(seconds * 1e9).astype(np.int64)


def stamps_of(poses: np.ndarray, time: np.ndarray, gyro: np.ndarray) -> np.ndarray:
    """Return the times of poses on the samples' clock, s, from the rates of rotation about the vertical."""
    between = poses[:-1, :3, :3].transpose(0, 2, 1) @ poses[1:, :3, :3]
    turned = -Rotation.from_matrix(between).as_rotvec()[:, 1]
    angle = np.concatenate([[0], np.cumsum(np.diff(time) * (gyro[1:, 2] + gyro[:-1, 2]) / 2)])
    count = np.arange(len(poses))
    longest = np.flatnonzero(np.diff(time) > 0.1)

    def missed(stamps: np.ndarray) -> np.ndarray:
        difference = np.diff(np.interp(stamps, time, angle)) - turned
        for gap in longest:
            near = (stamps[1:] > time[gap] - 0.1) & (stamps[:-1] < time[gap + 1] + 0.1)
            difference[near] = 0.0
        return difference

    offsets = np.arange(-3.0, 3.0, 0.02)
    first = offsets[np.argmin([np.sum(missed(one + _PERIOD_S * count) ** 2) for one in offsets])]
    line = least_squares(
        lambda x: missed(first + x[0] + (_PERIOD_S + x[1]) * count), np.zeros(2), x_scale=(1e-2, 1e-5)
    ).x
    stamps = first + line[0] + (_PERIOD_S + line[1]) * count
    knots = np.arange(0.0, stamps[-1] + _KNOTS_S, _KNOTS_S)

    def bent(x: np.ndarray) -> np.ndarray:
        return stamps + np.interp(stamps, knots, x)

    def cost(x: np.ndarray) -> np.ndarray:
        return np.concatenate([missed(bent(x)) / 3e-4, np.diff(x) / 1e-2, x / 3e-2])

    return bent(least_squares(cost, np.zeros(len(knots)), x_scale=1e-2).x)
