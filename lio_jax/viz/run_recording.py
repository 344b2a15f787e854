"""Write a recording for the viewer while a run goes on."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.error_state import ACCEL_BIAS, GYRO_BIAS, POSITION
from lio_jax.data.trajectory import Trajectory
from lio_jax.run.failures import weak_directions
from lio_jax.run.map_file import new_map_points
from lio_jax.run.sinks import RunResult, Sink
from lio_jax.run.track import ScanResult, pose_matrix
from lio_jax.viz.recording import ViewerRecording
from lio_jax.viz.run_record import read_correction

_POINTS = 5000


class RecordingSink(Sink):
    """Records every scan, thinned, and what the estimator knows after it."""

    def __init__(self, recording: ViewerRecording, out: Path, truth: Trajectory | None = None) -> None:
        """Record into an open recording, which is closed at the end of the run.

        Args:
            recording: to write into.
            out: the run folder, for what the back end leaves there.
            truth: T_truth_imu, in any frame.
        """
        self._recording, self._out, self._truth = recording, out, truth

    def take(self, result: ScanResult) -> None:
        """Record one scan's result."""
        recording, index, stamp_ns = self._recording, result.index, result.stamp_ns
        T_world_lidar = result.T_world_imu @ pose_matrix(result.nav.T_imu_lidar.wxyz_xyz)
        points, corners = _compensated(result, T_world_lidar)
        recording.log_scan(index, stamp_ns, points, T_world_lidar, result.raw, corners)
        recording.log_added(index, stamp_ns, new_map_points(result))
        if np.isfinite(T_world_lidar).all():
            recording.log_pose(index, stamp_ns, "world/imu", result.T_world_imu)
            recording.log_unobserved(_unobserved(result, T_world_lidar))
        values = _match(result) | _biases(result)
        values |= {f"times/{stage}": np.asarray(ms) for stage, ms in result.stage_ms.items()}
        if result.output.covariance is not None:
            covariance = np.asarray(result.output.covariance)
            recording.log_sigma(covariance[POSITION, POSITION])
        recording.log_metrics(index, stamp_ns, values)

    def finish(self, run: RunResult) -> None:
        """Record the correction and the truth, and close the recording."""
        if found := read_correction(self._out):
            loops = {name: found.strips(name == "closed") for name in ("closed", "refused")}
            self._recording.log_correction(found.trajectory.positions, found.keyframes, loops)
        if self._truth is not None:
            self._recording.log_truth(_in_world_of(run.trajectory, self._truth).positions)
        self._recording.close()


def _in_world_of(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """Return the truth of the run, moved to agree with the estimate at the first instant both have."""
    common = truth.at(estimate.stamp_ns)
    if not len(common):
        return truth
    first = int(np.searchsorted(estimate.stamp_ns, common.stamp_ns[0]))
    T_estimate_truth = estimate.poses[first] @ np.linalg.inv(common.poses[0])
    within = (truth.stamp_ns >= estimate.stamp_ns[0]) & (truth.stamp_ns <= estimate.stamp_ns[-1])
    return Trajectory(truth.stamp_ns[within], T_estimate_truth @ truth.poses[within])


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
        # without inertial samples there are no biases
        if not sigma[part].any():
            continue
        values |= {f"{name}/value": np.asarray(bias), f"{name}/sigma": sigma[part]}
    return values


def _unobserved(tracked: ScanResult, T_world_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (k, 3) unobservable directions in the lidar frame, of the position or of a rotation axis."""
    found = tracked.output.registration
    # the first scan has no map to be matched with
    known = tracked.index > 0 and np.isfinite(np.asarray(found.information)).all()
    weak = weak_directions(found) if known else np.zeros((6, 0))
    turns, moves = weak[:3], weak[3:]
    stronger = np.where(np.linalg.norm(moves, axis=0) >= np.linalg.norm(turns, axis=0), moves, turns)
    return (T_world_lidar[:3, :3].T @ stronger).T
