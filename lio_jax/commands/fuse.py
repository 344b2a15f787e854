"""``lio-jax fuse``: fuse the poses of any odometry with inertial samples and GPS fixes."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import yaml

from lio_jax.commands.calibrate_imu import imu_of
from lio_jax.commands.runtime import say
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import atomic_path, parse_yaml
from lio_jax.core.leaf import numbers_of, settings_of, traced
from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.data.gps_text import read_gps_text
from lio_jax.data.imu_checks import cleaned
from lio_jax.data.imu_text import read_imu_text
from lio_jax.data.sequence import GpsData, ImuData
from lio_jax.data.trajectory import Trajectory, tum_lines
from lio_jax.evaluation.evaluate import Evaluation, evaluate, format_evaluation
from lio_jax.evaluation.load import load_trajectory
from lio_jax.fusion.params import FusionParams
from lio_jax.fusion.prepare import prepare_fusion, within
from lio_jax.fusion.recording import FusedRecording, solved
from lio_jax.fusion.tune import tune as tuned
from lio_jax.run.folder import run_folder, write_json, write_text

_TEXT = (".csv", ".txt", ".tum", ".dat", ".imu", ".gps")
_FILES = ("trajectory_imu.tum", "trajectory_gps.tum", "trajectory.png", "tuning.json")


def fuse(
    odometry: Path,
    imu: Path,
    gps: Path | None,
    truth: Path | None,
    tune: bool,
    assignments: tuple[str, ...],
    out: Path,
    overwrite: bool,
) -> None:
    """Fuse, write the run folder, and print what was found.

    Raises:
        UsageError: an unknown setting, or a folder that is not empty.
        LioJaxError: a file cannot be read, times do not overlap, or there is no finite solution.
    """
    numbers = _numbers(assignments)
    params = traced(FusionParams, numbers)
    loaded = load_trajectory(odometry)
    if not loaded.stamped:
        raise LioJaxError(f"{odometry}: its poses have no stamps; give lines of 't x y z qx qy qz qw'.")
    samples = _samples(imu)
    fixes = None if gps is None else _fixes(gps)
    reference = None if truth is None else load_trajectory(truth).trajectory
    with run_folder(out, overwrite):
        for name in _FILES:
            (out / name).unlink(missing_ok=True)
        poses = within(loaded.trajectory, samples)
        lost = len(loaded.trajectory) - len(poses)
        if lost:
            say(f"note: {odometry}: {lost} poses outside of the samples' time or not finite were left out.")
        problem, states = prepare_fusion(loaded.trajectory, samples, fixes, params)
        if tune:
            found = tuned(problem, params, states)
            params, states = found.params, found.states
            write_json(out / "tuning.json", {"trials": _plain(found.history)})
            numbers = _values(params)
        fused = solved(poses, problem, states, params)
        if not fused.converged:
            say("warning: the iterations did not converge; the poses are the best ones found.")
        metrics = _metrics(fused)
        compared = None if reference is None else _compared(fused, reference, poses, metrics)
        _write(out, fused, numbers, metrics, reference, gps is not None)
    _show(fused, compared, numbers if tune else None, out)


def _numbers(assignments: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return the settings with assignments such as params.imu.gyro_noise=0.001 applied."""
    known, numbers = settings_of(FusionParams), numbers_of(FusionParams)
    for assignment in assignments:
        path, equals, text = assignment.partition("=")
        path = path.strip().removeprefix("params.")
        if not equals:
            raise UsageError(f"--set {assignment}: write it as path=value, e.g. params.imu.gyro_noise=0.001.")
        if path not in known:
            listed = ", ".join(f"params.{name}" for name in known)
            raise UsageError(f"--set {path}: is no setting of fuse; there are {listed}.")
        declared = known[path].declared
        default = declared.default
        try:
            value = parse_yaml(text)
            read = [float(one) for one in value] if isinstance(default, tuple) else float(value)
        except (TypeError, ValueError):
            raise UsageError(f"--set {path}={text}: is not a number, or a list of numbers.") from None
        if isinstance(read, list) and len(read) != len(default):
            raise UsageError(f"--set {path}={text}: must be a list of {len(default)} numbers.")
        single = read if isinstance(read, list) else [read]
        problems = [declared.problem(read)] if declared.tuned == "turn" else map(declared.problem, single)
        if not np.isfinite(single).all():
            problems = ["must be finite"]
        if wrong := next((problem for problem in problems if problem), ""):
            raise UsageError(f"--set {path}={text}: {wrong}.")
        part, name = path.split(".")
        numbers[part][name] = read
    return numbers


def _values(params: FusionParams) -> dict[str, dict[str, Any]]:
    return {
        part: {name: np.asarray(getattr(getattr(params, part), name)).tolist() for name in names}
        for part, names in numbers_of(FusionParams).items()
    }


