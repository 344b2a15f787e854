"""Align two trajectories, measure absolute and relative errors by evo, and compare errors with
covariances."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from lio_jax.core.errors import UsageError
from lio_jax.data.trajectory import Trajectory

# A reference whose rms distance from its mean (m) is below this gives no direction for an alignment.
_STANDING_SPREAD_M = 0.05
# Positions fix the rotation about the path's main direction to about residual / sideways spread, rad.
_UNRELIABLE_ROTATION_RAD = 0.25

Method = Literal["umeyama", "first_pose"]


@dataclass(frozen=True)
class Alignment:
    """Transforms from the estimate's world to the reference's world."""

    T_reference_estimate: NDArray[np.float64]
    """Transform for positions, (4, 4)."""
    method: Method
    T_reference_estimate_attitude: NDArray[np.float64]
    """Transform for attitudes, (4, 4); it differs where positions do not fix the rotation about the path."""
    notes: tuple[str, ...]


def align(estimate: NDArray[np.float64], reference: NDArray[np.float64]) -> Alignment:
    """Align by least squares on positions (SE3 Umeyama, no scale), where the path allows it.

    If the vehicle stands still, or with fewer than three poses, the first poses are aligned instead. If the
    path is so straight, for the size of the error, that the rotation about it is not observable from
    positions, the least-squares alignment is kept for positions only; attitudes are aligned by the first
    pose. ``notes`` reports both cases.

    Args:
        estimate: (n, 4, 4) T_world_body, m, n >= 1.
        reference: (n, 4, 4) poses of the same body frame at the same instants, m.
    """
    by_first_pose = reference[0] @ np.linalg.inv(estimate[0])
    centred = reference[:, :3, 3] - reference[:, :3, 3].mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False) / np.sqrt(len(reference))
    if len(reference) < 3 or spread[0] < _STANDING_SPREAD_M:
        why = "there are fewer than three poses" if len(reference) < 3 else "the reference hardly moves"
        note = f"Aligned by the first pose, because {why}."
        return Alignment(by_first_pose, "first_pose", by_first_pose, (note,))
    by_positions = _umeyama(estimate[:, :3, 3], reference[:, :3, 3])
    residual = np.sqrt(
        np.mean(np.sum((_positions(by_positions, estimate) - reference[:, :3, 3]) ** 2, axis=1))
    )
    if spread[1] * _UNRELIABLE_ROTATION_RAD > max(residual, 1e-9 * spread[0]):
        return Alignment(by_positions, "umeyama", by_positions, ())
    note = (
        "The positions do not fix the rotation about the path's main direction (path too straight for the "
        "size of the error): attitude errors are taken after alignment by the first pose."
    )
    return Alignment(by_positions, "umeyama", by_first_pose, (note,))


def position_errors(
    alignment: Alignment, estimate: NDArray[np.float64], reference: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (n,) distances between aligned estimate and reference, m."""
    distance: NDArray[np.float64] = np.linalg.norm(
        _positions(alignment.T_reference_estimate, estimate) - reference[:, :3, 3], axis=1
    )
    return distance


def _positions(transform: NDArray[np.float64], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return poses[:, :3, 3] @ transform[:3, :3].T + transform[:3, 3]


def _umeyama(estimate: NDArray[np.float64], reference: NDArray[np.float64]) -> NDArray[np.float64]:
    from evo.core.geometry import GeometryException, umeyama_alignment

    try:
        rotation, translation, _ = umeyama_alignment(estimate.T, reference.T, with_scale=False)
    except GeometryException:
        # evo refuses collinear positions, although each of the equally good rotations would serve positions.
        rotation, translation = _kabsch(estimate, reference)
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation, translation
    return transform


def _kabsch(
    estimate: NDArray[np.float64], reference: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    mean_estimate, mean_reference = estimate.mean(axis=0), reference.mean(axis=0)
    u, _, vt = np.linalg.svd((reference - mean_reference).T @ (estimate - mean_estimate))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return rotation, mean_reference - rotation @ mean_estimate


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
        alignment: result of :func:`lio_jax.evaluation.trajectory_error.align`.
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
    # evo refuses a matrix that is a rotation to a few decimals only, as in files: the nearest one is taken
    wxyz = Rotation.from_matrix(poses[:, :3, :3]).as_quat(scalar_first=True)
    return PoseTrajectory3D(poses[:, :3, 3], wxyz, timestamps=seconds)


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


def nees(error: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normalised estimation error squared, error' covariance^-1 error.

    For a consistent filter it has a chi-square distribution with d degrees of freedom. For the normalised
    innovation squared, pass innovations and their covariances (Bar-Shalom, Li & Kirubarajan, "Estimation with
    applications to tracking and navigation", 2001, section 5.4).

    Args:
        error: (..., d) truth minus estimate, in the tangent space at the estimate.
        covariance: (..., d, d) covariance that the filter states.

    Raises:
        UsageError: a covariance is not positive definite: leave frozen parts of the state out.
    """
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as exc:
        raise UsageError(
            "a covariance is not positive definite: leave frozen parts of the state out"
        ) from exc
    return np.sum(np.linalg.solve(factor, error[..., None]) ** 2, (-2, -1))


def average_band(dof: int, runs: int, probability: float = 0.95) -> tuple[float, float]:
    """Return the two-sided band that contains the average over independent runs with a given probability.

    Args:
        dof: number of degrees of freedom of each value.
        runs: number of independent values in the average.
        probability: probability of the band, between 0 and 1.
    """
    if dof < 1 or runs < 1 or not 0 < probability < 1:
        raise UsageError(
            f"a chi-square band needs dof >= 1, runs >= 1 and 0 < probability < 1, "
            f"not {dof}, {runs} and {probability}"
        )
    outside = (1 - probability) / 2
    low, high = (float(chi2.ppf(share, dof * runs)) / runs for share in (outside, 1 - outside))
    return low, high
