"""The simulated worlds as datasets of evalio: a sequence for each sensor and seed.

``evalio dl`` simulates a sequence and keeps it in evalio's data folder, in the package's native format;
nothing is downloaded. evalio starts each experiment by a fork, which a process that runs JAX does not
survive: hence nothing here runs JAX apart from that simulation.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from evalio._cpp.helpers import DataType, Field, PointCloudMetadata, fill_col_row_major, pc2_to_evalio
from evalio.datasets import Dataset, DatasetIterator
from evalio.types import (
    SE3,
    SO3,
    ImuMeasurement,
    ImuParams,
    LidarMeasurement,
    LidarParams,
    Stamp,
    Trajectory,
)
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from lio_jax.commands.runtime import prepare_jax
from lio_jax.data.config import DataConfig
from lio_jax.data.native import NativeSequence
from lio_jax.data.native_writer import write_native
from lio_jax.data.sequence import LidarScan
from lio_jax.sim.imu import GRAVITY, ImuModel
from lio_jax.sim.sequence import DEFAULT_T_IMU_LIDAR, WORLDS, SimulatedSequence

DURATION_S = 60.0
"""Length of every sequence, s."""
SEEDS = (0, 1, 2)
_LATENCY_NS = 10_000_000
"""A scan arrives this long after its end, as from a driver."""
_RATE = 10.0
"""Sweeps per second of every sensor."""


@dataclass(frozen=True)
class SensorShape:
    """What evalio is told of a simulated sensor, stated here because making the sensor runs JAX."""

    rows: int
    columns: int
    min_range: float
    max_range: float
    brand: str
    model: str
    sensor: str = ""
    """Name for the simulator; "": the sequence's own."""


SENSOR_SHAPES = {
    "generic16": SensorShape(16, 512, 0.5, 100.0, "-", "ideal, few points", "generic32"),
    "generic32": SensorShape(32, 1024, 0.5, 100.0, "-", "ideal"),
    "vlp16": SensorShape(16, 1800, 0.5, 100.0, "Velodyne", "VLP-16"),
    "hdl32": SensorShape(32, 2170, 1.0, 100.0, "Velodyne", "HDL-32E"),
    "hdl64": SensorShape(64, 2083, 0.9, 120.0, "Velodyne", "HDL-64E"),
    "os1_64": SensorShape(64, 1024, 0.5, 120.0, "Ouster", "OS1-64"),
    "os1_128": SensorShape(128, 1024, 0.5, 120.0, "Ouster", "OS1-128"),
    "livox": SensorShape(6, 4000, 1.0, 200.0, "Livox", "Avia"),
}


def simulated(world: str, sensor: str, seed: int, duration_s: float = DURATION_S) -> SimulatedSequence:
    """Return the recording that a sequence of evalio holds.

    Args:
        world: a name of :data:`lio_jax.sim.sequence.WORLDS`.
        sensor: a name of :data:`SENSOR_SHAPES`.
        seed: of world, motion and noise.
        duration_s: length, s.
    """
    shape = SENSOR_SHAPES[sensor]
    sizes: dict[str, Any] = {"beams": shape.rows, "columns": shape.columns} if shape.sensor else {}
    return SimulatedSequence(world, shape.sensor or sensor, duration_s, seed, imu=ImuModel(), **sizes)


def write_sequence(folder: Path, sequence: SimulatedSequence) -> None:
    """Write a simulated recording into a folder of evalio's data, complete or not at all."""
    if folder.is_dir() and not any(folder.iterdir()):
        # what "evalio rm" leaves
        folder.rmdir()
    with tqdm(total=sequence.info.scan_count, unit="scan", disable=None, leave=False) as bar:
        write_native(
            folder,
            _counted(sequence.scans(), bar),
            name=sequence.info.name,
            sensor=sequence.info.sensor,
            T_imu_lidar=sequence.info.T_imu_lidar,
            imu=sequence.imu(),
            truth=sequence.truth(),
        )


