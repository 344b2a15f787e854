"""The package's own recording format: a folder with meta.yaml, scans/, imu.npz, gps.npz and truth.tum."""

from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import array_of, parse_yaml, read_arrays, read_text
from lio_jax.data.cloud_fields import valid_returns
from lio_jax.data.config import DataConfig
from lio_jax.data.sequence import (
    GpsData,
    ImuData,
    LidarScan,
    Reader,
    SequenceBase,
    SequenceInfo,
    check_still_there,
    scans_from,
)
from lio_jax.data.time_order import Stamped, in_time_order
from lio_jax.data.trajectory import Trajectory, are_rigid, read_tum
from lio_jax.data.velodyne_file import listed_runs, missing_runs, numbered_files

_LONGEST_S = 3600.0
"""Durations of a scan from here on are damage, s."""
FORMAT_VERSION = 1
"""Format version that is written to meta.yaml, and the only one that is read."""


class NativeSequence(SequenceBase):
    """A folder written by :func:`lio_jax.data.native_writer.write_native`."""

    def __init__(self, path: Path, config: DataConfig) -> None:
        """Open ``path`` without decoding scans.

        Raises:
            LioJaxError: a broken meta.yaml, another format version, or no scans.
        """
        super().__init__()
        self._path = path
        self._compensated = config.compensated == "yes"
        self._meta = _read_meta(path / "meta.yaml")
        files = numbered_files(path / "scans", [".npz"]) if (path / "scans").is_dir() else {}
        if not files:
            raise LioJaxError(
                f"{path / 'scans'}: holds no scans (NNNNNN.npz); give a complete native folder."
            )
        if missing := missing_runs(files):
            self._log.add(
                f"{path / 'scans'}: scan(s) {listed_runs(missing, 6)} are missing and were skipped."
            )
        self._files = list(files.values())

    @property
    def info(self) -> SequenceInfo:
        """Return what is known without decoding scans."""
        return SequenceInfo(
            name=self._meta["name"] or self._path.resolve().name,
            format="native",
            path=str(self._path),
            scan_count=len(self._files),
            T_imu_lidar=self._meta["T_imu_lidar"],
            sensor=self._meta["sensor"],
            notes=("points are taken as already motion compensated (config.data.compensated)",)
            if self._compensated
            else (),
        )

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans by their numbers; unreadable and out-of-order scans are left out and reported."""
        chosen = self._files[scans_from(start, count)]
        read = ((path, self._load_scan(path)) for path in chosen)
        stamped = (Stamped(scan.stamp_ns, str(path), scan) for path, scan in read if scan is not None)
        yield from in_time_order(stamped, self._log.add)

    def imu(self) -> ImuData | None:
        """Return the samples of imu.npz, or None where there is no such file."""
        arrays = self._arrays("imu.npz", {"stamp_ns": (), "gyro": (3,), "accel": (3,)}, {"orientation": (4,)})
        if arrays is None:
            return None
        return ImuData(arrays["stamp_ns"], arrays["gyro"], arrays["accel"], arrays.get("orientation"))

    def gps(self) -> GpsData | None:
        """Return the fixes of gps.npz, or None where there is no such file."""
        forms = {"stamp_ns": (), "position": (3,), "covariance": (3, 3)}
        arrays = self._arrays("gps.npz", forms, single={"origin": (3,)})
        if arrays is None:
            return None
        latitude, longitude, altitude = (float(value) for value in arrays["origin"])
        return GpsData(
            arrays["stamp_ns"], arrays["position"], arrays["covariance"], (latitude, longitude, altitude)
        )

    def truth(self) -> Trajectory | None:
        """Return T_world_imu from truth.tum, or None where there is no such file."""
        return self._truth

    def truth_arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays of truth.npz (true noise, biases); empty where there is no such file."""
        return self._arrays("truth.npz", {}) or {}

    @cached_property
    def _truth(self) -> Trajectory | None:
        path = self._path / "truth.tum"
        if not path.is_file():
            return None
        truth = read_tum(path)
        known = truth.finite()
        if lost := len(truth) - len(known):
            self._log.add(f"{path}: {lost} poses held NaN or infinity and were dropped.")
        return known if len(known) else None

    def _load_scan(self, path: Path) -> LidarScan | None:
        try:
            return _scan_of(read_arrays(path), self._compensated)
        except (OSError, ValueError, KeyError) as error:
            check_still_there(path)
            self._log.add(f"{path}: cannot be read ({error}), the scan was skipped.")
            return None

    def _arrays(
        self,
        name: str,
        columns: dict[str, tuple[int, ...]],
        optional: dict[str, tuple[int, ...]] | None = None,
        single: dict[str, tuple[int, ...]] | None = None,
    ) -> dict[str, NDArray[Any]] | None:
        """Return the arrays of a file; None where there is none.

        Args:
            name: name of the file.
            columns: arrays of one length that it must hold, and the shape of each entry.
            optional: the same for arrays that it may hold.
            single: other arrays that it must hold, and their shapes.
        """
        path = self._path / name
        if not path.is_file():
            return None
        single = single or {}
        try:
            arrays = read_arrays(path)
            if missing := [key for key in (*columns, *single) if key not in arrays]:
                raise LioJaxError(f"{path}: lacks {', '.join(missing)}; write the folder again.")
            for key, shape in single.items():
                array_of(arrays, key, shape)
            there = {key: shape for key, shape in (optional or {}).items() if key in arrays}
            count: int | None = None
            for key, shape in (columns | there).items():
                kinds = "iu" if key == "stamp_ns" else "fiu"
                count = len(array_of(arrays, key, (count, *shape), kinds))
                arrays[key] = arrays[key].astype(np.int64 if kinds == "iu" else np.float64, copy=False)
        except (OSError, ValueError) as error:
            raise LioJaxError(f"{path}: cannot be read ({error}); write the folder again.") from None
        return arrays


