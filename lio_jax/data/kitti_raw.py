"""KITTI raw drives: Velodyne scans, and OXTS packets of one INS that serve as IMU, GPS and ground truth."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import read_text
from lio_jax.data.config import DataConfig
from lio_jax.data.enu import geodetic_to_enu, mercator_positions
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, Reader, SequenceBase, SequenceInfo, scans_from
from lio_jax.data.time_order import Stamped, ascending, in_time_order
from lio_jax.data.trajectory import Trajectory, are_rigid
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

_FIELDS = 30
_GEODETIC = slice(0, 3)
_ROLL_PITCH_YAW = slice(3, 6)
_ACCEL = slice(11, 14)
_GYRO = slice(17, 20)
_POSITION_SIGMA = 23
NO_STAMP = np.iinfo(np.int64).min
"""Stands for an empty line among timestamps; it is NumPy's "not a time"."""


@dataclass(frozen=True)
class OxtsPackets:
    """The packets of a drive, in strictly ascending time."""

    stamp_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    """Values of each packet, (n, 30), in the order of the devkit's dataformat.txt."""

    def imu(self) -> ImuData:
        """Return ax ay az and wx wy wz, body frame; the INS attitude is left out because it is the truth."""
        return ImuData(self.stamp_ns, gyro=self.values[:, _GYRO], accel=self.values[:, _ACCEL])

    def gps(self) -> GpsData:
        """Return fixes in ENU around the first fix; the covariance is isotropic, pos_accuracy squared."""
        geodetic = self.values[:, _GEODETIC]
        origin = (float(geodetic[0, 0]), float(geodetic[0, 1]), float(geodetic[0, 2]))
        variance = self.values[:, _POSITION_SIGMA] ** 2
        return GpsData(
            self.stamp_ns, geodetic_to_enu(geodetic, origin), variance[:, None, None] * np.eye(3), origin
        )

    def truth(self) -> Trajectory:
        """Return T_world_imu: Mercator position minus the first one, R = Rz(yaw) Ry(pitch) Rx(roll).

        Only the position is relative to the first pose: the world stays level, with x to the east, y to the
        north and z up.
        """
        positions = mercator_positions(self.values[:, _GEODETIC])
        poses = np.tile(np.eye(4), (len(positions), 1, 1))
        roll_pitch_yaw = self.values[:, _ROLL_PITCH_YAW]
        poses[:, :3, :3] = Rotation.from_euler("ZYX", roll_pitch_yaw[:, ::-1]).as_matrix()
        poses[:, :3, 3] = positions - positions[0]
        return Trajectory(self.stamp_ns, poses)


def read_timestamps(path: Path) -> NDArray[np.int64]:
    """Read lines ``YYYY-MM-DD HH:MM:SS.nnnnnnnnn`` (UTC) with full precision, (n,) ns.

    An empty line gives ``NO_STAMP``: some of the public drives have one where the recording lost a scan.

    Raises:
        LioJaxError: the file is missing, or another line is not a date and time.
    """
    if not path.is_file():
        raise LioJaxError(f"{path}: missing; copy the drive's folder completely.")
    lines = read_text(path, "copy it again from the drive").rstrip().splitlines()
    for number, line in enumerate(lines, 1):
        _check_timestamp(path, number, line)
    return np.array([line.strip() for line in lines], "datetime64[ns]").astype(np.int64)


def read_oxts(folder: Path, warn: Callable[[str], None]) -> OxtsPackets | None:
    """Read ``folder``/data/*.txt with ``folder``/timestamps.txt; return None where there are no packets.

    A packet is left out with a warning if it does not hold 30 finite numbers, if it has no timestamp, or if
    its stamp does not ascend.
    """
    if not (folder / "data").is_dir():
        return None
    files = numbered_files(folder / "data", [".txt"])
    if not files:
        return None
    all_stamps = read_timestamps(folder / "timestamps.txt")
    stamps: list[int] = []
    rows: list[NDArray[np.float64]] = []
    broken: list[str] = []
    for number, path in files.items():
        row = _packet(path) if _has_stamp(all_stamps, number) else None
        if row is None:
            broken.append(path.name)
        else:
            stamps.append(int(all_stamps[number]))
            rows.append(row)
    kept = ascending(stamps)
    if broken:
        names = ", ".join(broken[:5]) + (", ..." if len(broken) > 5 else "")
        warn(
            f"{folder / 'data'}: {len(broken)} packet(s) unreadable or without timestamp, left out: {names}."
        )
    if left_out := len(stamps) - len(kept):
        warn(f"{folder / 'timestamps.txt'}: {left_out} packet(s) whose stamp does not ascend were left out.")
    return OxtsPackets(np.array(stamps, np.int64)[kept], np.array(rows)[kept]) if rows else None


