"""Compare a trajectory with the GPS fixes of a recording, where there is no other truth."""

import dataclasses
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.detect import open_sequence
from lio_jax.data.gps_checks import cleaned
from lio_jax.data.sequence import GpsData
from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.association import in_gap, span
from lio_jax.evaluation.kitti_segments import segment_ends
from lio_jax.evaluation.load import load_trajectory
from lio_jax.loops.gps import GpsGate, Refusal, aligned
from lio_jax.settings.settings import Settings

_FEWEST = 3
_SEGMENT_M = 100.0
_SIGMAS = 3.0
_HEADING_RAD = 0.1
"""Standard deviation of the alignment's yaw above which a note says that the fixes do not fix it."""


@dataclass(frozen=True)
class FixError:
    """Distances of the antenna from the fixes; they contain the errors of the fixes."""

    rmse: float
    """Root mean square, m."""
    median: float
    """Median, m."""
    max: float
    """Largest, m."""
    fix_sigma: float
    """Median standard deviation of one axis that the fixes state, m."""
    inside_3_sigma: float
    """Share of the errors along one axis, in units of the fix's own sigma, below 3: 0.997 if the fixes state
    their errors rightly and the trajectory adds none."""


@dataclass(frozen=True)
class GpsEvaluation:
    """The errors of a trajectory against GPS fixes."""

    compared: int
    """Number of fixes that were compared."""
    fixes: int
    """Number of fixes that the recording holds."""
    left_out: dict[str, int]
    """Number of fixes that were not compared, by reason."""
    path_length_m: float
    """Length of the trajectory over the compared fixes, m."""
    duration_s: float
    """Time from the first to the last compared fix, s."""
    horizontal: FixError
    """Errors in the plane."""
    vertical: FixError
    """Errors of the height."""
    drift_m_per_100_m: float | None
    """Mean change of the horizontal error over 100 m of path, m; None for shorter paths."""
    T_enu_world: list[list[float]]
    """Pose of the trajectory's world in the fixes' frame, (4, 4), m: yaw and translation by least squares."""
    lever_arm: list[float]
    """Position of the antenna in the IMU frame, m."""
    notes: tuple[str, ...]
    """One sentence for each thing a reader must know to trust the numbers."""

    def as_dict(self) -> dict[str, Any]:
        """Return the errors as plain JSON values."""
        return dataclasses.asdict(self)


def evaluate_gps(
    trajectory: Trajectory,
    gps: GpsData,
    settings: Settings | None = None,
    trajectory_name: str = "the trajectory",
    gps_name: str = "the recording",
) -> GpsEvaluation:
    """Compare T_world_imu with fixes by the position of the antenna at the times of the fixes.

    The trajectory is interpolated at the fixes. Fixes with a large variance and fixes that contradict their
    neighbours are left out, as in a run that uses them. The trajectory's world is aligned with the fixes by a
    yaw and a translation, by least squares with the fixes' own covariances. A straight or short way fixes the
    yaw only as well as the errors allow.

    Args:
        trajectory: poses T_world_imu, z up.
        gps: the fixes, on the same clock.
        settings: ``params.gps`` and ``config.backend.gps_elevation`` are read; None: the defaults.
        trajectory_name: name of the trajectory in errors.
        gps_name: name of the fixes' recording in errors.

    Raises:
        LioJaxError: the time spans do not overlap, or fewer than three fixes can be compared.
    """
    settings = settings or Settings()
    values = settings.values["gps"]
    recorded = len(gps.stamp_ns)
    gps, notes = cleaned(gps, "GPS")
    left_out = Counter({"without a possible position, time or order": recorded - len(gps.stamp_ns)})
    trajectory = trajectory.finite()
    if not len(trajectory):
        raise LioJaxError(
            f"{trajectory_name} holds no pose with finite numbers; there is nothing to compare."
        )
    inside = (gps.stamp_ns >= trajectory.stamp_ns[0]) & (gps.stamp_ns <= trajectory.stamp_ns[-1])
    if not inside.any():
        raise LioJaxError(
            f"No GPS fix of {gps_name} lies in the time span of {trajectory_name}: {span(gps.stamp_ns)} "
            f"against {span(trajectory.stamp_ns)}; both must come from the same recording and clock."
        )
    hole = inside & in_gap(gps.stamp_ns, trajectory.stamp_ns)
    left_out["outside the trajectory's time span"] = int(np.sum(~inside))
    left_out["in holes of the trajectory"] = int(np.sum(hole))
    gps = _chosen(gps, inside & ~hole)
    poses = trajectory.at(gps.stamp_ns).poses
    elevation = settings.run.backend.gps_elevation
    gate = GpsGate(gps.stamp_ns, gps.position, gps.covariance, {**values, "min_travel": 0.0}, elevation)
    refused = [gate.doubt(int(stamp), pose) for stamp, pose in zip(gps.stamp_ns, poses, strict=True)]
    left_out.update(_REASONS[refusal] for refusal in refused if refusal is not None)
    kept = np.array([refusal is None for refusal in refused], bool)
    if kept.sum() < _FEWEST:
        reasons = ", ".join(f"{number} {reason}" for reason, number in left_out.items() if number)
        raise LioJaxError(
            f"{gps_name}: {int(kept.sum())} of {recorded} GPS fixes can be compared with {trajectory_name}, "
            f"at least {_FEWEST} are needed; left out: {reasons or 'none'}."
        )
    return _compared(_chosen(gps, kept), poses[kept], values["lever_arm"], recorded, left_out, notes)


_NO_HEADING = (
    "The way is too short or the fixes are too coarse to show the heading: the errors are smaller than they "
    "would be with the true heading."
)
_REASONS = {
    Refusal.VARIANCE: "with a variance above params.gps.max_variance",
    Refusal.JUMP: "that contradict their neighbours (jumps)",
}


