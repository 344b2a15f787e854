"""Pick keyframes from a trajectory and chain them into a pose graph."""

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.pose_covariance import carried
from lio_jax.core.settings import Settings
from lio_jax.loops.g2o import Edge
from lio_jax.loops.keyframe import Keyframe
from lio_jax.run.track import Tracked

_LOOSE = np.diag([1e-2] * 3 + [1.0] * 3)
"""Covariance where nothing is known: sigmas of 0.1 rad and 1 m."""


class KeyframePicker:
    """Makes keyframes of those scans that moved or turned enough since the last one."""

    def __init__(self, settings: Settings) -> None:
        sigmas, output = settings.values["backend"], settings.config.output
        self._distance, self._angle = output.keyframe_distance, output.keyframe_angle
        rotation, translation = sigmas["odometry_rotation_sigma"], sigmas["odometry_translation_sigma"]
        self._covariance = np.diag([rotation**2] * 3 + [translation**2] * 3)
        self._last: Keyframe | None = None
        self._failed = False
        self.stamps_ns: list[int] = []
        """Of the keyframes so far."""

    def __call__(self, tracked: Tracked) -> Keyframe | None:
        """Return the scan as a keyframe, or None where it is none.

        What lies between two keyframes is as sure as ``params.backend`` says; it is hardly known where a scan
        between them failed.
        """
        T = tracked.T_world_imu
        self._failed |= bool(tracked.failure)
        if not np.isfinite(T).all() or (
            self._last and not is_keyframe(self._last.T_odom_imu, T, self._distance, self._angle)
        ):
            return None
        self._last = Keyframe(
            index=0 if self._last is None else self._last.index + 1,
            stamp_ns=tracked.stamp_ns,
            T_odom_imu=T,
            points=points_in_imu(tracked),
            covariance=_LOOSE if self._failed else self._covariance,
        )
        self._failed = False
        self.stamps_ns.append(tracked.stamp_ns)
        return self._last


def points_in_imu(tracked: Tracked) -> NDArray[np.float32]:
    """Return the scan's (n, 3) compensated points, m, in the IMU frame at its end."""
    output, T = tracked.output, tracked.T_world_imu
    # small numbers first: points count from a near origin
    from_imu = np.asarray(output.points)[np.asarray(output.points_mask)] + (
        np.asarray(output.origin) - T[:3, 3]
    ).astype(np.float32)
    return from_imu @ T[:3, :3].astype(np.float32)


def corner_marks(tracked: Tracked) -> NDArray[np.bool_] | None:
    """Return which of :func:`points_in_imu` are corners, (n,); None where the recipe does not tell."""
    output = tracked.output
    return None if output.corners is None else np.asarray(output.corners)[np.asarray(output.points_mask)]


def is_keyframe(T_last: NDArray[np.float64], T: NDArray[np.float64], distance: float, angle: float) -> bool:
    """Tell whether a (4, 4) pose is further than ``distance`` (m) or ``angle`` (rad) from the last one."""
    moved = np.linalg.inv(T_last) @ T
    turned = np.arccos(np.clip((np.trace(moved[:3, :3]) - 1) / 2, -1.0, 1.0))
    return bool(np.linalg.norm(moved[:3, 3]) > distance or turned > angle)


def keyframe_indices(poses: NDArray[np.float64], distance: float, angle: float) -> list[int]:
    """Return the poses that moved or turned enough since the last one returned, the first included.

    Args:
        poses: (n, 4, 4).
        distance: m.
        angle: rad.
    """
    chosen = [0]
    for index in range(1, len(poses)):
        if is_keyframe(poses[chosen[-1]], poses[index], distance, angle):
            chosen.append(index)
    return chosen


def odometry_edges(poses: NDArray[np.float64], covariances: NDArray[np.float64]) -> list[Edge]:
    """Return the edges between consecutive poses, their errors taken as independent.

    A relative pose T_i_j = T_i^-1 T_j has covariance S_j + A S_i A', with A the adjoint of T_j_i. Where a
    covariance is unknown the edge gets a sigma of 0.1 rad and 1 m.

    Args:
        poses: (n, 4, 4).
        covariances: (n, 6, 6) of each pose's right perturbation, rotation first; NaN where unknown.
    """
    edges = []
    for i in range(len(poses) - 1):
        T_i_j = np.linalg.inv(poses[i]) @ poses[i + 1]
        covariance = covariances[i + 1] + carried(covariances[i], np.linalg.inv(T_i_j))
        known = np.isfinite(covariance).all()
        edges.append(Edge(i, i + 1, T_i_j, np.linalg.inv(covariance if known else _LOOSE)))
    return edges
