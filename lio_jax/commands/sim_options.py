"""Options of ``lio-jax sim`` apart from world, sensor, length and seed; imports nothing heavy."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from tyro.conf import arg

Format = Literal["native", "ros1", "ros2-sqlite3", "ros2-mcap"]

Number = Annotated[float | None, arg(metavar="X")]


@dataclass(frozen=True)
class MotionOptions:
    """How the vehicle moves."""

    standstill: Annotated[float | None, arg(metavar="SEC")] = None
    """Time at rest at the start; None means 1.5 s, or none with --moving-start."""
    moving_start: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Start at full speed."""
    swing_rate: Annotated[float | None, arg(metavar="RAD/S")] = None
    """How fast a hand looks around in worlds through which it carries the sensor; None means 0.8, and 4 is as
    fast as a wrist can."""
    trajectory: Annotated[Path | None, arg(metavar="FILE")] = None
    """Poses T_world_imu (TUM, run folder or recording) to move through, instead of the world's own route."""


@dataclass(frozen=True)
class SensorOptions:
    """The sensors of the recording, and the pose of the LiDAR."""

    imu_rate: Annotated[float, arg(metavar="HZ")] = 200.0
    """Inertial samples per second; 0 leaves the IMU out."""
    gps_rate: Annotated[float, arg(metavar="HZ")] = 0.0
    """GPS fixes per second; 0 leaves the GPS out."""
    lidar_translation: Annotated[tuple[float, float, float] | None, arg(metavar="X Y Z")] = None
    """Position of the LiDAR in the IMU frame, m; None means a small lever arm."""
    lidar_rotation: Annotated[tuple[float, float, float, float] | None, arg(metavar="X Y Z W")] = None
    """Quaternion of the LiDAR in the IMU frame; None means a slight tilt."""


@dataclass(frozen=True)
class ErrorOptions:
    """Errors of the sensors; None means the sensor's usual error."""

    range_noise: Number = None
    """Standard deviation of a range, m."""
    gyro_noise: Number = None
    """White noise density, rad/s/sqrt(Hz)."""
    accel_noise: Number = None
    """White noise density, m/s^2/sqrt(Hz)."""
    gyro_bias_walk: Number = None
    """Random-walk density, rad/s^2/sqrt(Hz)."""
    accel_bias_walk: Number = None
    """Random-walk density, m/s^3/sqrt(Hz)."""
    gyro_bias_sigma: Number = None
    """Standard deviation of the initial bias, rad/s."""
    accel_bias_sigma: Number = None
    """Standard deviation of the initial bias, m/s^2."""
    time_offset: Number = None
    """Delay of the inertial stamps, s."""
    gps_noise: Number = None
    """Standard deviation of a fix along each axis, m."""
    gps_multipath: Number = None
    """Standard deviation of a fix's slow error, m."""
    gps_outage_every: Number = None
    """Mean time between GPS outages, s."""
