"""A folder of clouds: one file of points for each scan, and beside them times, inertial samples and poses."""

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.cloud_fields import RawCloud, choose_fields, cloud_of
from lio_jax.data.cloud_files import CLOUD_SUFFIXES, read_cloud
from lio_jax.data.cloud_stamps import CloudStamps, stamps_of
from lio_jax.data.config import DataConfig
from lio_jax.data.imu_checks import accel_scale
from lio_jax.data.imu_text import read_imu_text
from lio_jax.data.las_file import COMPRESSED_SUFFIX, DECOMPRESS
from lio_jax.data.scan_reading import ScanReading, recognise_clouds
from lio_jax.data.sequence import (
    ImuData,
    LidarScan,
    Reader,
    SequenceBase,
    SequenceInfo,
    entries,
    scans_from,
)
from lio_jax.data.time_order import Stamped, ascending, in_time_order
from lio_jax.data.trajectory import Trajectory, read_kitti_poses, read_tum
from lio_jax.data.velodyne_file import BYTES_PER_POINT

_IMU_FILES = ("imu.csv", "imu.txt")
_POSES = "poses.txt"
_LONGEST_IN_M = 500.0
"""Median range above which points cannot be in metres, m."""
_LONGEST_IN_MM = 300_000.0
"""Median range above which points are in no frame of a lidar, mm."""


