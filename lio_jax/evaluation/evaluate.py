"""Compare a trajectory with a reference, and write the errors as a table."""

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.association import MatchedTrajectories, match_by_index, match_by_time
from lio_jax.evaluation.kitti_segments import SegmentErrors, kitti_errors, kitti_short_errors
from lio_jax.evaluation.load import load_trajectory
from lio_jax.evaluation.trajectory_error import Method, PoseError, absolute_error, align, relative_error

_LABEL_WIDTH = 30


@dataclass(frozen=True)
class Evaluation:
    """The errors of one trajectory against a reference; translations in m, rotations in rad."""

    matched: int
    """Number of estimated poses that have a reference pose."""
    poses: int
    """Number of all estimated poses."""
    path_length_m: float
    """Length of the reference over the matched poses, m."""
    duration_s: float | None
    """Time from the first to the last matched pose, s; None where there are no stamps."""
    alignment: Method
    """How absolute errors were aligned."""
    ate: PoseError
    """Absolute trajectory error."""
    rpe: PoseError | None
    """Relative pose error from each matched pose to the next; None for a single pose."""
    rpe_by_distance: dict[str, PoseError | None]
    """Relative pose error by travelled distance; keys have the form "10 m"."""
    kitti: SegmentErrors | None
    """The KITTI benchmark's drift over 100 to 800 m; None for shorter paths."""
    kitti_short_10_80m: SegmentErrors | None
    """Drift over segments of 10 to 80 m, for short runs only: not comparable with the KITTI benchmark."""
    notes: tuple[str, ...]
    """One sentence for each thing a reader must know to trust the numbers."""

    def as_dict(self) -> dict[str, Any]:
        """Return the errors as plain JSON values; a value that is not finite becomes null."""
        plain: dict[str, Any] = _plain(dataclasses.asdict(self))
        return plain


def evaluate(
    estimate: Trajectory, reference: Trajectory | None, rpe_distances_m: tuple[float, ...] = ()
) -> Evaluation:
    """Compare two trajectories of the SAME body frame; their world frames may differ.

    The reference is interpolated at the estimate's stamps. A comparison of T_world_imu (a run's
    trajectory.tum, a recording's truth) with T_world_lidar (trajectory_kitti.txt) or with a camera's poses
    adds the offset between the sensors to every error: convert one of them with ``Trajectory.times_body``
    first.

    Raises:
        UsageError: the reference is None, as the truth of a recording without one is.
        LioJaxError: the time spans do not overlap, or no pose is finite.
    """
    if reference is None:
        raise UsageError(
            "there is no trajectory to compare with: the recording holds no truth, read one from a file with "
            "lio_jax.read_tum."
        )
    return _compare(match_by_time(estimate, reference), len(estimate), True, rpe_distances_m)


def evaluate_files(
    estimate_path: Path, reference_path: Path, rpe_distances_m: tuple[float, ...] = ()
) -> Evaluation:
    """Load both with :func:`load_trajectory` and compare them, pose by pose if neither has stamps.

    Raises:
        LioJaxError: a file cannot be read, time spans do not overlap, or lengths differ without stamps.
    """
    estimate, reference = load_trajectory(estimate_path), load_trajectory(reference_path)
    stamped = estimate.stamped and reference.stamped
    match = match_by_time if stamped else match_by_index
    matched = match(estimate.trajectory, reference.trajectory, estimate.source, reference.source)
    return _compare(matched, len(estimate.trajectory), stamped, rpe_distances_m)


def _compare(
    matched: MatchedTrajectories, poses: int, stamped: bool, rpe_distances_m: tuple[float, ...]
) -> Evaluation:
    estimate, reference = matched.estimate, matched.reference
    alignment = align(estimate.poses, reference.poses)
    steps = np.linalg.norm(np.diff(reference.positions, axis=0), axis=1)
    return Evaluation(
        matched=len(matched),
        poses=poses,
        path_length_m=float(steps.sum()),
        duration_s=float(reference.stamp_ns[-1] - reference.stamp_ns[0]) * 1e-9 if stamped else None,
        alignment=alignment.method,
        ate=absolute_error(estimate, reference, alignment),
        rpe=relative_error(estimate, reference),
        rpe_by_distance={
            f"{distance:g} m": relative_error(estimate, reference, distance, "m")
            for distance in rpe_distances_m
        },
        kitti=kitti_errors(estimate.poses, reference.poses),
        kitti_short_10_80m=kitti_short_errors(estimate.poses, reference.poses),
        notes=matched.notes + alignment.notes + _body_frame_notes(estimate, reference),
    )


