"""What a recording is: one protocol for all formats."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.trajectory import Trajectory


class WarningLog:
    """Collect sentences in the order they first came up."""

    def __init__(self) -> None:
        self._sentences: dict[str, None] = {}

    def add(self, sentence: str) -> None:
        """Remember ``sentence`` unless it was said before."""
        self._sentences[sentence] = None

    @property
    def sentences(self) -> tuple[str, ...]:
        """All sentences so far; safe to ask while another thread decodes."""
        return tuple(self._sentences.copy())


@dataclass(frozen=True)
class LidarScan:
    """One sweep as it was recorded, NaN, infinite and zero returns already dropped."""

    stamp_ns: int
    """Absolute time of the scan's start, ns."""
    points: NDArray[np.float32]
    """(n, 3) m, lidar frame at each point's own firing time."""
    time: NDArray[np.float32]
    """(n,) s from the scan's start, within [0, duration]."""
    ring: NDArray[np.int32]
    """(n,) beam index."""
    intensity: NDArray[np.float32]
    """(n,) as the sensor reports it."""
    duration: float
    """s from scan start to scan end; 0 for a sweep that is already motion compensated."""
    dropped: int = 0
    """Number of firings that were recorded without a return: NaN, infinite or zero."""

    @property
    def end_ns(self) -> int:
        """Absolute time of the scan's end, ns: the instant a scan pose refers to."""
        return self.stamp_ns + round(self.duration * 1e9)


@dataclass(frozen=True)
class ImuData:
    """All inertial samples of a recording, in time order."""

    stamp_ns: NDArray[np.int64]
    gyro: NDArray[np.float64]
    """(m, 3) rad/s, IMU frame."""
    accel: NDArray[np.float64]
    """(m, 3) m/s^2, specific force: +g upwards at rest."""
    orientation: NDArray[np.float64] | None = None
    """(m, 4) quaternion xyzw of T_world_imu from a 9-axis unit."""


@dataclass(frozen=True)
class GpsData:
    """All GPS fixes of a recording in a local east-north-up frame around ``origin``."""

    stamp_ns: NDArray[np.int64]
    position: NDArray[np.float64]
    """(m, 3) m, ENU."""
    covariance: NDArray[np.float64]
    """(m, 3, 3) m^2."""
    origin: tuple[float, float, float]
    """Latitude deg, longitude deg, altitude m of the frame's origin; NaN where only local positions exist."""


@dataclass(frozen=True)
class SequenceInfo:
    """What is known about a recording before its first scan is decoded."""

    name: str
    """Short name for titles and file names."""
    format: str
    """Reader that opened it: kitti_odometry, kitti_raw, rosbag or native."""
    path: str
    scan_count: int
    T_imu_lidar: NDArray[np.float64] | None = None
    """(4, 4) from the recording's calibration; None where it holds none."""
    sensor: str = ""
    """Sensor model where it is known."""
    notes: tuple[str, ...] = field(default_factory=tuple)
    """One sentence for each thing that was recognised, assumed or repaired while opening."""


class Sequence(Protocol):
    """A recording that can be replayed any number of times."""

    @property
    def info(self) -> SequenceInfo:
        """Return what is known without decoding scans."""
        ...

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans ``start`` to ``start + count`` in recorded order; a scan may be empty.

        A scan that cannot be decoded is skipped and reported through ``warnings_so_far``.
        """
        ...

    def imu(self) -> ImuData | None:
        """Return all inertial samples, or None where there are none."""
        ...

    def gps(self) -> GpsData | None:
        """Return all GPS fixes, or None where there are none."""
        ...

    def truth(self) -> Trajectory | None:
        """Return the ground-truth T_world_imu, or None where there is none."""
        ...

    @property
    def warnings_so_far(self) -> tuple[str, ...]:
        """Return one sentence for each problem met so far (missing, empty, unreadable scan)."""
        ...
