"""An evaluation as a plain-text table."""

import math

from lio_jax.evaluation.evaluate import Evaluation
from lio_jax.evaluation.kitti_segments import SegmentErrors
from lio_jax.evaluation.trajectory_error import PoseError

_LABEL_WIDTH = 30


def format_evaluation(evaluation: Evaluation) -> str:
    """Return an aligned table with units, and the notes below it."""
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
