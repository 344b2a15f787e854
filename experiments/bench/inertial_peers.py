"""LiDAR-inertial peers behind the comparison's protocol, with the settings that their authors recommend."""

from collections.abc import Iterator
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from systems import Pose

from lio_jax.data.sequence import ImuData, LidarScan


class Rig(NamedTuple):
    """What a system may know about the sensors before the first scan."""

    T_imu_lidar: NDArray[np.float64]
    imu: ImuData
    beams: int
    columns: int
    min_range: float
    max_range: float
    noise: dict[str, float]
    """Densities by name: gyro_noise, accel_noise, gyro_bias_walk, accel_bias_walk."""
    starts_at_rest: bool


class _ImuReader:
    """Return inertial samples in time order, each once."""

    def __init__(self, imu: ImuData) -> None:
        self._imu, self._next = imu, 0

    def until(self, stamp_ns: int) -> Iterator[tuple[int, NDArray[np.float64], NDArray[np.float64]]]:
        """Yield (stamp, gyro, accel) of the samples before ``stamp_ns``."""
        stop = int(np.searchsorted(self._imu.stamp_ns, stamp_ns))
        for row in range(self._next, stop):
            yield int(self._imu.stamp_ns[row]), self._imu.gyro[row], self._imu.accel[row]
        self._next = max(stop, self._next)


class RkoLio:
    """RKO-LIO with its defaults; the IMU is its base frame."""

    name: ClassVar[str] = "rko-lio"
    instant: ClassVar[float] = 1.0
    instant_reason: ClassVar[str] = "deskews to the time of the scan's last point, which its pose carries"

    def __init__(self, threads: int, rig: Rig) -> None:
        from rko_lio.config import LIOConfig
        from rko_lio.lio import LIO

        # this phase assumes that the vehicle stands still: it helps such a start and harms a moving one
        config = LIOConfig(max_num_threads=threads, initialization_phase=rig.starts_at_rest)
        # below the Python wrapper, which copies the scan once more on each call
        self._lio = LIO(config)._impl
        self._extrinsic = rig.T_imu_lidar
        self._imu = _ImuReader(rig.imu)

    def warm_up(self, scans: list[LidarScan]) -> None:
        for scan in scans[:2]:
            self.register(self.prepare(scan))

    def prepare(self, scan: LidarScan) -> Any:
        from rko_lio.rko_lio_pybind import _Vector3sVector, _VectorInt64

        stamps = scan.stamp_ns + np.round(scan.time.astype(np.float64) * 1e9).astype(np.int64)
        begin, end = int(stamps.min()), int(stamps.max())
        vectors = _Vector3sVector(scan.points.astype(np.float64)), _VectorInt64(stamps)
        return list(self._imu.until(end)), *vectors, begin, end

    def register(self, prepared: Any) -> Pose:
        samples, points, stamps, begin, end = prepared
        for stamp, gyro, accel in samples:
            self._lio.add_imu_measurement(accel, gyro, stamp)
        self._lio.register_scan(self._extrinsic, points, stamps, begin, end)
        pose: Pose = np.asarray(self._lio.pose()) @ self._extrinsic
        return pose


class EvalioPipeline:
    """One of the systems that evalio contains."""

    name: ClassVar[str]
    instant: ClassVar[float]
    instant_reason: ClassVar[str]
    pipeline: ClassVar[str]
    """Name of the class in evalio.pipelines."""
    behind: ClassVar[int] = 0
    """Number of scans by which a pose is delayed; evalio stamps it with the newest scan."""

    def __init__(self, threads: int, rig: Rig) -> None:
        from evalio import pipelines
        from evalio.types import SE3, SO3, ImuParams, LidarParams

        self.estimates: list[tuple[int, Pose]] = []
        """Start of the scan to which a pose belongs, and the pose; the reader of the list clears it."""
        self._scans_ns: list[int] = []
        self._pose: Pose = rig.T_imu_lidar
        self._rig, self._imu = rig, _ImuReader(rig.imu)
        self._pipeline = getattr(pipelines, self.pipeline)()
        unused = self._pipeline.set_params({**self._pipeline.default_params(), **self.settings(threads, rig)})
        if unused:
            raise ValueError(f"evalio's {self.pipeline} knows no setting {', '.join(unused)}.")
        self._pipeline.set_imu_params(
            ImuParams(
                gyro=rig.noise["gyro_noise"],
                accel=rig.noise["accel_noise"],
                gyro_bias=rig.noise["gyro_bias_walk"],
                accel_bias=rig.noise["accel_bias_walk"],
                gravity=np.array([0.0, 0.0, -9.80665]),
            )
        )
        self._pipeline.set_lidar_params(
            LidarParams(
                num_rows=rig.beams,
                num_columns=rig.columns,
                min_range=rig.min_range,
                max_range=rig.max_range,
            )
        )
        rotation = SO3.from_mat(np.asfortranarray(rig.T_imu_lidar[:3, :3]))
        self._pipeline.set_imu_T_lidar(SE3(rotation, rig.T_imu_lidar[:3, 3].copy()))
        self._pipeline.initialize()

    def settings(self, threads: int, rig: Rig) -> dict[str, bool | int | float | str]:
        """Return the settings that differ from the defaults."""
        return {}

    def warm_up(self, scans: list[LidarScan]) -> None:
        for scan in scans[:2]:
            self.register(self.prepare(scan))

    def prepare(self, scan: LidarScan) -> Any:
        from evalio.types import ImuMeasurement, Stamp

        self._scans_ns.append(scan.stamp_ns)
        samples = [
            ImuMeasurement(Stamp.from_nsec(stamp), gyro, accel)
            for stamp, gyro, accel in self._imu.until(scan.end_ns + 1)
        ]
        return samples, _measurement(scan, self._rig)

    def register(self, prepared: Any) -> Pose:
        samples, measurement = prepared
        for sample in samples:
            self._pipeline.add_imu(sample)
        self._pipeline.add_lidar(measurement)
        for stamp, pose in self._pipeline.saved_estimates():
            self._pose = pose.to_mat() @ self._rig.T_imu_lidar
            number = self._scans_ns.index(stamp.to_nsec()) - self.behind
            if number >= 0:
                self.estimates.append((self._scans_ns[number], self._pose))
        return self._pose


