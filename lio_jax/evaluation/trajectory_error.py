"""Absolute and relative pose errors, computed by evo.

Only ``evo.core`` is imported: ``evo.tools`` would write a settings file into the home folder and print.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.alignment import Alignment

if TYPE_CHECKING:
    from evo.core.metrics import PE
    from evo.core.trajectory import PoseTrajectory3D


@dataclass(frozen=True)
class PoseError:
    """Error statistics over poses or pose pairs."""

    rmse: float
    """Root mean square of the translation error, m."""
    mean: float
    """Mean translation error, m."""
    max: float
    """Largest translation error, m."""
    rotation_rmse: float
    """Root mean square of the rotation error, rad."""
    rotation_mean: float
    """Mean rotation error, rad."""
    rotation_max: float
    """Largest rotation error, rad."""
    samples: int
    """Number of poses (absolute) or pose pairs (relative)."""


def absolute_error(estimate: Trajectory, reference: Trajectory, alignment: Alignment) -> PoseError:
    """Return the absolute trajectory error (ATE) after ``alignment``.

    Args:
        estimate: T_world_body.
        reference: T_world_body of the same body frame at the same instants.
        alignment: result of :func:`lio_jax.evaluation.alignment.align`.
    """
    from evo.core.metrics import APE, PoseRelation

    truth = _evo(reference)
    translation = APE(PoseRelation.translation_part)
    translation.process_data((truth, _evo(estimate, alignment.T_reference_estimate)))
    rotation = APE(PoseRelation.rotation_angle_rad)
    rotation.process_data((truth, _evo(estimate, alignment.T_reference_estimate_attitude)))
    return _statistics(translation, rotation)


def relative_error(
    estimate: Trajectory,
    reference: Trajectory,
    delta: float = 1.0,
    unit: Literal["frames", "m"] = "frames",
) -> PoseError | None:
    """Return the relative pose error (RPE) over consecutive pairs ``delta`` apart; None without any pair.

    Args:
        estimate: T_world_body.
        reference: T_world_body of the same body frame at the same instants; pairs by distance follow it.
        delta: distance of a pair, frames or metres travelled.
        unit: unit of ``delta``.
    """
    from evo.core.filters import FilterException
    from evo.core.metrics import RPE, PoseRelation, Unit

    truth, guess = _evo(reference), _evo(estimate)
    errors = []
    for relation in (PoseRelation.translation_part, PoseRelation.rotation_angle_rad):
        metric = RPE(
            relation,
            delta=delta,
            delta_unit=Unit.frames if unit == "frames" else Unit.meters,
            pairs_from_reference=True,
        )
        try:
            metric.process_data((truth, guess))
        except FilterException:
            return None
        errors.append(metric)
    return _statistics(*errors)


def _evo(trajectory: Trajectory, transform: NDArray[np.float64] | None = None) -> "PoseTrajectory3D":
    from evo.core.trajectory import PoseTrajectory3D

    poses = trajectory.poses if transform is None else transform @ trajectory.poses
    seconds = (trajectory.stamp_ns - trajectory.stamp_ns[0]) * 1e-9
    return PoseTrajectory3D(poses_se3=list(poses), timestamps=seconds)


def _statistics(translation: "PE", rotation: "PE") -> PoseError:
    metres, radians = translation.get_all_statistics(), rotation.get_all_statistics()
    return PoseError(
        rmse=float(metres["rmse"]),
        mean=float(metres["mean"]),
        max=float(metres["max"]),
        rotation_rmse=float(radians["rmse"]),
        rotation_mean=float(radians["mean"]),
        rotation_max=float(radians["max"]),
        samples=len(translation.error),
    )
