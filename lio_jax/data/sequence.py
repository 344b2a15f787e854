"""The protocol that all recordings share, and the data they hold."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.trajectory import Trajectory


class WarningLog:
    """Collect sentences, each once, in the order in which they first occurred."""

    def __init__(self) -> None:
        self._sentences: dict[str, None] = {}

    def add(self, sentence: str) -> None:
        """Remember ``sentence`` unless it is known already."""
        self._sentences[sentence] = None

    @property
    def sentences(self) -> tuple[str, ...]:
        """All sentences so far; it may be read while another thread decodes."""
        return tuple(self._sentences.copy())


@dataclass(frozen=True)
class LidarScan:
    """One sweep as it was recorded, without NaN, infinite and zero returns."""

    stamp_ns: int
    """Absolute time of the scan's start, ns."""
    points: NDArray[np.float32]
    """Points in the lidar frame at each point's own firing time, (n, 3) m."""
    time: NDArray[np.float32]
    """Time of each point from the scan's start, (n,) s, within [0, duration]."""
    ring: NDArray[np.int32]
    """Beam index of each point, (n,)."""
    intensity: NDArray[np.float32]
    """Intensity in the sensor's scale, (n,)."""
    duration: float
    """Time from scan start to scan end, s; 0 for a sweep that is already motion compensated."""
    dropped: int = 0
    """Number of recorded firings without a return: NaN, infinite or zero."""

    @property
    def end_ns(self) -> int:
        """Absolute time of the scan's end, ns: the instant to which the scan's pose refers."""
        return self.stamp_ns + round(self.duration * 1e9)


@dataclass(frozen=True)
class ImuData:
    """All inertial samples of a recording, in time order."""

    stamp_ns: NDArray[np.int64]
    """Absolute time of each sample, (m,) ns, ascending."""
    gyro: NDArray[np.float64]
    """Angular rate, (m, 3) rad/s, IMU frame."""
    accel: NDArray[np.float64]
    """Specific force, (m, 3) m/s^2, IMU frame; +g upwards at rest."""
    orientation: NDArray[np.float64] | None = None
    """Quaternion xyzw of T_world_imu from a 9-axis unit, (m, 4); None where the unit has none."""


@dataclass(frozen=True)
class GpsData:
    """All GPS fixes of a recording in a local east-north-up frame around ``origin``."""

    stamp_ns: NDArray[np.int64]
    """Absolute time of each fix, (m,) ns, ascending."""
    position: NDArray[np.float64]
    """Position, (m, 3) m, ENU."""
    covariance: NDArray[np.float64]
    """Covariance of the position, (m, 3, 3) m^2, ENU."""
    origin: tuple[float, float, float]
    """Latitude (deg), longitude (deg), altitude (m) of the frame's origin; NaN where positions are local."""


@dataclass(frozen=True)
class SequenceInfo:
    """What is known about a recording before its first scan is decoded."""

    name: str
    """Short name of the recording for titles and file names."""
    format: str
    """Reader that opened it: kitti_odometry, kitti_raw, rosbag or native."""
    path: str
    scan_count: int
    T_imu_lidar: NDArray[np.float64] | None = None
    """Pose of the lidar in the IMU frame, (4, 4), from the recording's calibration; None where unknown."""
    sensor: str = ""
    """Sensor model where it is known."""
    notes: tuple[str, ...] = field(default_factory=tuple)
    """One sentence for each thing that was recognised, assumed or repaired on opening."""


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
