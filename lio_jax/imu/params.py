"""Parameters of the inertial sensor and of the first navigation state."""

from dataclasses import dataclass

import equinox as eqx
from jaxtyping import Array, Float

from lio_jax.core.leaf import leaf, static
from lio_jax.core.types import Scalar


class ImuParams(eqx.Module):
    """The inertial sensor's noise, as continuous-time densities."""

    gyro_noise: Scalar = leaf(2e-3, "rad/s/sqrt(Hz)", above=0, tuned="log")
    """White noise of the angular rate."""
    accel_noise: Scalar = leaf(2e-2, "m/s^2/sqrt(Hz)", above=0, tuned="log")
    """White noise of the specific force."""
    gyro_bias_walk: Scalar = leaf(2e-5, "rad/s^2/sqrt(Hz)", above=0, tuned="log")
    """Random walk of the gyroscope's bias."""
    accel_bias_walk: Scalar = leaf(2e-4, "m/s^3/sqrt(Hz)", above=0, tuned="log")
    """Random walk of the accelerometer's bias."""
    gravity: Scalar = leaf(9.80665, "m/s^2", above=0, tuned="log")
    """Magnitude of gravity."""


class FirstMotionParams(eqx.Module):
    """The motion at the first scan."""

    velocity: Float[Array, "3"] = leaf((0.0, 0.0, 0.0), "m/s")
    """First velocity, along the axes of the IMU at the first scan's end. Zero: the first two scans show it,
    whatever the speed is."""


class InitialParams(FirstMotionParams):
    """First velocity, and standard deviations of the first navigation state; zero freezes that part of the
    state."""

    rotation_sigma: Scalar = leaf(0.0, "rad", least=0, tuned="log")
    """Standard deviation of the first roll and pitch. Zero is consistent with a map that starts at the first
    scan: the map is as tilted as the first pose, and what is unknown is the direction of gravity in it."""
    velocity_sigma: Scalar = leaf(10.0, "m/s", least=0, tuned="log")
    """Standard deviation of the first velocity. It is wide, because inertial samples cannot distinguish rest
    from constant velocity; the second scan can."""
    gyro_bias_sigma: Scalar = leaf(0.01, "rad/s", least=0, tuned="log")
    """Standard deviation of the first gyroscope bias."""
    accel_bias_sigma: Scalar = leaf(0.1, "m/s^2", least=0, tuned="log")
    """Standard deviation of the first accelerometer bias."""
    gravity_sigma: Scalar = leaf(0.1, "rad", least=0, tuned="log")
    """Standard deviation of gravity's direction in the world that the first pose defines, before the samples
    at rest are used."""
    extrinsic_rotation_sigma: Scalar = leaf(0.0, "rad", least=0, tuned="log")
    """Standard deviation of the rotation of T_imu_lidar; zero keeps the calibrated rotation."""
    extrinsic_translation_sigma: Scalar = leaf(0.0, "m", least=0, tuned="log")
    """Standard deviation of the translation of T_imu_lidar; zero keeps the calibrated translation."""
    time_offset_sigma: Scalar = leaf(0.0, "s", least=0, tuned="log")
    """Standard deviation of the lidar's clock offset; zero keeps the given offset."""


@dataclass(frozen=True)
class ImuConfig:
    """Use of the inertial samples."""

    use: bool = static(True)
    """Use the recording's inertial samples; false: LiDAR odometry."""
    buckets: tuple[int, ...] = static((32, 64, 128, 256, 512, 1024, 2048))
    """Padded numbers of samples between two scans. More samples than the largest size are thinned to it."""


@dataclass(frozen=True)
class OrientedImuConfig(ImuConfig):
    """Use of an IMU that reports its attitude."""

    orientation: bool = static(True)
    """Use the attitude that a 9-axis IMU reports itself."""
    heading: bool = static(False)
    """Begin with the heading of that attitude too."""