class CloudFolder(SequenceBase):
    """A folder of .pcd, .ply, .npy, .bin or .las files; it holds no GPS fixes."""

    def __init__(self, path: Path, config: DataConfig) -> None:
        """Order the files in time, and settle from the first clouds how they are read.

        Raises:
            LioJaxError: files of several kinds or series, times that do not fit, no cloud that can be
                read, or a field that is not there.
        """
        super().__init__()
        self._path, self._config = path, config
        self._stamps = self._find()
        self._notes = [self._stamps.note]
        self._reading, firsts = self._recognised()
        self._scale = self._length_of_unit(firsts)
        self._notes += self._reading.notes

    @property
    def info(self) -> SequenceInfo:
        """Return what is known without decoding scans."""
        return SequenceInfo(
            name=self._path.resolve().name,
            format="clouds",
            path=str(self._path),
            scan_count=len(self._stamps.files),
            notes=tuple(self._notes),
        )

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans ``start`` to ``start + count`` in time order.

        A file that cannot be read, a duplicate and a wrong stamp are left out with a warning.
        """
        yield from in_time_order(self._scans(start, count), self._log.add)

    def imu(self) -> ImuData | None:
        """Return the samples of imu.csv or imu.txt, or None where there is no such file."""
        return self._imu

    def truth(self) -> Trajectory | None:
        """Return T_world_imu from a TUM file or from poses.txt; None where there is neither."""
        return self._truth

    def _find(self) -> CloudStamps:
        kinds: dict[str, list[Path]] = {}
        for file in entries(self._path):
            if file.suffix.lower() in CLOUD_SUFFIXES and file.is_file():
                kinds.setdefault(file.suffix.lower(), []).append(file)
        if len(kinds) > 1:
            numbers = ", ".join(f"{len(files)} {suffix}" for suffix, files in kinds.items())
            raise LioJaxError(
                f"{self._path}: holds clouds of several kinds ({numbers}); leave one kind there and move the "
                "others elsewhere."
            )
        if not kinds:
            if any(file.suffix.lower() == COMPRESSED_SUFFIX for file in entries(self._path)):
                raise LioJaxError(
                    f"{self._path}: holds compressed clouds ({COMPRESSED_SUFFIX}), which are not read; "
                    f"{DECOMPRESS}."
                )
            raise LioJaxError(
                f"{self._path}: holds no clouds ({', '.join(CLOUD_SUFFIXES)}); give a folder with one file "
                "for each scan."
            )
        (files,) = kinds.values()
        if ".bin" in kinds:
            self._check_rows(files)
        return stamps_of(self._path, files, self._config.scan_period)

    def _check_rows(self, files: list[Path]) -> None:
        """Raise an error where most files cannot be rows of a KITTI scan; a few may be truncated."""
        cut = [file for file in files if file.stat().st_size % BYTES_PER_POINT]
        if len(cut) > max(1, len(files) // 2):
            raise LioJaxError(
                f"{self._path}: {len(cut)} of its {len(files)} .bin files hold no whole rows of x, y, z and "
                f"intensity (float32, {BYTES_PER_POINT} bytes); convert the scans to .npy with named fields."
            )

    def _recognised(self) -> tuple[ScanReading, list[RawCloud]]:
        """Return how the clouds are read, and the first clouds."""
        firsts: list[RawCloud] = []

        def looked_at() -> Iterator[tuple[RawCloud, int]]:
            for stamp_ns, file in zip(self._stamps.stamp_ns, self._stamps.files, strict=True):
                points = read_cloud(file, self._log.add)
                if points is not None:
                    firsts.append(self._cloud(stamp_ns, file, points))
                    # a folder knows no time of receipt
                    yield firsts[-1], stamp_ns

        stamped = not self._stamps.counted
        reading = recognise_clouds(looked_at(), self._config, str(self._path), stamped)
        if reading is None:
            reason = (self._log.sentences or ("",))[-1]
            raise LioJaxError(f"{self._path}: no cloud can be read; {reason}")
        return reading, firsts

    def _length_of_unit(self, firsts: list[RawCloud]) -> float:
        """Return the length of the clouds' unit, m."""
        if self._config.length_unit != "auto":
            return 1e-3 if self._config.length_unit == "mm" else 1.0
        ranges = [np.linalg.norm(cloud.points, axis=1) for cloud in firsts if len(cloud.points)]
        median = float(np.median(np.concatenate(ranges))) if ranges else 0.0
        if median <= _LONGEST_IN_M:
            return 1.0
        if median <= _LONGEST_IN_MM:
            self._notes.append(
                f"points in mm (median range {median:.0f}): converted to m (config.data.length_unit)"
            )
            return 1e-3
        self._log.add(
            f"{self._path}: the points are {median:.3g} m from the origin: they must be in the frame of the "
            "lidar, not in that of a map."
        )
        return 1.0

    def _cloud(self, stamp_ns: int, file: Path, points: NDArray[Any]) -> RawCloud:
        remedy = "name its fields x, y and z"
        fields = choose_fields(points.dtype.names or (), self._config.time_field, str(file), remedy)
        return cloud_of(stamp_ns, points, fields)

    def _scans(self, start: int, count: int | None) -> Iterator[Stamped[LidarScan]]:
        chosen = scans_from(start, count)
        for stamp_ns, file in zip(self._stamps.stamp_ns[chosen], self._stamps.files[chosen], strict=True):
            points = read_cloud(file, self._log.add)
            if points is None:
                continue
            try:
                cloud = self._cloud(stamp_ns, file, points)
            except LioJaxError as error:
                self._log.add(f"{error} The scan was skipped.")
                continue
            if self._scale != 1.0:
                cloud = replace(cloud, points=cloud.points * np.float32(self._scale))
            scan = self._reading.scan(cloud, str(file), self._log.add)
            yield Stamped(scan.stamp_ns, str(file), scan)

    @cached_property
    def _imu(self) -> ImuData | None:
        path = next((self._path / name for name in _IMU_FILES if (self._path / name).is_file()), None)
        if path is None:
            return None
        imu, note = read_imu_text(path)
        scale, unit = accel_scale(imu.accel, self._config)
        self._notes += [note, *([f"imu: {unit}"] if unit else [])]
        return replace(imu, accel=imu.accel * scale)

    @cached_property
    def _truth(self) -> Trajectory | None:
        files = [file for file in entries(self._path) if file.suffix == ".tum"]
        if len(files) > 1:
            names = ", ".join(file.name for file in files)
            self._log.add(f"{self._path}: holds several TUM files ({names}): none is taken as truth.")
            return None
        if files:
            truth = read_tum(files[0]).finite()
            return truth if len(truth) else None
        if not (self._path / _POSES).is_file():
            return None
        poses = read_kitti_poses(self._path / _POSES)
        stamps = self._stamps.stamp_ns
        if len(poses) != len(stamps):
            raise LioJaxError(
                f"{self._path / _POSES}: holds {len(poses)} poses for {len(stamps)} clouds; give one pose "
                "for each cloud, or a TUM file."
            )
        if self._stamps.counted and self._reading.timing is not None and self._reading.timing.absolute:
            self._log.add(f"{self._path / _POSES}: has no stamps, so it is not read; give a TUM file.")
            return None
        kept = ascending(stamps)
        truth = Trajectory(np.array(stamps, np.int64)[kept], poses[kept]).finite()
        return truth if len(truth) else None


def _is_folder_of_clouds(path: Path) -> bool:
    if not path.is_dir():
        return False
    if (path / "trajectory.tum").is_file() and (path / "config.yaml").is_file():
        # a run's map is no recording
        return False
    suffixes = {file.suffix.lower() for file in entries(path)}
    if ".bin" in suffixes and (path.name == "velodyne" or path.parent.name == "velodyne_points"):
        # a KITTI recording holds more than its scans
        return False
    return not suffixes.isdisjoint((*CLOUD_SUFFIXES, COMPRESSED_SUFFIX))


READER = Reader(
    "clouds",
    f"a folder of clouds (one file a scan: {', '.join(CLOUD_SUFFIXES)})",
    _is_folder_of_clouds,
    CloudFolder,
    reads=frozenset(
        [
            "time_field",
            "time_unit",
            "time_reference",
            "stamp_at",
            "accel_unit",
            "length_unit",
            "compensated",
            "beams",
            "scan_period",
        ]
    ),
    has_parts=False,
)
