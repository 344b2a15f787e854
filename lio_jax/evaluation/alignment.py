"""The rigid motion that lays an estimate onto a reference before absolute errors are taken."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

# A reference that stays within this rms distance of its mean (m) gives positions no direction to align by.
_STANDING_SPREAD_M = 0.05
# Positions fix the rotation about the path's main direction to about residual / sideways spread, rad.
_UNRELIABLE_ROTATION_RAD = 0.25

Method = Literal["umeyama", "first_pose"]


@dataclass(frozen=True)
class Alignment:
    """World-to-world transforms which map the estimate's world to the reference's."""

    T_reference_estimate: NDArray[np.float64]
    """(4, 4), for positions."""
    method: Method
    T_reference_estimate_attitude: NDArray[np.float64]
    """(4, 4), for attitudes; differs where positions leave the rotation about the path open."""
    notes: tuple[str, ...]


def align(estimate: NDArray[np.float64], reference: NDArray[np.float64]) -> Alignment:
    """Align by least squares on positions (SE3 Umeyama, no scale), where the path allows it.

    A standing vehicle or fewer than three poses are aligned by the first pose instead. A path so straight,
    for the size of the error, that positions do not fix the rotation about it keeps the least-squares
    alignment for positions, and has its attitudes aligned by the first pose. Both are said in ``notes``.

    Args:
        estimate: (n, 4, 4) T_world_body, n >= 1.
        reference: (n, 4, 4) at the same instants, of the same body frame.
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
        # evo refuses collinear positions, although any of the equally good rotations serves positions.
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
