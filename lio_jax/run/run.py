"""Run a recipe over a recording and leave a run folder behind, whatever happens on the way."""

import resource
import sys
import time
from collections.abc import Iterator
from collections.abc import Sequence as Listing
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import atomic_path
from lio_jax.data.imu_checks import cleaned
from lio_jax.data.prefetch import prefetched
from lio_jax.data.sequence import LidarScan, Sequence
from lio_jax.data.trajectory import Trajectory, write_kitti_poses, write_tum
from lio_jax.imu.params import OrientedImuConfig
from lio_jax.pose_graph.g2o import write_g2o
from lio_jax.recipes.params import InertialConfig
from lio_jax.run.fitted_settings import fitted_to_surroundings, with_sensor_sizes
from lio_jax.run.folder import environment, write_json, write_text
from lio_jax.run.global_correction import GlobalCorrection
from lio_jax.run.keyframes import keyframe_indices, odometry_edges
from lio_jax.run.logs import Overflow, ScanLog, TrajectoryLog, write_imu_rate
from lio_jax.run.map_file import MapFile
from lio_jax.run.scan_inputs import OFFSET_MARGIN_S, ImuFeed
from lio_jax.run.track import CompiledStep, ScanResult, track
from lio_jax.settings.settings import Settings, with_extrinsics


class Observer(Protocol):
    """Something that wants to see every scan's result: a recording, a progress bar."""

    def __call__(self, tracked: ScanResult, scan_ms: float) -> None:
        """Take one result; its arrays must not be kept."""
        ...


@dataclass
class RunResult:
    """What a run computed."""

    trajectory: Trajectory
    """T_world_imu at the scans' ends, corrected where there is a back end."""
    metrics: dict[str, Any]
    """What metrics.json holds."""
    stage_ms: dict[str, list[float]]
    """Time of each stage for each scan."""
    map_points: NDArray[np.float32] | None
    """(n, 3) m in world; None where no map was asked for."""
    odometry: Trajectory | None = None
    """As it was before the back end corrected it; None without one."""
    interruption: BaseException | None = None
    """What ended the run early, where something did."""
    notes: list[str] = field(default_factory=list)


def settings_for(sequence: Sequence, settings: Settings) -> tuple[Settings, list[str]]:
    """Take from the recording what was not given, and say so: T_imu_lidar, sizes of voxels and features."""
    settings, calibration = _calibrated(sequence, settings)
    settings, fitted = fitted_to_surroundings(sequence, settings)
    settings, sizes = with_sensor_sizes(settings, sequence.scans())
    return settings, [calibration, *fitted, *sizes]


def _calibrated(sequence: Sequence, settings: Settings) -> tuple[Settings, str]:
    given = any(
        path.startswith(("params.extrinsics.rot", "params.extrinsics.trans")) for path in settings.given
    )
    if given:
        unused = "" if sequence.info.T_imu_lidar is None else "; the recording's calibration is not used"
        return settings, f"T_imu_lidar: as given in the settings{unused}."
    if sequence.info.T_imu_lidar is None:
        return settings, "T_imu_lidar: not in the recording; taken as identity (set params.extrinsics.*)."
    settings = with_extrinsics(settings, sequence.info.T_imu_lidar, sequence.info.path)
    return settings, "T_imu_lidar: from the recording's calibration."


def run_sequence(
    sequence: Sequence,
    settings: Settings,
    out: Path,
    start: int = 0,
    count: int | None = None,
    observers: Listing[Observer] = (),
    step: CompiledStep | None = None,
) -> RunResult:
    """Estimate the recording's trajectory and map, and write the run folder's files.

    An error or Ctrl-C in the middle ends the run; what was computed until then is written all the same.

    Args:
        sequence: the recording.
        settings: recipe, config and params, the extrinsics resolved.
        out: an existing folder.
        start: first scan.
        count: number of scans; None: to the end.
        observers: called after each scan.
        step: a compiled step of the same settings, to reuse its programs.

    Raises:
        UsageError: the recording ends before ``start``.
        LioJaxError: no scan could be read.
    """
    check_start(sequence, start)
    began = time.perf_counter()
    step = step or CompiledStep(settings)
    imu, imu_notes = imu_feed(sequence, settings)
    log, scan_log = TrajectoryLog(), ScanLog()
    stage_ms: dict[str, list[float]] = {"decode": [], "pad": [], "step": [], "record": [], "total": []}
    failures: list[dict[str, Any]] = []
    overflow = Overflow(settings)
    interruption: BaseException | None = None
    backend = settings.run.backend
    correction = GlobalCorrection(sequence, settings, out) if backend.loops or backend.gps else None
    map_file = MapFile(out / "map.pcd") if settings.run.output.map and not correction else None
    decoded = _timed(sequence.scans(start, count), stage_ms["decode"])
    scans: Any = prefetched(decoded, settings.run.data.prefetch)
    try:
        try:
            # closing: an observer that raises must not leave the decoding thread and its files behind
            with closing(scans):
                for tracked in track(settings, scans, imu, step):
                    recorded_from = time.perf_counter()
                    for stage, value in tracked.stage_ms.items():
                        stage_ms[stage].append(value)
                    overflow.add(tracked)
                    log.append(tracked)
                    scan_log.append(start + tracked.index, tracked)
                    if tracked.failure:
                        failures.append(failure_record(start + tracked.index, tracked))
                    if map_file:
                        map_file.append(new_map_points(tracked))
                    if correction:
                        correction.take(tracked)
                    for observer in observers:
                        observer(tracked, tracked.stage_ms["total"])
                    stage_ms["record"].append((time.perf_counter() - recorded_from) * 1e3)
        except (KeyboardInterrupt, Exception) as error:
            interruption = error
        if not len(log):
            if interruption is not None:
                raise interruption
            reasons = " ".join(sequence.warnings_so_far)
            raise LioJaxError(f"{sequence.info.path}: no scan could be read. {reasons}".strip())
        map_points = map_file.finish() if map_file else None
        trajectory = log.trajectory()
        _write_trajectory(out, log, trajectory)
        _write_states(out, log, settings)
        corrected: dict[str, Any] = {}
        if correction:
            # over what is written already, so that a failure here loses none of it
            trajectory, map_points, corrected = correction.finish(trajectory, interruption is not None)
            _write_trajectory(out, log, trajectory)
        scan_log.write_npz(out / "scans.npz", stage_ms)
        if imu and imu.samples:
            write_imu_rate(out / "imu_rate.tum", log, imu.samples)
    finally:
        if map_file:
            map_file.close()
    metrics = {
        "recording": _described(sequence),
        "scans": len(log),
        "prediction": "inertial samples" if imu else "constant velocity",
        "scan_ms": {stage: percentiles(values) for stage, values in stage_ms.items() if values},
        "compile_s": round(step.compile_s, 4),
        "wall_s": round(time.perf_counter() - began, 4),
        "peak_rss_mb": round(peak_rss_mb(), 1),
        "failures": failures,
        "warnings": [
            *sequence.warnings_so_far,
            *imu_notes,
            *(imu.warnings() if imu else ()),
            *overflow.warnings(),
            *(correction.warnings() if correction else ()),
        ],
        "overflow": overflow.metrics(),
        **({"backend": corrected} if correction else {}),
        "environment": environment(),
    }
    write_json(out / "metrics.json", metrics)
    return RunResult(
        trajectory=trajectory,
        metrics=metrics,
        stage_ms=stage_ms,
        map_points=map_points,
        odometry=log.trajectory() if correction else None,
        interruption=interruption,
    )