def _counted(scans: Iterator[LidarScan], bar: Any) -> Iterator[LidarScan]:
    for scan in scans:
        yield scan
        bar.update()


class SimulatedDataset(Dataset):  # type: ignore[misc, unused-ignore]
    """A simulated world; a subclass lists its sequences, ``SENSOR_SEED``."""

    def data_iter(self) -> DatasetIterator:
        """Return the measurements in the order of their arrival."""
        return SimulatedIterator(self._recording(), self._shape())

    def ground_truth_raw(self) -> Trajectory:
        """Return the true T_world_imu."""
        truth = self._recording().truth()
        assert truth is not None, "every sequence is written with its truth"
        rotations = Rotation.from_matrix(truth.poses[:, :3, :3]).as_quat().tolist()
        poses = [
            SE3(SO3(qx=x, qy=y, qz=z, qw=w), position)
            for (x, y, z, w), position in zip(rotations, truth.positions, strict=True)
        ]
        stamps = [Stamp.from_nsec(stamp_ns) for stamp_ns in truth.stamp_ns.tolist()]
        return Trajectory(stamps=stamps, poses=poses)

    def imu_T_lidar(self) -> SE3:
        """Return the pose of the LiDAR in the IMU frame."""
        return SE3.from_mat(np.asfortranarray(DEFAULT_T_IMU_LIDAR))

    def imu_T_gt(self) -> SE3:
        """Return the identity: the truth is that of the IMU."""
        return SE3.identity()

    def imu_params(self) -> ImuParams:
        """Return the true noise of the inertial samples."""
        model = ImuModel()
        return ImuParams(
            gyro=model.gyro_noise,
            accel=model.accel_noise,
            gyro_bias=model.gyro_bias_walk,
            accel_bias=model.accel_bias_walk,
            gravity=GRAVITY,
            rate=model.rate,
            brand="simulated",
            model="MEMS",
        )

    def lidar_params(self) -> LidarParams:
        """Return the size and the range limits of the sensor."""
        shape = self._shape()
        return LidarParams(
            num_rows=shape.rows,
            num_columns=shape.columns,
            min_range=shape.min_range,
            max_range=shape.max_range,
            rate=_RATE,
            brand=shape.brand,
            model=shape.model,
        )

    def files(self) -> Sequence[str | Path]:
        """Return the parts of the recording's folder."""
        return ["meta.yaml", "truth.tum", "imu.npz", "scans"]

    def environment(self) -> str:
        """Return the world's name."""
        return f"simulated {self._world()}"

    def vehicle(self) -> str:
        """Return that there is none."""
        return "simulated"

    def quick_len(self) -> int:
        """Return the number of scans."""
        scans = self.folder / "scans"
        return len(list(scans.glob("*.npz"))) if scans.is_dir() else round(DURATION_S * _RATE)

    def download(self) -> None:
        """Simulate the sequence, and keep it in evalio's data folder."""
        prepare_jax()
        sensor, _, seed = self.value.rpartition("_")
        write_sequence(self.folder, simulated(self._world(), sensor, int(seed)))

    def _recording(self) -> NativeSequence:
        return NativeSequence(self.folder, DataConfig())

    def _shape(self) -> SensorShape:
        return SENSOR_SHAPES[self.value.rpartition("_")[0]]

    def _world(self) -> str:
        return self.dataset_name().removeprefix("lio_jax_")


def _dataset(world: str) -> type[SimulatedDataset]:
    sequences = [f"{sensor}_{seed}" for sensor in SENSOR_SHAPES for seed in SEEDS]
    members = [(name, name) for name in sequences]
    made: Any = SimulatedDataset(f"LioJax{world.capitalize()}", members, module=__name__)  # type: ignore[call-arg, arg-type, unused-ignore]
    kind: type[SimulatedDataset] = made
    return kind


WORLD_DATASETS: dict[str, type[SimulatedDataset]] = {world: _dataset(world) for world in WORLDS}
"""evalio's dataset of each world: lio_jax_city, lio_jax_street and so on."""


