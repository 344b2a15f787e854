"""Write a recording for the viewer while a run goes on."""

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.error_state import ACCEL_BIAS, GYRO_BIAS, POSITION
from lio_jax.run.failures import weak_directions
from lio_jax.run.run import new_map_points
from lio_jax.run.track import ScanResult, pose_matrix
from lio_jax.viz.recording import Recording

_POINTS = 5000


class RecordingObserver:
    """Write every scan, thinned, and the estimator's state after it."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    def __call__(self, tracked: ScanResult, scan_ms: float) -> None:
        """Log one scan's result."""
        recording, index, stamp_ns = self._recording, tracked.index, tracked.stamp_ns
        T_world_lidar = tracked.T_world_imu @ pose_matrix(tracked.nav.T_imu_lidar.wxyz_xyz)
        points, corners = _compensated(tracked, T_world_lidar)
        recording.log_scan(index, stamp_ns, points, T_world_lidar, tracked.raw, corners)
        recording.log_added(index, stamp_ns, new_map_points(tracked))
        if np.isfinite(T_world_lidar).all():
            recording.log_pose(index, stamp_ns, "world/imu", tracked.T_world_imu)
            recording.log_unobserved(_unobserved(tracked, T_world_lidar))
        values = _match(tracked) | _biases(tracked)
        values |= {f"times/{stage}": np.asarray(ms) for stage, ms in tracked.stage_ms.items()}
        if tracked.output.covariance is not None:
            covariance = np.asarray(tracked.output.covariance)
            recording.log_sigma(covariance[POSITION, POSITION])
        recording.log_metrics(index, stamp_ns, values)


def _compensated(
    tracked: ScanResult, T_world_lidar: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.bool_] | None]:
    """Return the compensated scan in the lidar frame, and which points are corners where this is known."""
    output = tracked.output
    points = np.asarray(output.points)
    kept = np.arange(0, len(points), max(1, len(points) // _POINTS))
    kept = kept[np.asarray(output.points_mask)[kept]]
    offset = np.asarray(output.origin) - T_world_lidar[:3, 3]
    in_lidar = ((points[kept] + offset) @ T_world_lidar[:3, :3]).astype(np.float32)
    return in_lidar, None if output.corners is None else np.asarray(output.corners)[kept]


def _match(tracked: ScanResult) -> dict[str, NDArray[np.float64]]:
    found = tracked.output.registration
    values = {
        "match/residual_m": np.asarray(found.rmse, np.float64),
        "match/points": np.asarray(found.matches, np.float64),
        "match/iterations": np.asarray(found.iterations, np.float64),
    }
    if int(tracked.output.nis_dof) > 0:
        values["match/nis"] = np.asarray(tracked.output.nis, np.float64)
    return values


def _biases(tracked: ScanResult) -> dict[str, NDArray[np.float64]]:
    """Return speed, biases and their sigmas."""
    nav, covariance = tracked.nav, tracked.output.covariance
    values = {"state/speed": np.asarray(np.linalg.norm(nav.velocity))}
    if covariance is None:
        return values
    sigma = np.sqrt(np.maximum(np.diagonal(np.asarray(covariance)), 0.0))
    for name, bias, part in (
        ("state/gyro_bias", nav.gyro_bias, GYRO_BIAS),
        ("state/accel_bias", nav.accel_bias, ACCEL_BIAS),
    ):
        values |= {f"{name}/value": np.asarray(bias), f"{name}/sigma": sigma[part]}
    return values


def _unobserved(tracked: ScanResult, T_world_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (k, 3) unobservable directions in the lidar frame, of the position or of a rotation axis."""
    found = tracked.output.registration
    # the first scan has no map to be matched with
    told = tracked.index > 0 and np.isfinite(np.asarray(found.information)).all()
    weak = weak_directions(found) if told else np.zeros((6, 0))
    turns, moves = weak[:3], weak[3:]
    stronger = np.where(np.linalg.norm(moves, axis=0) >= np.linalg.norm(turns, axis=0), moves, turns)
    return (T_world_lidar[:3, :3].T @ stronger).T
