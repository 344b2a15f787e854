"""Noise and priors of the fusion of an odometry with inertial samples and GPS fixes."""

import equinox as eqx
from jaxtyping import Array, Float

from lio_jax.core.leaf import leaf, section
from lio_jax.core.types import Scalar
from lio_jax.imu.params import ImuParams


class OdometryParams(eqx.Module):
    """The odometry's errors: a drift that adds up along the way, and white noise of each pose."""

    rotation_drift: Scalar = leaf(5e-4, "rad/sqrt(m)", above=0, tuned="log")
    """Random walk of the rotation along the way."""
    translation_drift: Scalar = leaf(5e-3, "m/sqrt(m)", above=0, tuned="log")
    """Random walk of the position along the way."""
    rotation_noise: Scalar = leaf(1e-3, "rad", above=0, tuned="log")
    """White noise of each rotation against the odometry's own map."""
    translation_noise: Scalar = leaf(1e-2, "m", above=0, tuned="log")
    """White noise of each position against the odometry's own map."""
    scale_sigma: Scalar = leaf(1e-3, "", least=0)
    """Standard deviation of the odometry's error of scale; zero: it has none."""
    turn_sigma: Scalar = leaf(0.0, "rad/m", least=0)
    """Standard deviation of a constant turn per way, as from a wrong elevation of the beams; zero: none."""
    time_offset_sigma: Scalar = leaf(0.0, "s", least=0)
    """Standard deviation of what has to be added to the odometry's stamps; zero: the stamps are right."""


class MountingParams(eqx.Module):
    """Pose of the odometry's sensor in the IMU frame, T_imu_sensor."""

    rotation: Float[Array, "4"] = leaf((0.0, 0.0, 0.0, 1.0), "", tuned="turn")
    """Quaternion x y z w. With a rotation_sigma of 0.1 rad or more the motion gives the first guess."""
    translation: Float[Array, "3"] = leaf((0.0, 0.0, 0.0), "m")
    """Position of the odometry's sensor, IMU frame."""
    rotation_sigma: Scalar = leaf(1.0, "rad", least=0)
    """Standard deviation of the rotation; zero: it is exact."""
    translation_sigma: Scalar = leaf(0.3, "m", least=0)
    """Standard deviation of the translation; zero: it is exact."""


class FixParams(eqx.Module):
    """GPS fixes."""

    sigma: Float[Array, "3"] = leaf((1.0, 1.0, 2.0), "m", above=0)
    """Standard deviation east, north and up of a fix whose file states none."""
    sigma_scale: Scalar = leaf(1.0, "", above=0, tuned="log")
    """Factor of all standard deviations."""
    lever_arm: Float[Array, "3"] = leaf((0.0, 0.0, 0.0), "m")
    """Position of the antenna, IMU frame."""
    time_offset_sigma: Scalar = leaf(0.0, "s", least=0)
    """Standard deviation of what has to be added to the fixes' stamps; zero: the stamps are right."""
    kernel: Scalar = leaf(5.0, "", above=0)
    """Width of the Geman-McClure kernel of a fix, standard deviations."""


class StartParams(eqx.Module):
    """Standard deviations of the first state."""

    velocity_sigma: Scalar = leaf(30.0, "m/s", above=0)
    """Standard deviation of the first velocity."""
    gyro_bias_sigma: Scalar = leaf(0.01, "rad/s", above=0)
    """Standard deviation of the first gyroscope bias."""
    accel_bias_sigma: Scalar = leaf(0.2, "m/s^2", above=0)
    """Standard deviation of the first accelerometer bias."""


class FusionParams(eqx.Module):
    """Traced parameters of :func:`lio_jax.fuse`."""

    imu: ImuParams = section(ImuParams)
    odometry: OdometryParams = section(OdometryParams)
    extrinsics: MountingParams = section(MountingParams)
    gps: FixParams = section(FixParams)
    initial: StartParams = section(StartParams)