def imu_feed(sequence: Sequence, settings: Settings) -> tuple[ImuFeed | None, tuple[str, ...]]:
    """Return the recording's inertial samples, checked, and what was found wrong with them.

    None where the recording holds none or ``config.imu.use`` is false: the recipe then does without.
    """
    config = settings.config
    if not isinstance(config, InertialConfig) or not config.imu.use:
        return None, ()
    recorded = sequence.imu()
    if recorded is None or not len(recorded.stamp_ns):
        return None, ()
    imu, found = cleaned(recorded, "IMU", sequence.info.T_imu_lidar)
    estimated = settings.values["initial"]["time_offset_sigma"] > 0
    margin = OFFSET_MARGIN_S if estimated else 0.0
    offset = settings.values["extrinsics"]["time_offset"]
    own = isinstance(config.imu, OrientedImuConfig) and config.imu.orientation
    return ImuFeed(imu, config.imu.buckets, offset, margin, own), found


def _described(sequence: Sequence) -> dict[str, Any]:
    info = sequence.info
    return {
        "name": info.name,
        "path": info.path,
        "format": info.format,
        "sensor": info.sensor,
        "notes": list(info.notes),
    }


def check_start(sequence: Sequence, start: int) -> None:
    """Refuse a first scan that lies behind the recording's end.

    Raises:
        UsageError: it does; the sentence says how many scans there are.
    """
    info = sequence.info
    if start >= info.scan_count > 0:
        raise UsageError(
            f"{info.path}: holds {info.scan_count} scans, numbered from 0, so none from {start} on; "
            f"start at {info.scan_count - 1} or before."
        )


def new_map_points(tracked: ScanResult) -> NDArray[np.float32]:
    """Return the (n, 3) points a scan added to the map, m in world."""
    output = tracked.output
    points = np.asarray(output.points)[np.asarray(output.added)]
    return (points + np.asarray(output.origin)).astype(np.float32)


def peak_rss_mb() -> float:
    """Return the largest resident memory the process has had, MiB."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1024 * 1024 if sys.platform == "darwin" else 1024)


def _write_trajectory(out: Path, log: TrajectoryLog, trajectory: Trajectory) -> None:
    with atomic_path(out / "trajectory.tum") as aside:
        write_tum(aside, trajectory)
    with atomic_path(out / "trajectory_kitti.txt") as aside:
        write_kitti_poses(aside, trajectory.poses @ log.column("extrinsic"))


def _write_states(out: Path, log: TrajectoryLog, settings: Settings) -> None:
    log.write_npz(out / "states.npz")
    output, trajectory = settings.run.output, log.trajectory()
    chosen = keyframe_indices(trajectory.poses, output.keyframe_distance, output.keyframe_angle)
    poses = trajectory.poses[chosen]
    write_g2o(out / "keyframes.g2o", poses, odometry_edges(poses, log.match_covariances()[chosen]))
    write_text(out / "config.yaml", settings.to_yaml())


def _timed(scans: Iterator[LidarScan], decode_ms: list[float]) -> Iterator[LidarScan]:
    while True:
        start = time.perf_counter()
        scan = next(scans, None)
        if scan is None:
            return
        decode_ms.append((time.perf_counter() - start) * 1e3)
        yield scan


def failure_record(number: int, tracked: ScanResult) -> dict[str, Any]:
    """Return what metrics.json says of a scan that failed; ``number``: in the recording."""
    message = f"scan {number}: {tracked.failure}"
    return {"scan": number, "stamp_ns": tracked.stamp_ns, "message": message}


def percentiles(values: list[float]) -> dict[str, float]:
    """Return what metrics.json says of a stage's times, ms."""
    median, p95, p99 = np.percentile(values, [50, 95, 99])
    return {"median": round(median, 3), "p95": round(p95, 3), "p99": round(p99, 3)}