def _packet(path: Path) -> NDArray[np.float64] | None:
    try:
        values = np.array(path.read_text(encoding="utf-8").split(), float)
    except (OSError, ValueError):
        return None
    return values if values.size == _FIELDS and np.isfinite(values).all() else None


# numpy reads more than this: time zones, and years that nanoseconds cannot hold, which it wraps around
_TIMESTAMP = re.compile(r"(19|20)\d\d-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d+)?", re.ASCII)


def _check_timestamp(path: Path, number: int, line: str) -> None:
    word = line.strip()
    try:
        if word and not _TIMESTAMP.fullmatch(word):
            raise ValueError
        np.datetime64(word, "ns")
    except ValueError:
        raise LioJaxError(
            f"{path}: line {number} ('{line[:40]}') is not 'YYYY-MM-DD HH:MM:SS.fraction'; fix it."
        ) from None


def _has_stamp(stamps: NDArray[np.int64], number: int) -> bool:
    return number < len(stamps) and stamps[number] != NO_STAMP


_LONGEST_SWEEP_S = 0.5


@dataclass(frozen=True)
class _Sweep:
    path: Path
    stamp_ns: int
    duration: float


class KittiRawSequence(SequenceBase):
    """A drive folder with velodyne_points/ and oxts/."""

    def __init__(self, path: Path, config: DataConfig) -> None:
        """Open ``path`` without decoding scans.

        Raises:
            LioJaxError: no scans, or a broken timestamp or calibration file.
        """
        super().__init__()
        self._path, self._config = path, config
        self._notes: list[str] = []
        self._compensated = config.compensated == "yes"
        velodyne = path / "velodyne_points"
        files = numbered_files(velodyne / "data", [".bin", ".txt"]) if (velodyne / "data").is_dir() else {}
        if not files:
            raise LioJaxError(
                f"{velodyne / 'data'}: holds no scans (NNNNNNNNNN.bin or .txt); give a complete drive."
            )
        self._sweeps = self._time_sweeps(velodyne, files)
        self._T_imu_lidar = self._read_calibration()
        self._notes.append(
            "points are taken as already motion compensated (config.data.compensated)"
            if self._compensated
            else "point times from azimuth, clockwise from straight behind"
        )
        self._notes += elevation_note(config)

    @property
    def info(self) -> SequenceInfo:
        """Return what is known without decoding scans."""
        return SequenceInfo(
            name=self._path.resolve().name,
            format="kitti_raw",
            path=str(self._path),
            scan_count=len(self._sweeps),
            T_imu_lidar=self._T_imu_lidar,
            sensor="Velodyne HDL-64E",
            notes=tuple(self._notes),
        )

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans, stamped at their start; all points have time 0 if config declares them compensated."""
        for sweep in self._sweeps[scans_from(start, count)]:
            rows = read_returns(sweep.path, self._log.add)
            if rows is not None:
                raised = self._config.vertical_correction_deg
                yield hdl64_scan(rows, sweep.stamp_ns, sweep.duration, raised)

    def imu(self) -> ImuData | None:
        """Return accelerations and rates of the INS, body frame (10 Hz in sync drives, 100 Hz in extract)."""
        return None if self._oxts is None else self._oxts.imu()

    def gps(self) -> GpsData | None:
        """Return positions of the INS in ENU around the first."""
        return None if self._oxts is None else self._oxts.gps()

    def truth(self) -> Trajectory | None:
        """Return T_world_imu of the INS: level, starts at the origin, devkit's Mercator projection."""
        return None if self._oxts is None else self._oxts.truth()

    @cached_property
    def _oxts(self) -> OxtsPackets | None:
        return read_oxts(self._path / "oxts", self._log.add)

    def _time_sweeps(self, velodyne: Path, files: dict[int, Path]) -> list[_Sweep]:
        starts, durations = self._read_times(velodyne)
        last = max(files)
        if len(starts) > last + 1:
            self._notes.append(f"a cut-out: {len(starts)} timestamps, the scans end at {files[last].name}")
        if missing := missing_runs(files):
            self._log.add(
                f"{velodyne / 'data'}: scan(s) {listed_runs(missing, 10)} are missing and were skipped."
            )
        if unstamped := [n for n in files if n < len(starts) and not _has_stamp(starts, n)]:
            self._log.add(
                f"{velodyne}: the timestamps of scan(s) {listed(unstamped, 10)} are empty; they were skipped."
            )
        if untimed := [number for number in files if number >= len(starts)]:
            self._log.add(
                f"{velodyne}: the timestamps end before scan(s) {listed(untimed, 10)}; they were skipped."
            )
        check_sizes(files.values(), self._log.add)
        timed = (
            Stamped(int(starts[number]), str(path), (number, path))
            for number, path in files.items()
            if _has_stamp(starts, number)
        )
        sweeps = []
        for number, path in in_time_order(timed, self._log.add):
            duration = float(durations[number])
            if not 0.0 < duration < _LONGEST_SWEEP_S:
                self._log.add(
                    f"{path}: its sweep would last {duration:.3f} s by timestamps_end.txt; "
                    f"config.data.scan_period ({self._config.scan_period} s) is used."
                )
                duration = self._config.scan_period
            sweeps.append(_Sweep(path, int(starts[number]), 0.0 if self._compensated else duration))
        return sweeps

    def _read_times(self, velodyne: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the stamps at which the sweeps start, ns, and the durations of the sweeps, s."""
        period_ns = round(self._config.scan_period * 1e9)
        if (velodyne / "timestamps_start.txt").is_file():
            starts = read_timestamps(velodyne / "timestamps_start.txt")
        else:
            middles = read_timestamps(velodyne / "timestamps.txt")
            starts = np.where(middles == NO_STAMP, NO_STAMP, middles - period_ns // 2)
            self._notes.append(
                "no timestamps_start.txt: sweeps start half a scan_period before timestamps.txt"
            )
        ends = starts + period_ns
        if (velodyne / "timestamps_end.txt").is_file():
            known = read_timestamps(velodyne / "timestamps_end.txt")[: len(starts)]
            ends[: len(known)] = np.where(known == NO_STAMP, ends[: len(known)], known)
        else:
            self._notes.append(
                f"no timestamps_end.txt: sweeps are taken to last {self._config.scan_period} s"
            )
        return starts, np.asarray((ends - starts) * 1e-9, np.float64)

    def _read_calibration(self) -> NDArray[np.float64] | None:
        path = self._path.resolve().parent / "calib_imu_to_velo.txt"
        if not path.is_file():
            self._notes.append("no calib_imu_to_velo.txt in the parent folder: the extrinsic is unknown")
            return None
        lines = read_text(path, "copy it again from the drive").splitlines()
        entries = dict(line.split(":", 1) for line in lines if ":" in line)
        T_lidar_imu = np.eye(4)
        try:
            T_lidar_imu[:3, :3] = np.array(entries["R"].split(), float).reshape(3, 3)
            T_lidar_imu[:3, 3] = np.array(entries["T"].split(), float)
        except (KeyError, ValueError):
            raise LioJaxError(f"{path}: needs the entries R (9 numbers) and T (3 numbers); fix it.") from None
        if not are_rigid(T_lidar_imu[None]).all():
            raise LioJaxError(f"{path}: R is no rotation, or T is not finite; fix it.")
        return np.asarray(np.linalg.inv(T_lidar_imu), np.float64)


READER = Reader(
    "kitti_raw",
    "a KITTI raw drive (velodyne_points/data)",
    lambda path: (path / "velodyne_points").is_dir(),
    KittiRawSequence,
    reads=frozenset({"compensated", "scan_period", "vertical_correction_deg"}),
)
