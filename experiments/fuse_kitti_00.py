"""Fuse KISS-ICP's poses of KITTI odometry 00 with the drive's inertial samples and GPS fixes.

The samples and the fixes are those that the gtsam wheel brings (KittiEquivBiasedImu.txt and
KittiGps_converted.txt: the OXTS of raw drive 2011_10_03_drive_0027, times of day). KISS-ICP's poses have no
stamps. They get the samples' clock from the rates of rotation: an offset and a period for the whole drive,
then an offset that is linear between knots 20 s apart. The truth plays no part in it.

The file fills seven outages of 1 to 2 s by straight lines between its samples. Samples whose second
differences vanish are left out, and the odometry bridges the gaps.

    python experiments/fuse_kitti_00.py --data FOLDER_WITH_kiss_icp_kitti_00 [--trials N] [--halves]
"""

import argparse
import math
import os
from dataclasses import replace
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from lio_jax.core.leaf import traced
from lio_jax.data.sequence import GpsData, ImuData
from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.evaluate import evaluate
from lio_jax.evaluation.kitti_segments import kitti_errors
from lio_jax.evaluation.trajectory_error import nees
from lio_jax.fusion.params import FusionParams
from lio_jax.fusion.prepare import prepare_fusion, within
from lio_jax.fusion.recording import FusedRecording, solved
from lio_jax.fusion.tune import NOISES, SCALE, read, replaced, tune

_PERIOD_S = 470.58 / 4540
"""Mean time between two scans of the sequence, s."""
_KNOTS_S = 20.0
_GPS_SIGMA = (0.15, 0.15, 0.3)
BENCHMARK_OVER_FILE = 1.0019
"""Length in the benchmark's Mercator projection over that in the file of fixes: found by comparison with the
truth, where a scale and a shift of 0.05 s of the clock leave 0.06 m of differences. It is no noise that a
fusion could find."""

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
    # the lone sample 1.9 s before the others would only take in KISS-ICP's first poses, found from rest
    table = table[_outside_of_straight_runs(real)][1:]
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


def errors_of(poses: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return the benchmark's translation error, and the same with one constant turn of the sensor, %."""
    turn = np.eye(4)
    turn[:3, :3] = constant_turn(poses, truth)
    plain, turned = kitti_errors(poses, truth), kitti_errors(poses @ turn, truth)
    assert plain is not None
    assert turned is not None
    return plain.translation_percent, turned.translation_percent


def constant_turn(poses: np.ndarray, truth: np.ndarray, stride: int = 20) -> np.ndarray:
    """Return the rotation of the sensor for which ways over two seconds agree best with the true ones."""
    own = np.linalg.inv(poses[:-stride]) @ poses[stride:]
    true = np.linalg.inv(truth[:-stride]) @ truth[stride:]

    def missed(x: np.ndarray) -> np.ndarray:
        return (own[:, :3, 3] @ Rotation.from_rotvec(x).as_matrix() - true[:, :3, 3]).ravel()

    found = least_squares(missed, np.zeros(3), loss="soft_l1", f_scale=0.05).x
    return Rotation.from_rotvec(found).as_matrix()


def consistency(fused: FusedRecording, truth: np.ndarray) -> float:
    """Return the mean NEES per degree of freedom of the poses relative to the first one."""
    poses = fused.sensor.poses
    error = np.linalg.inv(np.linalg.inv(poses[0]) @ poses) @ np.linalg.inv(truth[0]) @ truth
    tangent = np.concatenate([Rotation.from_matrix(error[:, :3, :3]).as_rotvec(), error[:, :3, 3]], axis=1)
    later = slice(10, None)
    return float(nees(tangent[later], fused.covariance[later]).mean() / 6)


def parameters() -> FusionParams:
    """Return the defaults with the drive's lever arm, and with clocks and mounting to be found."""
    names = (
        "extrinsics.translation_sigma",
        "odometry.time_offset_sigma",
        "gps.time_offset_sigma",
        *NOISES,
    )
    values = (0.02, 0.01, 0.1, 7.2e-4, 3.8e-3, 3.1e-4, 9.8e-3, 3.1e-4, 2.3e-3, 1.3e-5, 1.4e-4)
    params = replaced(traced(FusionParams), names, jnp.asarray(values))
    return eqx.tree_at(lambda p: p.extrinsics.translation, params, jnp.asarray(T_IMU_CAMERA[:3, 3]))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--trials", type=int, default=0, help="of the search for noise; 0: the noise found")
    parser.add_argument("--halves", action="store_true", help="also find the noise in both halves")
    options = parser.parse_args()
    odometry, truth, imu, gps = recording(options.data)
    kept = within(odometry, imu)
    true = truth.poses[np.isin(truth.stamp_ns, kept.stamp_ns)]
    params = parameters()
    print(f"{'':34}{'KITTI %':>9}{'turned %':>9}{'ATE m':>9}{'NEES/dof':>10}")
    print_row("KISS-ICP alone", kept, true, math.nan)
    problem, states = prepare_fusion(odometry, imu, None, params)
    if options.trials:
        found = tune(problem, params, states, trials=options.trials)
        params, states = found.params, found.states
    row("with IMU", solved(kept, problem, states, params), true)
    # the file's projection makes the drive shorter than the benchmark's does
    for scale, label in ((1.0, "with IMU and GPS"), (BENCHMARK_OVER_FILE, "with IMU and GPS, rescaled")):
        fixes = replace(gps, position=gps.position * scale)
        problem, states = prepare_fusion(odometry, imu, fixes, params)
        own = params
        if options.trials:
            own, states, _ = tune(problem, params, states, (SCALE,), trials=options.trials)
        row(label, solved(kept, problem, states, own), true)
    print("noise", dict(zip(NOISES, read(params, NOISES).tolist(), strict=True)))
    if options.halves:
        middle = len(odometry) // 2
        for name, part in (("first half", slice(None, middle)), ("second half", slice(middle, None))):
            half = Trajectory(odometry.stamp_ns[part], odometry.poses[part])
            problem, states = prepare_fusion(half, imu, None, params)
            found = tune(problem, params, states, trials=options.trials or 12)
            print(name, dict(zip(NOISES, read(found.params, NOISES).tolist(), strict=True)), flush=True)


def row(label: str, fused: FusedRecording, true: np.ndarray) -> None:
    """Print one row of the table, and the pose of the camera in the IMU's frame."""
    print_row(label, fused.sensor, true, consistency(fused, true))
    turn = Rotation.from_matrix(T_IMU_CAMERA[:3, :3].T @ fused.T_imu_sensor[:3, :3]).as_rotvec()
    print(f"  turn from the axes' order {turn.round(4).tolist()} rad, scale {fused.scale:.5f}", flush=True)


def print_row(label: str, sensor: Trajectory, true: np.ndarray, consistent: float) -> None:
    """Print the errors of a trajectory."""
    plain, turned = errors_of(sensor.poses, true)
    ate = evaluate(sensor, Trajectory(sensor.stamp_ns, true)).ate.rmse
    print(f"{label:34}{plain:9.3f}{turned:9.3f}{ate:9.3f}{consistent:10.2f}", flush=True)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