def evaluate_gps_files(
    estimate: Path, recording: Path, settings: Settings, used_by_run: bool = False
) -> GpsEvaluation:
    """Compare a trajectory with the fixes of a recording.

    Args:
        estimate: a run folder or a TUM file.
        recording: the recording with the fixes.
        settings: how the recording is read, and ``params.gps``.
        used_by_run: whether the trajectory was corrected by these fixes, which a note states.

    Raises:
        LioJaxError: a file cannot be read, there are no fixes or no stamps, or the times do not overlap.
    """
    loaded = load_trajectory(estimate)
    if not loaded.stamped:
        raise LioJaxError(f"{loaded.source}: has no stamps; give a run folder or a TUM file.")
    sequence = open_sequence(recording, settings.run.data)
    gps = sequence.gps()
    if gps is None or not len(gps.stamp_ns):
        raise LioJaxError(
            f"{recording}: holds no GPS fixes; give the recording that holds them, or name their topic by "
            "--set config.data.gps_topic=NAME."
        )
    found = evaluate_gps(loaded.trajectory, gps, settings, loaded.source, str(recording))
    read = tuple(f"{note}." for note in sequence.info.notes if note.startswith("GPS:"))
    own = ("The run was corrected by fixes (config.backend.gps=true): these are no independent truth.",)
    return dataclasses.replace(found, notes=(*read, *found.notes, *(own if used_by_run else ())))


def _compared(
    gps: GpsData,
    poses: NDArray[np.float64],
    lever_arm: Any,
    recorded: int,
    left_out: Counter[str],
    notes: tuple[str, ...],
) -> GpsEvaluation:
    lever = np.asarray(lever_arm, np.float64)
    antenna = poses[:, :3, :3] @ lever + poses[:, :3, 3]
    T_enu_world, yaw_sigma = aligned(antenna, gps.position, gps.covariance)
    if yaw_sigma > _HEADING_RAD:
        notes += (_NO_HEADING,)
    error = antenna @ T_enu_world[:3, :3].T + T_enu_world[:3, 3] - gps.position
    return GpsEvaluation(
        compared=len(gps.stamp_ns),
        fixes=recorded,
        left_out={reason: number for reason, number in left_out.items() if number},
        path_length_m=float(np.linalg.norm(np.diff(antenna, axis=0), axis=1).sum()),
        duration_s=float(gps.stamp_ns[-1] - gps.stamp_ns[0]) * 1e-9,
        horizontal=_statistics(error[:, :2], gps.covariance[:, :2, :2]),
        vertical=_statistics(error[:, 2:], gps.covariance[:, 2:, 2:]),
        drift_m_per_100_m=_drift(error[:, :2], poses),
        T_enu_world=T_enu_world.tolist(),
        lever_arm=lever.tolist(),
        notes=notes,
    )


def _statistics(error: NDArray[np.float64], covariance: NDArray[np.float64]) -> FixError:
    distance = np.linalg.norm(error, axis=1)
    whitened = np.linalg.solve(np.linalg.cholesky(covariance), error[:, :, None])
    return FixError(
        rmse=float(np.sqrt(np.mean(distance**2))),
        median=float(np.median(distance)),
        max=float(distance.max()),
        fix_sigma=float(np.median(np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)))),
        inside_3_sigma=float(np.mean(np.abs(whitened) <= _SIGMAS)),
    )


def _drift(error: NDArray[np.float64], poses: NDArray[np.float64]) -> float | None:
    starts = np.arange(len(poses))
    ends = segment_ends(poses, starts, np.array([_SEGMENT_M]))[:, 0]
    whole = ends < len(poses)
    if not whole.any():
        return None
    return float(np.mean(np.linalg.norm(error[ends[whole]] - error[starts[whole]], axis=1)))


def _chosen(gps: GpsData, kept: NDArray[np.bool_]) -> GpsData:
    return GpsData(gps.stamp_ns[kept], gps.position[kept], gps.covariance[kept], gps.origin)


_LABEL_WIDTH = 24


def format_gps_evaluation(found: GpsEvaluation) -> str:
    """Return an aligned table with units, followed by what was left out and the notes."""
    lever = ", ".join(f"{value:g}" for value in found.lever_arm)
    head = "".join(f"{name:>11}" for name in ("rmse", "median", "max", "fix sigma", "in 3 sigma"))
    compared = f"{found.compared} of {found.fixes} GPS fixes compared"
    lines = [
        f"{compared}, {found.path_length_m:.2f} m, {found.duration_s:.1f} s; aligned by yaw and translation",
        f"antenna at ({lever}) m in the IMU frame (params.gps.lever_arm)",
        "",
        f"{'':<{_LABEL_WIDTH}}{head}  unit",
        _row("horizontal", found.horizontal),
        _row("vertical", found.vertical),
    ]
    if found.drift_m_per_100_m is None:
        lines.append(f"{'horizontal drift':<{_LABEL_WIDTH}}{'-':>11}  path shorter than 100 m")
    else:
        lines.append(f"{'horizontal drift':<{_LABEL_WIDTH}}{found.drift_m_per_100_m:>11.4f}  m per 100 m")
    if found.left_out:
        lines += ["", *(f"left out: {number} {reason}" for reason, number in found.left_out.items())]
    if found.notes:
        lines += ["", *(f"note: {note}" for note in found.notes)]
    return "\n".join(lines)


def _row(label: str, error: FixError) -> str:
    numbers = "".join(f"{value:>11.4f}" for value in (error.rmse, error.median, error.max, error.fix_sigma))
    return f"{label:<{_LABEL_WIDTH}}{numbers}{100 * error.inside_3_sigma:>9.1f} %  m"
