"""What a run keeps of every scan in memory: states, match figures, times, failures and overflow."""

from pathlib import Path
from typing import Any

import jaxlie
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.files import atomic_path
from lio_jax.core.geometry import carried, covariance_of
from lio_jax.core.types import NavState
from lio_jax.data.trajectory import Trajectory
from lio_jax.run.sinks import RunResult, Sink
from lio_jax.run.track import ScanResult, pose_matrix
from lio_jax.settings.settings import Settings


class TrajectoryLog(Sink):
    """Keeps the states in the order of the scans."""

    def __init__(self) -> None:
        self._rows: list[dict[str, Any]] = []
        self._matches: list[NDArray[np.float64]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def take(self, result: ScanResult) -> None:
        """Keep one result."""
        nav, state = result.nav, result.output.covariance
        match = _covariance(result) if self._rows else np.zeros((6, 6))
        self._matches.append(match)
        # copies: a view would keep the device's memory allocated
        whole = {} if state is None else {"state_covariance": np.array(state)}
        pose = whole["state_covariance"][:6, :6] if whole else match
        self._rows.append(
            {
                "stamps_ns": np.int64(result.stamp_ns),
                "poses": result.T_world_imu,
                "velocity": nav.velocity,
                "biases": np.concatenate([nav.gyro_bias, nav.accel_bias]),
                "gravity": nav.gravity,
                "extrinsic": pose_matrix(nav.T_imu_lidar.wxyz_xyz),
                "time_offset": nav.time_offset,
                "covariance": pose,
                "nis": np.array(result.output.nis),
                "nis_dof": np.array(result.output.nis_dof),
                **whole,
            }
        )

    def finish(self, run: RunResult) -> None:
        """Hand over the trajectory and the number of scans."""
        run.trajectory = self.trajectory()
        run.metrics["scans"] = len(self)

    def nav(self, index: int) -> NavState:
        """Return one scan's navigation state, numpy leaves."""
        row = self._rows[index]
        biases: Any = row["biases"]
        return NavState(
            T_world_imu=_se3(row["poses"], row["velocity"].dtype),
            velocity=row["velocity"],
            gyro_bias=biases[:3],
            accel_bias=biases[3:],
            gravity=row["gravity"],
            T_imu_lidar=_se3(row["extrinsic"], row["velocity"].dtype),
            time_offset=row["time_offset"],
        )

    def column(self, name: str) -> NDArray:
        """Return one quantity of all scans, stacked along the first axis."""
        return np.stack([row[name] for row in self._rows])

    def match_covariances(self) -> NDArray[np.float64]:
        """Return the covariances (n, 6, 6) of the poses from the matches with the map alone."""
        return np.stack(self._matches)

    def trajectory(self) -> Trajectory:
        """Return T_world_imu at the scans' ends."""
        return Trajectory(self.column("stamps_ns"), self.column("poses"))

    def write_npz(self, path: Path) -> None:
        """Write every column, with one row for each scan, at the scans' ends.

        - ``stamps_ns`` (n,) int64;
        - ``poses`` (n, 4, 4) T_world_imu;
        - ``velocity`` (n, 3) of the IMU origin in world, m/s;
        - ``biases`` (n, 6) gyroscope rad/s, then accelerometer m/s^2, IMU frame;
        - ``gravity`` (n, 3) in world, m/s^2;
        - ``extrinsic`` (n, 4, 4) T_imu_lidar;
        - ``time_offset`` (n,) s: a scan stamped t was taken at IMU time t + time_offset;
        - ``covariance`` (n, 6, 6) of the pose's right perturbation (rotation rad, position m). Filters give
          their own; in the recipe default it includes the drift of the map. LiDAR odometry gives that of the
          match with the map alone; NaN where unknown;
        - ``state_covariance`` (n, 24, 24) of the whole error state, from filters only;
        - ``nis``, ``nis_dof`` (n,) normalised innovation squared and its degrees of freedom, 0 without a
          match.
        """
        with atomic_path(path) as aside:
            columns: dict[str, Any] = {name: self.column(name) for name in self._rows[0]}
            np.savez_compressed(aside, **columns)


def _se3(pose: NDArray[np.float64], dtype: np.dtype) -> jaxlie.SE3:
    wxyz = Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
    leaf: Any = np.concatenate([wxyz, pose[:3, 3]]).astype(dtype)
    return jaxlie.SE3(leaf)


def _covariance(tracked: ScanResult) -> NDArray[np.float64]:
    """Transform the scan match's covariance from the lidar to the IMU at the scan's end."""
    registration = tracked.output.registration
    T_world_lidar = pose_matrix(np.asarray(registration.T_world_lidar.wxyz_xyz))
    T_imu_lidar = np.linalg.inv(tracked.T_world_imu) @ T_world_lidar
    return carried(covariance_of(np.asarray(registration.information)), T_imu_lidar)


class StageTimes(Sink):
    """Keeps the time that each stage took, ms."""

    def __init__(self, *stages: str) -> None:
        """Begin without times; those of stages that :attr:`ScanResult.stage_ms` lacks are added by others."""
        self.ms: dict[str, list[float]] = {stage: [] for stage in stages}

    def take(self, result: ScanResult) -> None:
        """Keep one scan's times."""
        for stage, value in result.stage_ms.items():
            if stage in self.ms:
                self.ms[stage].append(value)

    def finish(self, run: RunResult) -> None:
        """Hand over the times and their percentiles."""
        run.stage_ms = self.ms
        run.metrics["scan_ms"] = {stage: _percentiles(values) for stage, values in self.ms.items() if values}


def _percentiles(values: list[float]) -> dict[str, float]:
    median, p95, p99 = np.percentile(values, [50, 95, 99])
    return {"median": round(median, 3), "p95": round(p95, 3), "p99": round(p99, 3)}


class Failures(Sink):
    """Keeps what went wrong with single scans."""

    def __init__(self, start: int) -> None:
        """Begin without any; ``start`` is the first scan's number in the recording."""
        self._start = start
        self._found: list[dict[str, Any]] = []

    def take(self, result: ScanResult) -> None:
        """Keep the scan's failure, if there is one."""
        if result.failure:
            number = self._start + result.index
            message = f"scan {number}: {result.failure}"
            self._found.append({"scan": number, "stamp_ns": result.stamp_ns, "message": message})

    def finish(self, run: RunResult) -> None:
        """Hand over the failures."""
        run.metrics["failures"] = self._found


class ScanLog(Sink):
    """Keeps numbers in the order of the scans, and writes them at the end."""

    def __init__(self, path: Path, start: int) -> None:
        """Begin without any scan.

        Args:
            path: scans.npz.
            start: first scan's number in the recording.
        """
        self._path, self._start = path, start
        self._rows: list[dict[str, Any]] = []

    def take(self, result: ScanResult) -> None:
        """Keep the numbers of one scan."""
        found = result.output.registration
        self._rows.append(
            {
                "scan": self._start + result.index,
                "points": result.scan_points,
                "matches": int(found.matches),
                "rmse": float(found.rmse),
                "iterations": int(found.iterations),
                "unobserved": int(np.sum(found.degenerate)),
                "lost": bool(result.output.lost),
                "failed": bool(result.failure),
            }
        )

    def finish(self, run: RunResult) -> None:
        """Write every column, one row a scan.

        - ``scan`` index in the recording; ``points`` number of points as recorded;
        - ``matches`` number of points with a counterpart in the map; ``rmse`` of their distances, m;
        - ``iterations`` of the solver; ``unobserved`` number of unobserved directions of six;
        - ``lost``: the pose is the prediction; ``failed``: metrics.json states why;
        - ``NAME_ms`` time of each stage; ``total_ms`` time of the scan; ``decode_ms`` time on another thread;
          NaN where a run was interrupted.

        Args:
            run: with the times of the stages.
        """
        columns = {name: np.array([row[name] for row in self._rows]) for name in self._rows[0]}
        stages = {f"{name}_ms": self._one_each(times) for name, times in run.stage_ms.items()}
        with atomic_path(self._path) as aside:
            # numpy's stubs take the keywords for its own options
            arrays: dict[str, Any] = columns | stages
            np.savez_compressed(aside, **arrays)

    def _one_each(self, times: list[float]) -> NDArray[np.float64]:
        one_each = np.full(len(self._rows), np.nan)
        known = times[: len(one_each)]
        one_each[: len(known)] = known
        return one_each


_TOLERATED_SHARE = 0.05
"""Share of points without room in the map up to which no warning is given: a well-filled table drops some."""


class Overflow(Sink):
    """Sums what found no room over the scans of a run."""

    def __init__(self, settings: Settings) -> None:
        self._largest = settings.config.lidar.buckets[-1]
        self._capacity = settings.config.map.capacity
        self._scans_over = 0
        self._thinned_away: list[int] = []
        self._offered = 0
        self._dropped = 0

    def take(self, result: ScanResult) -> None:
        """Count one scan."""
        output = result.output
        self._scans_over += result.scan_points > self._largest
        self._thinned_away.append(int(output.thinned_away))
        self._offered += int(np.asarray(output.points_mask).sum())
        self._dropped += int(output.map_dropped)

    def finish(self, run: RunResult) -> None:
        """Hand over the sums, and a warning for each capacity that is too small for this recording."""
        run.metrics["warnings"] += self._warnings()
        run.metrics["overflow"] = {
            "scans_over_largest_bucket": self._scans_over,
            "cells_thinned_away_per_scan": float(np.median(self._thinned_away)),
            "map_points_offered": self._offered,
            "map_points_dropped": self._dropped,
        }

    def _warnings(self) -> list[str]:
        sentences = []
        if self._scans_over:
            sentences.append(
                f"{self._scans_over} scans hold more than {self._largest} points and were thinned to that "
                "many evenly; append a larger size to config.lidar.buckets to use them all."
            )
        if self._dropped > _TOLERATED_SHARE * self._offered:
            sentences.append(
                f"{self._dropped} of {self._offered} points found no room in the map of {self._capacity} "
                "voxels; raise config.map.capacity or lower params.map.reach."
            )
        return sentences
