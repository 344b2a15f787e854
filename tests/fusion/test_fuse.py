"""Fusion of made drives against their truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from lio_jax.core.errors import LioJaxError
from lio_jax.data.trajectory import Trajectory
from lio_jax.fusion.recording import fuse_recording
from tests.fusion import made_drive as made


@pytest.fixture(scope="module")
def drive():
    return made.made_drive(seed=1, seconds=12.0)


@pytest.fixture(scope="module")
def fused(drive):
    return fuse_recording(drive.odometry, drive.imu, None, made.true_params())


def pose_errors(fused, truth):
    """Return errors of the poses relative to the first one, (n, 6): rotation (rad), position (m)."""
    own = np.linalg.inv(fused.sensor.poses[0]) @ fused.sensor.poses
    true = np.linalg.inv(truth.poses[0]) @ truth.poses[: len(own)]
    error = np.linalg.inv(own) @ true
    return np.concatenate([Rotation.from_matrix(error[:, :3, :3]).as_rotvec(), error[:, :3, 3]], axis=1)


def test_a_drive_in_motion_gives_mounting_and_gravity_without_calibration(drive, fused):
    assert fused.converged
    covariance = np.asarray(fused.fused.common_covariance)
    found = Rotation.from_matrix(fused.T_imu_sensor[:3, :3])
    turn = (found.inv() * Rotation.from_matrix(made.T_IMU_SENSOR[:3, :3])).as_rotvec()
    assert turn @ np.linalg.solve(covariance[:3, :3], turn) < chi2.ppf(0.999, 3)
    assert np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]) < np.radians(2.0)
    down = made.T_IMU_SENSOR[:3, :3].T @ made.motion(np.zeros(1))[1].inv().apply([0, 0, -1.0])[0]
    level = np.sqrt(np.linalg.eigvalsh(covariance[10:12, 10:12])[-1])
    # the odometry's first pose is the world, and has an error itself
    tilt = np.hypot(level, made.ROTATION_NOISE)
    assert np.arccos(fused.gravity @ down / np.linalg.norm(fused.gravity)) < 4 * tilt
    assert tilt < np.radians(1.0)


def test_the_samples_smooth_the_odometry(drive, fused):
    def steps(poses):
        true = np.linalg.inv(drive.truth.poses[:-1]) @ drive.truth.poses[1:]
        own = np.linalg.inv(poses[:-1]) @ poses[1:]
        return np.sqrt(np.mean((np.linalg.inv(true) @ own)[:, :3, 3] ** 2))

    assert steps(fused.sensor.poses) < 0.3 * steps(drive.odometry.poses)


@pytest.mark.parametrize("gps", [False, True])
def test_errors_have_the_covariance_that_is_stated(gps):
    values = []
    for seed in range(8):
        drive = made.made_drive(seed=10 + seed, seconds=12.0)
        fused = fuse_recording(drive.odometry, drive.imu, drive.gps if gps else None, made.true_params())
        error = pose_errors(fused, drive.truth)[-1]
        values.append(error @ np.linalg.solve(fused.covariance[-1], error))
    low, high = chi2.ppf([0.005, 0.995], 6 * len(values))
    assert low < sum(values) < high


def test_a_gap_in_the_samples_is_bridged_by_the_odometry():
    drive = made.made_drive(seed=4, seconds=12.0, gap=(5.0, 6.5))
    fused = fuse_recording(drive.odometry, drive.imu, None, made.true_params())
    assert fused.converged
    error = pose_errors(fused, drive.truth)
    assert np.abs(error[:, 3:]).max() < 0.5
    assert np.abs(error[:, :3]).max() < 0.05


def test_clocks_without_overlap_are_named(drive):
    late = Trajectory(drive.odometry.stamp_ns + 10**12, drive.odometry.poses)
    with pytest.raises(LioJaxError, match="same clock"):
        fuse_recording(late, drive.imu, None, made.true_params())
    fixes = replace(drive.gps, stamp_ns=drive.gps.stamp_ns + 10**12)
    with pytest.raises(LioJaxError, match="no GPS fix lies within"):
        fuse_recording(drive.odometry, drive.imu, fixes)
