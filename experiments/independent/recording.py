"""Put a world, a motion and sensors together, and write them as a native recording with the truth."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from independent.motion import GRAVITY, Kind, Motion, Start, motion_of
from independent.sensors import Imu, Lidar, RayCaster, Returns, Samples, samples_of, scan_at
from independent.street import CentreLine, Floats, Ground, street
from lio_jax.data.native_writer import write_native
from lio_jax.data.sequence import ImuData, LidarScan
from lio_jax.data.trajectory import Trajectory

EPOCH_NS = 1_700_000_000_000_000_000
_TRUTH_HZ = 200


def _mount() -> Floats:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("ZYX", [8.0, 2.0, -1.0], degrees=True).as_matrix()
    pose[:3, 3] = [0.15, -0.05, 0.6]
    return pose


T_IMU_LIDAR = _mount()
"""Pose of the LiDAR in the IMU frame, (4, 4)."""


@dataclass(frozen=True)
class Recording:
    """What determines a recording."""

    seed: int = 0
    seconds: float = 20.0
    motion_kind: Kind = "vehicle"
    start: Start = "rest"
    lidar: Lidar = field(default_factory=Lidar)
    imu: Imu = field(default_factory=Imu)

    @cached_property
    def _place(self) -> tuple[CentreLine, Ground]:
        return CentreLine(), Ground.drawn(np.random.default_rng([self.seed, 0]))

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The world."""
        return street(self.seed, *self._place)

    @cached_property
    def motion(self) -> Motion:
        """The true motion of the IMU."""
        return motion_of(self.motion_kind, self.start, self.seconds, self.seed, *self._place)

    @cached_property
    def samples(self) -> Samples:
        """The readings of the IMU."""
        return samples_of(self.motion, self.imu, self.seconds, np.random.default_rng([self.seed, 3]))

    def returns(self) -> Iterator[Returns]:
        """Yield the turns of the LiDAR."""
        caster, rng = RayCaster(self.mesh), np.random.default_rng([self.seed, 4])
        for number in range(int(self.seconds / self.lidar.period_s + 1e-6)):
            start = number * self.lidar.period_s
            yield scan_at(start, self.lidar, T_IMU_LIDAR, self.motion, caster, rng)

    def write(self, path: Path, overwrite: bool = False) -> int:
        """Write the native folder and return its number of scans."""
        samples = self.samples
        times = np.arange(round(self.seconds * _TRUTH_HZ) + 1) / _TRUTH_HZ
        known = {
            **asdict(self.imu),
            **asdict(self.lidar),
            "gyro_bias": samples.gyro_bias,
            "accel_bias": samples.accel_bias,
            "imu_stamp_ns": _stamps(samples.time),
            "gravity": GRAVITY,
            "T_imu_lidar": T_IMU_LIDAR,
            "starts_at_rest": self.motion.at_rest_first,
        }
        return write_native(
            path,
            (self._scan(number, turn) for number, turn in enumerate(self.returns())),
            name=path.name,
            sensor=f"{self.lidar.beams} beams x {self.lidar.columns} columns, ray cast through a mesh",
            T_imu_lidar=T_IMU_LIDAR,
            imu=ImuData(_stamps(samples.time), samples.gyro, samples.accel),
            truth=Trajectory(_stamps(times), self.motion.poses(times)),
            truth_arrays=known,
            overwrite=overwrite,
        )

    def _scan(self, number: int, turn: Returns) -> LidarScan:
        return LidarScan(
            stamp_ns=EPOCH_NS + round(number * self.lidar.period_s * 1e9),
            points=turn.points.astype(np.float32),
            time=turn.time.astype(np.float32),
            ring=turn.ring,
            intensity=np.ones(len(turn.points), np.float32),
            duration=self.lidar.period_s,
        )


def _stamps(times: Floats) -> np.ndarray:
    return EPOCH_NS + np.round(times * 1e9).astype(np.int64)