def _samples(path: Path) -> ImuData:
    if path.is_file() and path.suffix.lower() in _TEXT:
        imu, note = read_imu_text(path)
        say(f"note: {note}")
        if (np.diff(imu.stamp_ns) < 0).any():
            line = int(np.argmax(np.diff(imu.stamp_ns) < 0)) + 2
            raise LioJaxError(f"{path}: time does not ascend at sample {line}; sort the file.")
        if not (np.isfinite(imu.gyro).all() and np.isfinite(imu.accel).all()):
            raise LioJaxError(f"{path}: holds samples that are not finite; fix or remove them.")
    else:
        imu = imu_of(path)
    imu, messages = cleaned(imu, str(path))
    for sentence in messages:
        say(f"warning: {sentence}")
    if len(imu.stamp_ns) < 2:
        raise LioJaxError(f"{path}: holds fewer than two usable inertial samples.")
    rate = float(np.median(np.linalg.norm(imu.gyro, axis=1)))
    force = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if not 7.0 < force < 13.0:
        raise LioJaxError(
            f"{path}: the median specific force is {force:.3g}, and gravity is 9.8 m/s^2; check its unit."
        )
    if rate > 5.0:
        raise LioJaxError(
            f"{path}: the median angular rate is {rate:.3g}, too much for rad/s; convert it from deg/s."
        )
    return imu


def _fixes(path: Path) -> GpsData:
    if path.is_file() and path.suffix.lower() in _TEXT:
        return read_gps_text(path)
    gps = open_sequence(path, DataConfig()).gps()
    if gps is None or len(gps.stamp_ns) == 0:
        raise LioJaxError(f"{path}: holds no GPS fixes.")
    return gps


def _metrics(fused: FusedRecording) -> dict[str, Any]:
    result = fused.fused
    sigma = np.sqrt(np.diagonal(np.asarray(result.common_covariance)))
    return {
        "poses": len(fused.sensor),
        "fixes": len(fused.problem.fixes.link),
        "status": "converged" if fused.converged else "iteration limit",
        "iterations": int(result.iterations),
        "cost": float(result.cost),
        "negative_log_likelihood": float(result.negative_log_likelihood),
        "T_imu_sensor": fused.T_imu_sensor.tolist(),
        "T_imu_sensor_sigma": {"rotation_rad": sigma[:3].tolist(), "translation_m": sigma[3:6].tolist()},
        "T_level_world": fused.T_level_world.tolist(),
        "gravity": fused.gravity.tolist(),
        "odometry_scale": fused.scale,
        "odometry_scale_sigma": float(sigma[6]),
        "odometry_time_offset_s": fused.time_offset,
        "gps_time_offset_s": fused.fix_offset,
    }


def _compared(
    fused: FusedRecording, truth: Trajectory, poses: Trajectory, metrics: dict[str, Any]
) -> tuple[Evaluation, Evaluation]:
    """Return the errors of the fused trajectory and of the odometry alone, and add them to the metrics."""
    after, before = evaluate(fused.sensor, truth), evaluate(poses, truth)
    metrics |= {key: after.as_dict()[key] for key in ("ate", "rpe", "kitti", "kitti_short_10_80m")}
    metrics["odometry"] = {key: before.as_dict()[key] for key in ("ate", "rpe", "kitti")}
    return after, before


def _write(
    out: Path,
    fused: FusedRecording,
    numbers: dict[str, dict[str, Any]],
    metrics: dict[str, Any],
    truth: Trajectory | None,
    fixed: bool,
) -> None:
    from lio_jax.viz.plot import plot_trajectory

    write_text(out / "trajectory.tum", tum_lines(fused.sensor))
    write_text(out / "trajectory_imu.tum", tum_lines(fused.imu))
    level = Trajectory(fused.sensor.stamp_ns, fused.T_level_world @ fused.sensor.poses)
    if fixed:
        write_text(out / "trajectory_gps.tum", tum_lines(level))
    with atomic_path(out / "states.npz") as aside:
        np.savez(
            aside,
            stamps_ns=fused.sensor.stamp_ns,
            poses=fused.sensor.poses,
            poses_imu=fused.imu.poses,
            covariance=fused.covariance,
            velocity=fused.velocity,
            gyro_bias=fused.gyro_bias,
            accel_bias=fused.accel_bias,
            gravity=fused.gravity,
            T_imu_sensor=fused.T_imu_sensor,
        )
    write_text(out / "config.yaml", yaml.safe_dump({"params": numbers}, sort_keys=False))
    plot_trajectory(out / "trajectory.png", level, truth, "fused trajectory")
    write_json(out / "metrics.json", metrics)


def _plain(history: list[dict[str, float]]) -> list[dict[str, float | None]]:
    return [{key: value if np.isfinite(value) else None for key, value in one.items()} for one in history]


def _show(
    fused: FusedRecording,
    compared: tuple[Evaluation, Evaluation] | None,
    tuned_values: dict[str, dict[str, Any]] | None,
    out: Path,
) -> None:
    links = int(jnp.sum(~fused.problem.imu.measured))
    print(
        f"poses       {len(fused.sensor)}, {len(fused.problem.fixes.link)} fixes, "
        f"{links} links without samples"
    )
    print(
        f"gravity     {json.dumps([round(value, 4) for value in fused.gravity.tolist()])} m/s^2 in the world"
    )
    print(f"odometry    scale {fused.scale:.5f}, clock {fused.time_offset:+.4f} s")
    if tuned_values is not None:
        for part in ("odometry", "imu", "gps"):
            for name, value in tuned_values[part].items():
                if name.endswith(("drift", "noise", "walk", "_scale")):
                    print(f"tuned       params.{part}.{name}={value:.4g}")
    if compared is not None:
        print(format_evaluation(compared[0]))
        for name, errors in zip(("fused", "odometry"), compared, strict=True):
            kitti = "-" if errors.kitti is None else f"{errors.kitti.translation_percent:.4f} %"
            print(f"{name:<12}ATE {errors.ate.rmse:.4f} m, KITTI {kitti}")
    print(f"written     {out}")