def _body_frame_notes(estimate: Trajectory, reference: Trajectory) -> tuple[str, ...]:
    """Warn if the two move along different body axes, as the poses of two different sensors do."""
    ours, theirs = _travel_direction(estimate), _travel_direction(reference)
    if ours is None or theirs is None or np.dot(ours, theirs) > math.cos(_BODY_AXES_RAD):
        return ()
    axes = [
        f"({', '.join(f'{round(value, 2) + 0.0:.2f}' for value in direction)})"
        for direction in (ours, theirs)
    ]
    note = (
        f"In its own body axes the estimate moves along {axes[0]}, the reference along {axes[1]}: they seem "
        "to be poses of different sensors (IMU, LiDAR, camera), and most numbers hold the offset between "
        "them; convert one to the other's frame."
    )
    return (note,)


def _travel_direction(trajectory: Trajectory) -> NDArray[np.float64] | None:
    """Return the mean direction of travel in body axes; None without one (at rest, or forwards and back)."""
    steps = np.diff(trajectory.positions, axis=0)
    in_body = np.einsum("nij,ni->nj", trajectory.poses[:-1, :3, :3], steps)
    total, travelled = in_body.sum(axis=0), np.linalg.norm(steps, axis=1).sum()
    if travelled < _TRAVEL_FOR_DIRECTION_M or np.linalg.norm(total) < 0.5 * travelled:
        return None
    direction: NDArray[np.float64] = total / np.linalg.norm(total)
    return direction


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def format_evaluation(evaluation: Evaluation) -> str:
    """Return an aligned table with units, followed by the notes."""
    duration = "" if evaluation.duration_s is None else f", {evaluation.duration_s:.1f} s"
    method = {"umeyama": "least squares, no scale", "first_pose": "by the first pose"}[evaluation.alignment]
    compared = f"{evaluation.matched} of {evaluation.poses} poses compared"
    lines = [
        f"{compared}, {evaluation.path_length_m:.2f} m{duration}; ATE aligned {method}",
        "",
        f"{'':<{_LABEL_WIDTH}}{'rmse':>11}{'mean':>11}{'max':>11}  unit",
        *_pose_rows("ATE", evaluation.ate),
        *_pose_rows("RPE, pose to pose", evaluation.rpe),
    ]
    for distance, error in evaluation.rpe_by_distance.items():
        lines += _pose_rows(f"RPE, per {distance}", error)
    lines += ["", f"{'drift over segments':<{_LABEL_WIDTH}}{'%':>11}{'deg/m':>11}{'segments':>11}"]
    lines.append(_segment_row("KITTI, 100 to 800 m", evaluation.kitti))
    lines.append(_segment_row("short run, 10 to 80 m", evaluation.kitti_short_10_80m))
    if evaluation.notes:
        lines += ["", *(f"note: {note}" for note in evaluation.notes)]
    return "\n".join(lines)


def _pose_rows(label: str, error: PoseError | None) -> list[str]:
    if error is None:
        return [f"{label:<{_LABEL_WIDTH}}{'-':>11}{'-':>11}{'-':>11}  too few poses"]
    translation = _number(error.rmse) + _number(error.mean) + _number(error.max)
    rotation = _number(error.rotation_rmse) + _number(error.rotation_mean) + _number(error.rotation_max)
    return [
        f"{label + ' translation':<{_LABEL_WIDTH}}{translation}  m",
        f"{label + ' rotation':<{_LABEL_WIDTH}}{rotation}  rad",
    ]


def _segment_row(label: str, errors: SegmentErrors | None) -> str:
    if errors is None:
        return f"{label:<{_LABEL_WIDTH}}{'-':>11}{'-':>11}{'0':>11}"
    numbers = _number(errors.translation_percent) + _number(errors.rotation_deg_per_m)
    return f"{label:<{_LABEL_WIDTH}}{numbers}{errors.segments:>11}"


def _number(value: float) -> str:
    if not math.isfinite(value):
        return f"{value:>11}"
    if value != 0.0 and abs(value) < 1e-4:
        return f"{value:>11.1e}"
    return f"{value:>11.4f}"


# Directions of travel that differ by more than this belong to two sensors; a smaller difference is an error.
_BODY_AXES_RAD = 0.3
_TRAVEL_FOR_DIRECTION_M = 1.0
