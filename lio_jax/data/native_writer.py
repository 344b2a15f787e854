"""Write recordings in the package's own format, complete or not at all."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.data.native import FORMAT_VERSION
from lio_jax.data.sequence import GpsData, ImuData, LidarScan
from lio_jax.data.trajectory import Trajectory, write_tum
from lio_jax.data.whole_output import written_whole


def write_native(
    path: Path,
    scans: Iterable[LidarScan],
    *,
    name: str = "",
    sensor: str = "",
    T_imu_lidar: NDArray[np.float64] | None = None,
    imu: ImuData | None = None,
    gps: GpsData | None = None,
    truth: Trajectory | None = None,
    truth_arrays: Mapping[str, ArrayLike] | None = None,
    overwrite: bool = False,
) -> int:
    """Write a native folder and return its number of scans (scans are streamed).

    Args:
        path: path of the folder; it appears only when all its files are written.
        scans: scans in time order.
        name: short name of the recording; empty: readers use the folder's name.
        sensor: name of the sensor model.
        T_imu_lidar: (4, 4) pose of the lidar in the IMU frame, or None where unknown.
        imu: inertial samples.
        gps: GPS fixes.
        truth: true poses, T_world_imu.
        truth_arrays: other true quantities (noise, biases), stored in truth.npz.
        overwrite: whether an existing native folder is replaced.

    Raises:
        UsageError: ``path`` exists and may not be replaced.
        LioJaxError: there are no scans, or the disk is full or cannot be written.
    """
    path = Path(path)
    with written_whole(path, overwrite, "meta.yaml") as aside:
        (aside / "scans").mkdir(parents=True)
        count = 0
        for count, scan in enumerate(scans, 1):
            _write_scan(aside / "scans" / f"{count - 1:06d}.npz", scan)
        if count == 0:
            raise LioJaxError(f"{path}: there are no scans to write, the folder was not made.")
        _write_samples(aside, imu, gps)
        if truth is not None:
            write_tum(aside / "truth.tum", truth)
        if truth_arrays:
            arrays: dict[str, Any] = {key: np.asarray(value) for key, value in truth_arrays.items()}
            np.savez(aside / "truth.npz", allow_pickle=False, **arrays)
        meta = {
            "format_version": FORMAT_VERSION,
            "name": name,
            "sensor": sensor,
            "T_imu_lidar": None if T_imu_lidar is None else np.asarray(T_imu_lidar, float).tolist(),
        }
        (aside / "meta.yaml").write_text(yaml.safe_dump(meta, sort_keys=False))
    return count


def _write_scan(path: Path, scan: LidarScan) -> None:
    np.savez(
        path,
        allow_pickle=False,
        points=scan.points,
        time=scan.time,
        ring=scan.ring,
        intensity=scan.intensity,
        stamp_ns=np.int64(scan.stamp_ns),
        duration=np.float64(scan.duration),
    )


def _write_samples(folder: Path, imu: ImuData | None, gps: GpsData | None) -> None:
    if imu is not None:
        orientation = {} if imu.orientation is None else {"orientation": imu.orientation}
        np.savez(
            folder / "imu.npz",
            allow_pickle=False,
            stamp_ns=imu.stamp_ns,
            gyro=imu.gyro,
            accel=imu.accel,
            **orientation,
        )
    if gps is not None:
        np.savez(
            folder / "gps.npz",
            allow_pickle=False,
            stamp_ns=gps.stamp_ns,
            position=gps.position,
            covariance=gps.covariance,
            origin=np.array(gps.origin, float),
        )