class LioSam(EvalioPipeline):
    """LIO-SAM without loops and GPS."""

    name: ClassVar[str] = "lio-sam"
    instant: ClassVar[float] = 0.5
    instant_reason: ClassVar[str] = (
        "rotation is deskewed to the scan's start and translation not at all: its positions fit the middle "
        "best, its rotations the start"
    )
    pipeline: ClassVar[str] = "LioSAM"
    behind: ClassVar[int] = 2

    def settings(self, threads: int, rig: Rig) -> dict[str, bool | int | float | str]:
        # by default it maps every second scan, and gives no pose for the others
        return {"numberOfCores": threads, "mappingProcessInterval": 0.0}


class Loam(EvalioPipeline):
    """LOAM, LiDAR only, without deskewing."""

    name: ClassVar[str] = "loam"
    instant: ClassVar[float] = 0.5
    instant_reason: ClassVar[str] = (
        "no deskewing: a moving sensor's points fit best at the middle of the scan"
    )
    pipeline: ClassVar[str] = "LOAM"


class Dlio(EvalioPipeline):
    """DLIO."""

    name: ClassVar[str] = "dlio"
    instant: ClassVar[float] = 0.5
    instant_reason: ClassVar[str] = "deskews to the time of the scan's median point"
    pipeline: ClassVar[str] = "DLIO"

    def settings(self, threads: int, rig: Rig) -> dict[str, bool | int | float | str]:
        # its 3 s of calibration would include motion
        return {"imu_calibrate": rig.starts_at_rest, "imu_calib_time": 1.0}


def _measurement(scan: LidarScan, rig: Rig) -> Any:
    """Return the scan in evalio's form, with each ray in the column in which it was fired."""
    # float32 seconds: half a microsecond keeps a ray in its column
    column = np.floor((scan.time.astype(np.float64) + 5e-7) / (scan.duration / rig.columns)).astype(np.intp)
    return measurement(scan, column, np.ones(len(column), bool), rig.beams, rig.columns)


def measurement(
    scan: LidarScan, column: NDArray[np.intp], kept: NDArray[np.bool_], beams: int, columns: int
) -> Any:
    """Return the scan in evalio's form: row by row, rays without a return as zeros.

    Args:
        scan: the scan as recorded.
        column: column of each point; points beyond the last column are put into it.
        kept: which points are passed on.
        beams: number of rows.
        columns: number of columns in a row.
    """
    from evalio._cpp.helpers import (
        DataType,
        Field,
        PointCloudMetadata,
        fill_col_row_major,
        pc2_to_evalio,
    )
    from evalio.types import Stamp

    fields = {"x": DataType.FLOAT32, "y": DataType.FLOAT32, "z": DataType.FLOAT32}
    fields |= {"intensity": DataType.FLOAT32, "t": DataType.UINT32, "range": DataType.UINT32}
    fields |= {"ring": DataType.UINT16}
    kinds = {DataType.FLOAT32: np.float32, DataType.UINT32: np.uint32, DataType.UINT16: np.uint16}
    layout = np.dtype([(name, kinds[kind]) for name, kind in fields.items()])
    grid = np.zeros((beams, columns), layout)
    period = scan.duration / columns
    grid["t"] = np.round(1e9 * period * np.arange(columns)).astype(np.uint32)
    grid["ring"] = np.arange(beams)[:, None]
    place = scan.ring[kept], np.minimum(column[kept], columns - 1)
    points = scan.points[kept]
    for axis, name in enumerate("xyz"):
        grid[name][place] = points[:, axis]
    grid["intensity"][place] = scan.intensity[kept]
    grid["t"][place] = np.round(scan.time[kept].astype(np.float64) * 1e9).astype(np.uint32)
    grid["range"][place] = np.round(1e3 * np.linalg.norm(points, axis=1)).astype(np.uint32)
    cloud = PointCloudMetadata(
        stamp=Stamp.from_nsec(scan.stamp_ns),
        width=grid.size,
        height=1,
        point_step=layout.itemsize,
        row_step=layout.itemsize * grid.size,
        is_bigendian=0,
        is_dense=0,
    )
    offsets = [
        Field(name=name, datatype=kind, offset=layout.fields[name][1])  # type: ignore[index]
        for name, kind in fields.items()
    ]
    measurement = pc2_to_evalio(cloud, offsets, grid.tobytes())
    fill_col_row_major(measurement)
    return measurement


INERTIAL_PEERS = {system.name: system for system in (RkoLio, LioSam, Loam, Dlio)}
"""Classes by name: ``class(threads, rig)``."""
