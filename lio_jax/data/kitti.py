"""KITTI odometry sequences: compensated HDL-64E scans, camera stamps, camera poses.

Format: Geiger, Lenz and Urtasun, "Are we ready for Autonomous Driving? The KITTI Vision Benchmark Suite",
    2012.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import read_text
from lio_jax.core.timestamps import FARTHEST_NS, seconds_to_ns
from lio_jax.data.config import DataConfig
from lio_jax.data.sequence import LidarScan, Reader, SequenceBase, SequenceInfo, scans_from
from lio_jax.data.time_order import Stamped, ascending, in_time_order
from lio_jax.data.trajectory import Trajectory, are_rigid, read_kitti_poses
from lio_jax.data.velodyne_file import (
    check_sizes,
    elevation_note,
    hdl64_scan,
    listed,
    listed_runs,
    missing_runs,
    numbered_files,
    read_returns,
)


class KittiSequence(SequenceBase):
    """A folder ``sequences/NN`` with velodyne/*.bin, times.txt and calib.txt; it has no IMU and no GPS."""

    def __init__(self, path: Path, config: DataConfig) -> None:
        """Open ``path`` without decoding scans.

        Raises:
            LioJaxError: no scans, or a broken times.txt or calib.txt.
        """
        super().__init__()
        self._path, self._config = path, config
        self._notes = ["no IMU in KITTI odometry: the body frame is the lidar frame"]
        files = numbered_files(path / "velodyne", [".bin"])
        if not files:
            raise LioJaxError(
                f"{path / 'velodyne'}: holds no scans (NNNNNN.bin); give a complete sequence folder."
            )
        self._stamps = self._read_stamps(files)
        self._compensated = config.compensated != "no"
        self._files = self._usable(files)
        self._note_points()
        self._poses_path = next((p for p in pose_files(path) if p.is_file()), None)
        self._T_cam_lidar = self._read_calibration()

    @property
    def info(self) -> SequenceInfo:
        """Return what is known without decoding scans."""
        return SequenceInfo(
            name=f"kitti_{self._path.resolve().name}",
            format="kitti_odometry",
            path=str(self._path),
            scan_count=len(self._files),
            T_imu_lidar=np.eye(4),
            sensor="Velodyne HDL-64E",
            notes=tuple(self._notes),
        )

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans: duration 0 if compensated, else a start half a sweep before the camera's stamp."""
        for number, path in self._files[scans_from(start, count)]:
            rows = read_returns(path, self._log.add)
            if rows is not None:
                yield self._scan(self._stamps[number], rows)

    def truth(self) -> Trajectory | None:
        """Return T_world_lidar = (P_0 Tr)^-1 P_i Tr, first pose identity; None without poses or calib.txt."""
        if self._poses_path is None or self._T_cam_lidar is None:
            return None
        poses = read_kitti_poses(self._poses_path)
        # a pose that is not finite or has a wrong time is not used
        numbers = [number for number in range(len(poses)) if number in self._stamps]
        numbers = [number for number in numbers if np.isfinite(poses[number]).all()]
        kept = [numbers[place] for place in ascending([self._stamps[number] for number in numbers])]
        if not kept:
            return None
        lidar = poses[kept] @ self._T_cam_lidar
        stamps = np.array([self._stamps[number] for number in kept], np.int64)
        return Trajectory(stamps, np.linalg.inv(lidar[0]) @ lidar)

    def _scan(self, stamp_ns: int, rows: NDArray[np.float32]) -> LidarScan:
        duration = 0.0 if self._compensated else self._config.scan_period
        start_ns = stamp_ns - round(duration * 0.5e9)
        return hdl64_scan(rows, start_ns, duration, self._config.vertical_correction_deg)

    def _read_stamps(self, files: dict[int, Path]) -> dict[int, int]:
        """Return the stamps by the scan's number, ns."""
        path = self._path / "times.txt"
        if not path.is_file():
            period_ns = round(self._config.scan_period * 1e9)
            self._notes.append(f"no times.txt: scans are taken to be {self._config.scan_period} s apart")
            return {number: number * period_ns for number in files if number * period_ns < FARTHEST_NS}
        stamps = read_times(path)
        last = max(files)
        if len(stamps) > last + 1:
            self._notes.append(
                f"a cut-out: times.txt has {len(stamps)} entries, the scans end at {last:06d}.bin"
            )
        return dict(enumerate(stamps))

    def _usable(self, files: dict[int, Path]) -> list[tuple[int, Path]]:
        velodyne = self._path / "velodyne"
        if missing := missing_runs(files):
            self._log.add(f"{velodyne}: scan(s) {listed_runs(missing, 6)} are missing and were skipped.")
        if untimed := [number for number in files if number not in self._stamps]:
            self._log.add(
                f"{self._path / 'times.txt'}: ends before scan(s) {listed(untimed, 6)}; they were skipped."
            )
        check_sizes(files.values(), self._log.add)
        timed = (
            Stamped(self._stamps[number], str(path), (number, path))
            for number, path in files.items()
            if number in self._stamps
        )
        return list(in_time_order(timed, self._log.add))

    def _note_points(self) -> None:
        if self._compensated:
            self._notes.append("points are taken as already motion compensated (config.data.compensated)")
        else:
            self._notes.append(
                "point times from azimuth, half a sweep before to half a sweep after the camera's stamp"
            )
        self._notes += elevation_note(self._config)

    def _read_calibration(self) -> NDArray[np.float64] | None:
        path = self._path / "calib.txt"
        if not path.is_file():
            if self._poses_path is not None:
                self._notes.append(
                    "no calib.txt: the camera's poses cannot be turned into the lidar's, no truth"
                )
            return None
        for line in read_text(path, "give the calib.txt of the sequence").splitlines():
            key, _, values = line.partition(":")
            if key.strip() in ("Tr", "Tr_velo_to_cam"):
                try:
                    rows = np.array(values.split(), float).reshape(3, 4)
                except ValueError:
                    raise LioJaxError(
                        f"{path}: '{key.strip()}' does not hold 12 numbers (3x4); fix it."
                    ) from None
                if not are_rigid(rows[None]).all():
                    raise LioJaxError(
                        f"{path}: '{key.strip()}' is no rotation with a translation (3x4); fix it."
                    )
                return np.vstack([rows, [0.0, 0.0, 0.0, 1.0]])
        self._notes.append("calib.txt has no entry Tr (lidar to camera): no truth")
        return None


def read_times(path: Path) -> list[int]:
    """Read the stamps of a times.txt, ns.

    Raises:
        LioJaxError: an entry is not a time in seconds.
    """
    stamps = []
    for number, word in enumerate(read_text(path, "give the times.txt of the sequence").split(), 1):
        try:
            stamps.append(seconds_to_ns(word))
        except ValueError:
            raise LioJaxError(
                f"{path}: entry {number} ('{word[:40]}') is not a time in seconds; fix it."
            ) from None
    return stamps


def pose_files(path: Path) -> list[Path]:
    """Return the places where a sequence's true poses may be stored; the first that exists is read."""
    path = path.resolve()
    return [path / "poses.txt", path.parent.parent / "poses" / f"{path.name}.txt"]


READER = Reader(
    "kitti_odometry",
    "a KITTI odometry sequence (velodyne/*.bin)",
    lambda path: (path / "velodyne").is_dir(),
    KittiSequence,
    reads=frozenset({"compensated", "scan_period", "vertical_correction_deg"}),
)
