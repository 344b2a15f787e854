"""Errors of a trajectory against a recording's reference, each pose at its own instant."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.data.trajectory import Trajectory
from lio_jax.evaluation.association import match_by_time
from lio_jax.evaluation.trajectory_error import absolute_error, align, relative_error

_WINDOWS = (1, 10)
"""Numbers of scans between the two poses of a pair, against an INS."""

_LOST_WINDOW_NS, _LOST_M, _LOST_DEG = 1_000_000_000, 0.5, 10.0
"""Time (ns) over which the motion is compared, and errors (m, deg) above which track counts as lost."""


@dataclass(frozen=True)
class Reference:
    """The reference of a recording."""

    kind: str
    """poses: exact poses; ins: exact over short distances only; standing: the vehicle does not move."""
    trajectory: Trajectory
    """T_world_lidar of the reference."""


def score(estimate: Trajectory, reference: Reference) -> dict[str, float]:
    """Return the errors that are meaningful for the kind of reference.

    Args:
        estimate: T_world_lidar, stamped with the instants to which its poses refer.
        reference: reference of the same lidar.

    Returns:
        Values by name; the last part of a name is the unit.
    """
    matched = match_by_time(estimate, reference.trajectory)
    if reference.kind == "poses":
        return _pose_errors(matched.estimate, matched.reference)
    if reference.kind == "standing":
        return _standing_errors(matched.estimate)
    errors: dict[str, float] = {}
    for window in _WINDOWS:
        if window < len(matched):
            errors |= _window_errors(matched.estimate, matched.reference, window)
    return errors


def lost_after(estimate: Trajectory, reference: Trajectory) -> float | None:
    """Return the time (s) at which the motion over a second first has a large error; None if it never has.

    Slow drift is not a loss of track; a stop while the vehicle drives on, or divergence, is.

    Args:
        estimate: poses stamped with the instants to which they refer, ascending.
        reference: poses of the same body.
    """
    matched = match_by_time(estimate, reference)
    stamps = matched.estimate.stamp_ns
    # the pose about a second before each one; those in the first second have none
    before = np.searchsorted(stamps, stamps - _LOST_WINDOW_NS, "right") - 1
    after = np.flatnonzero(before >= 0)
    before = before[after]
    ours, true = (
        np.linalg.inv(trajectory.poses[before]) @ trajectory.poses[after]
        for trajectory in (matched.estimate, matched.reference)
    )
    error = np.linalg.inv(true) @ ours
    wrong = (np.linalg.norm(error[:, :3, 3], axis=1) > _LOST_M) | (_angles_deg(error) > _LOST_DEG)
    if not wrong.any():
        return None
    return float(stamps[after[wrong.argmax()]] - stamps[0]) * 1e-9


def _pose_errors(estimate: Trajectory, reference: Trajectory) -> dict[str, float]:
    absolute = absolute_error(estimate, reference, align(estimate.poses, reference.poses))
    relative = relative_error(estimate, reference)
    errors = {"ate_m": absolute.rmse}
    if relative is not None:
        errors |= {"rpe_m": relative.rmse, "rpe_deg": float(np.rad2deg(relative.rotation_rmse))}
    return errors


def _standing_errors(estimate: Trajectory) -> dict[str, float]:
    moved = np.linalg.inv(estimate.poses[0]) @ estimate.poses
    distance = 100 * np.linalg.norm(moved[:, :3, 3], axis=1)
    angle = _angles_deg(moved)
    return {
        "moved_cm": float(distance[-1]),
        "moved_deg": float(angle[-1]),
        "moved_max_cm": float(distance.max()),
        "moved_max_deg": float(angle.max()),
    }


def _window_errors(estimate: Trajectory, reference: Trajectory, window: int) -> dict[str, float]:
    ours, true = _motions(estimate, window), _motions(reference, window)
    distance = np.linalg.norm(ours[:, :3, 3], axis=1) - np.linalg.norm(true[:, :3, 3], axis=1)
    # the whole vector, not only its length: jitter to the sides shows here, and so does a constant error of
    # the INS heading, the same for every system (on drive 0005 about 2 deg off the direction of travel)
    translation = np.linalg.norm(ours[:, :3, 3] - true[:, :3, 3], axis=1)
    return {
        f"distance{window}_m": _rmse(distance),
        f"translation{window}_m": _rmse(translation),
        f"rotation{window}_deg": _rmse(_angles_deg(np.linalg.inv(true) @ ours)),
    }


def _motions(trajectory: Trajectory, window: int) -> NDArray[np.float64]:
    return np.linalg.inv(trajectory.poses[:-window]) @ trajectory.poses[window:]


def _angles_deg(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.rad2deg(Rotation.from_matrix(poses[:, :3, :3]).magnitude())


def _rmse(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(values**2)))
