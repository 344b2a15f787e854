"""A small sequence with everything in it, and how it is written as a bag."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from lio_jax.data.bag_writer import write_bag
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, SequenceInfo
from lio_jax.data.trajectory import Trajectory, pose_matrices

START = 1_700_000_000_000_000_000
PERIOD = 100_000_000
SCANS, COLUMNS, RINGS = 4, 60, 16
ORIGIN = (48.137, 11.575, 519.0)

FORMATS = {
    "a.bag": "ros1",
    "a.db3": "ros2-sqlite3",
    "b": "ros2-sqlite3",
    "a.mcap": "ros2-mcap",
    "c": "ros2-mcap",
}
LAYOUTS = ("velodyne", "ouster", "livox")
FIRING_NS = 1_666_649
"""Between columns: an odd number, so that rounding to another unit shows."""


@dataclass
class Recorded:
    """A sequence with everything in it."""

    info: SequenceInfo
    all_scans: list[LidarScan]
    imu_data: ImuData | None
    gps_data: GpsData | None
    truth_data: Trajectory | None

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        yield from self.all_scans[start : None if count is None else start + count]

    def imu(self) -> ImuData | None:
        return self.imu_data

    def gps(self) -> GpsData | None:
        return self.gps_data

    def truth(self) -> Trajectory | None:
        return self.truth_data

    @property
    def warnings_so_far(self) -> tuple[str, ...]:
        return ()


def _scan(number: int) -> LidarScan:
    random = np.random.default_rng(number)
    column, ring = (grid.ravel() for grid in np.meshgrid(np.arange(COLUMNS), np.arange(RINGS), indexing="ij"))
    return LidarScan(
        stamp_ns=START + number * PERIOD,
        points=random.uniform(-60, 60, (len(ring), 3)).astype(np.float32),
        time=(column * FIRING_NS * 1e-9).astype(np.float32),
        ring=ring.astype(np.int32),
        intensity=random.integers(0, 256, len(ring)).astype(np.float32),
        duration=0.1,
    )


def recorded_sequence() -> Recorded:
    random = np.random.default_rng(7)
    imu_stamps = START - 50_000_000 + np.arange(90) * 5_000_000
    gps_stamps = START + np.arange(4) * 100_000_000 + 1
    truth_stamps = START + np.arange(41) * 10_000_000
    positions = random.normal(size=(41, 3))
    quaternions = Rotation.random(41, random_state=3).as_quat()
    T_imu_lidar = pose_matrices(np.array([[0.1, -0.2, 0.3]]), Rotation.random(1, random_state=5).as_quat())[0]
    return Recorded(
        SequenceInfo("all", "simulated", "", SCANS, T_imu_lidar),
        [_scan(number) for number in range(SCANS)],
        ImuData(imu_stamps, random.normal(size=(90, 3)), random.normal([0, 0, 9.8], size=(90, 3))),
        GpsData(
            gps_stamps,
            random.normal(size=(4, 3)) * [300.0, 300.0, 5.0],
            np.tile(np.array([[4.0, 0.5, 0.0], [0.5, 3.0, 0.0], [0.0, 0.0, 9.0]]), (4, 1, 1)),
            ORIGIN,
        ),
        Trajectory(truth_stamps, pose_matrices(positions, quaternions)),
    )


def write(path: Path, sequence: Recorded, layout: str = "velodyne", **words: Any) -> int:
    return write_bag(path, sequence, bag_format=FORMATS[path.name], layout=layout, **words)