class SimulatedIterator(DatasetIterator):
    """The measurements of a recording; a scan comes a little after its end, with the samples before it."""

    def __init__(self, recording: NativeSequence, shape: SensorShape) -> None:
        """Open nothing yet."""
        self._recording, self._shape = recording, shape

    def imu_iter(self) -> Iterator[ImuMeasurement]:
        """Yield the inertial samples."""
        imu = self._recording.imu()
        assert imu is not None, "every sequence is written with inertial samples"
        for stamp_ns, gyro, accel in zip(imu.stamp_ns.tolist(), imu.gyro, imu.accel, strict=True):
            yield ImuMeasurement(Stamp.from_nsec(stamp_ns), gyro, accel)

    def lidar_iter(self) -> Iterator[LidarMeasurement]:
        """Yield the scans."""
        for scan in self._recording.scans():
            yield measurement_of(scan, self._shape)

    def __iter__(self) -> Iterator[ImuMeasurement | LidarMeasurement]:
        """Yield all measurements."""
        samples = self.imu_iter()
        sample = next(samples, None)
        for scan in self._recording.scans():
            arrival_ns = scan.end_ns + _LATENCY_NS
            while sample is not None and sample.stamp.to_nsec() <= arrival_ns:
                yield sample
                sample = next(samples, None)
            yield measurement_of(scan, self._shape)
        while sample is not None:
            yield sample
            sample = next(samples, None)

    def __len__(self) -> int:
        """Return the number of scans."""
        return self._recording.info.scan_count


_CLOUD = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("intensity", "<f4"),
        ("t", "<u4"),
        ("range", "<u4"),
        ("ring", "<u2"),
    ]
)
_FIELDS = [
    ("x", DataType.FLOAT32, 0),
    ("y", DataType.FLOAT32, 4),
    ("z", DataType.FLOAT32, 8),
    ("intensity", DataType.FLOAT32, 12),
    ("t", DataType.UINT32, 16),
    ("range", DataType.UINT32, 20),
    ("ring", DataType.UINT16, 24),
]
"""The fields of ``_CLOUD`` as evalio takes them: name, kind and place."""


def measurement_of(scan: LidarScan, shape: SensorShape) -> LidarMeasurement:
    """Return a scan as evalio holds it: all firings row by row, a firing without a return at the origin.

    Args:
        scan: of a simulated sensor.
        shape: of that sensor.
    """
    cloud = _grid(scan, shape)
    fields = [Field(name=name, datatype=kind, offset=offset) for name, kind, offset in _FIELDS]
    described = PointCloudMetadata(
        stamp=Stamp.from_nsec(scan.stamp_ns),
        width=shape.columns,
        height=shape.rows,
        point_step=_CLOUD.itemsize,
        row_step=_CLOUD.itemsize * shape.columns,
        is_bigendian=0,
        is_dense=0,
    )
    measurement = pc2_to_evalio(described, fields, cloud.tobytes())
    fill_col_row_major(measurement)
    return measurement


_ROUNDING_NS = 500
"""Times of points are float32; every beam of a column fires before the next column begins."""


def _grid(scan: LidarScan, shape: SensorShape) -> NDArray[Any]:
    period_ns = scan.duration * 1e9
    step_ns = period_ns / shape.columns
    since_ns = scan.time.astype(np.float64) * 1e9
    column = np.minimum((since_ns + _ROUNDING_NS) // step_ns, shape.columns - 1).astype(np.intp)
    cloud = np.zeros((shape.rows, shape.columns), _CLOUD)
    cloud["ring"] = np.arange(shape.rows)[:, None]
    cloud["t"] = np.round(np.arange(shape.columns) * step_ns)
    at = scan.ring, column
    for axis, name in enumerate("xyz"):
        cloud[name][at] = scan.points[:, axis]
    cloud["intensity"][at] = scan.intensity
    cloud["t"][at] = np.round(since_ns)
    cloud["range"][at] = np.round(np.linalg.norm(scan.points, axis=1) * 1000)
    return cloud