def _scan_of(arrays: dict[str, NDArray[Any]], compensated: bool) -> LidarScan:
    points = array_of(arrays, "points", (None, 3), "f")
    count = len(points)
    if any(arrays[name].shape[:1] != (count,) for name in ("time", "ring", "intensity")):
        raise ValueError("points, time, ring and intensity differ in length")
    time, intensity = (array_of(arrays, name, (count,)) for name in ("time", "intensity"))
    ring = array_of(arrays, "ring", (count,), "iu")
    duration = float(array_of(arrays, "duration", ()) if "duration" in arrays else time.max(initial=0.0))
    if not (np.isfinite(time).all() and 0.0 <= duration < _LONGEST_S):
        raise ValueError(f"a point's time is not finite, or the duration ({duration} s) is impossible")
    with np.errstate(over="ignore"):
        points = points.astype(np.float32, copy=False)
        intensity = intensity.astype(np.float32, copy=False)
    valid = valid_returns(points)
    if not valid.all():
        points, time, ring, intensity = points[valid], time[valid], ring[valid], intensity[valid]
    return LidarScan(
        stamp_ns=int(array_of(arrays, "stamp_ns", (), "iu")),
        points=points,
        time=np.zeros(len(points), np.float32) if compensated else time.astype(np.float32, copy=False),
        ring=ring.astype(np.int32, copy=False),
        intensity=intensity,
        duration=0.0 if compensated else duration,
    )


def _read_meta(path: Path) -> dict[str, Any]:
    try:
        meta = parse_yaml(read_text(path, "give the meta.yaml of the folder"))
    except (OSError, ValueError) as error:
        raise LioJaxError(f"{path}: cannot be read as YAML ({error}); fix it.") from None
    if not isinstance(meta, dict) or meta.get("format_version") != FORMAT_VERSION:
        found = meta.get("format_version") if isinstance(meta, dict) else None
        raise LioJaxError(f"{path}: format_version is {found}, this program reads {FORMAT_VERSION}.")
    extrinsic = meta.get("T_imu_lidar")
    if extrinsic is not None:
        try:
            extrinsic = np.array(extrinsic, float).reshape(4, 4)
        except (TypeError, ValueError):
            raise LioJaxError(f"{path}: T_imu_lidar is not four rows of four numbers; fix it.") from None
        if not are_rigid(extrinsic[None]).all():
            raise LioJaxError(f"{path}: T_imu_lidar is no rotation with a translation; fix it.")
    return {
        "T_imu_lidar": extrinsic,
        "sensor": str(meta.get("sensor") or ""),
        "name": str(meta.get("name") or ""),
    }


READER = Reader(
    "native",
    "a native folder (meta.yaml and scans/)",
    lambda path: (path / "meta.yaml").is_file(),
    NativeSequence,
    reads=frozenset({"compensated"}),
)
