"""OXTS packets of KITTI raw drives: one INS read as IMU, as GPS and as ground truth."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import LioJaxError
from lio_jax.data.enu import geodetic_to_enu
from lio_jax.data.geodesy import mercator_positions
from lio_jax.data.order import ascending
from lio_jax.data.sequence import GpsData, ImuData
from lio_jax.data.trajectory import Trajectory
from lio_jax.data.velodyne_file import numbered_files

_FIELDS = 30
_GEODETIC = slice(0, 3)
_ROLL_PITCH_YAW = slice(3, 6)
_ACCEL = slice(11, 14)
_GYRO = slice(17, 20)
_POSITION_SIGMA = 23


@dataclass(frozen=True)
class OxtsPackets:
    """The packets of a drive, in strictly ascending time."""

    stamp_ns: NDArray[np.int64]
    values: NDArray[np.float64]
    """(n, 30) as the devkit's dataformat.txt lists them."""

    def imu(self) -> ImuData:
        """Return ax ay az and wx wy wz, body frame; the INS attitude is left out because it is the truth."""
        return ImuData(self.stamp_ns, gyro=self.values[:, _GYRO], accel=self.values[:, _ACCEL])

    def gps(self) -> GpsData:
        """Return fixes in ENU around the first, isotropic covariance pos_accuracy squared."""
        geodetic = self.values[:, _GEODETIC]
        origin = (float(geodetic[0, 0]), float(geodetic[0, 1]), float(geodetic[0, 2]))
        variance = self.values[:, _POSITION_SIGMA] ** 2
        return GpsData(
            self.stamp_ns, geodetic_to_enu(geodetic, origin), variance[:, None, None] * np.eye(3), origin
        )

    def truth(self) -> Trajectory:
        """Return T_world_imu: Mercator position minus the first one, R = Rz(yaw) Ry(pitch) Rx(roll).

        Only the position is taken relative to the first pose: the world stays level with x to the east, y to
        the north and z up.
        """
        positions = mercator_positions(self.values[:, _GEODETIC])
        poses = np.tile(np.eye(4), (len(positions), 1, 1))
        roll_pitch_yaw = self.values[:, _ROLL_PITCH_YAW]
        poses[:, :3, :3] = Rotation.from_euler("ZYX", roll_pitch_yaw[:, ::-1]).as_matrix()
        poses[:, :3, 3] = positions - positions[0]
        return Trajectory(self.stamp_ns, poses)


def read_timestamps(path: Path) -> NDArray[np.int64]:
    """Read lines ``YYYY-MM-DD HH:MM:SS.nnnnnnnnn`` (UTC) to the ns; (n,).

    Raises:
        LioJaxError: the file is missing or a line is not a date and time.
    """
    if not path.is_file():
        raise LioJaxError(f"{path}: missing; copy the drive's folder completely.")
    lines = path.read_text().rstrip().splitlines()
    try:
        stamps = np.array([line.strip() for line in lines], "datetime64[ns]")
    except ValueError:
        stamps = np.array([], "datetime64[ns]")
        for number, line in enumerate(lines, 1):
            _check_timestamp(path, number, line)
    if np.isnat(stamps).any():
        _check_timestamp(path, int(np.argmax(np.isnat(stamps))) + 1, "")
    return stamps.astype(np.int64)


def read_oxts(folder: Path, warn: Callable[[str], None]) -> OxtsPackets | None:
    """Read ``folder``/data/*.txt with ``folder``/timestamps.txt; None where there are no packets.

    Packets that do not hold 30 finite numbers, that have no timestamp, or whose stamp does not ascend are
    left out with a warning.
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
        row = _packet(path) if number < len(all_stamps) else None
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
        values = np.array(path.read_text().split(), float)
    except (OSError, ValueError):
        return None
    return values if values.size == _FIELDS and np.isfinite(values).all() else None


def _check_timestamp(path: Path, number: int, line: str) -> None:
    try:
        if line.strip():
            np.datetime64(line.strip(), "ns")
            return
    except ValueError:
        pass
    raise LioJaxError(f"{path}: line {number} ('{line[:40]}') is not 'YYYY-MM-DD HH:MM:SS.fraction'; fix it.")
