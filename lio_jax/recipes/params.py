"""Parameters and static settings that every recipe has."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.leaf import leaf, section
from lio_jax.core.types import Scalar
from lio_jax.imu.params import FirstMotionParams, ImuConfig, ImuParams, InitialParams
from lio_jax.lidar.params import LidarParams, ScanConfig
from lio_jax.mapping.params import MapConfig, MapParams
from lio_jax.registration.params import RegistrationConfig, RegistrationParams


class LimitParams(eqx.Module):
    """What is reported as a failure when it is exceeded; lio_sam begins anew there."""

    speed: Scalar = leaf(60.0, "m/s", above=0)
    """Largest plausible speed."""
    gyro_bias: Scalar = leaf(1.0, "rad/s", above=0)
    """Largest plausible gyroscope bias."""
    accel_bias: Scalar = leaf(1.0, "m/s^2", above=0)
    """Largest plausible accelerometer bias."""
    outage: Scalar = leaf(1.0, "s", above=0)
    """Longest time without a matched scan. After it, a scan with less than a quarter of its points on the map
    begins a new piece of map at the predicted pose."""


class MotionParams(eqx.Module):
    """How far a prediction may be off before the scan match."""

    initial_error: Scalar = leaf(2.0, "m", least=0)
    """Largest error of the prediction before any velocity is known. It opens the robust kernel."""
    error_decay: Scalar = leaf(0.5, least=0, most=1)
    """Share of the last expected prediction error that is kept when predictions improve, 0 to 1."""


class ExtrinsicsParams(eqx.Module):
    """The pose and the clock of the lidar relative to the IMU."""

    rotation: Float[Array, "4"] = leaf((0.0, 0.0, 0.0, 1.0), tuned="turn", moves_points=True)
    """Rotation of T_imu_lidar as a quaternion x y z w."""
    translation: Float[Array, "3"] = leaf((0.0, 0.0, 0.0), "m", tuned="linear", moves_points=True)
    """Position of the lidar in the IMU frame."""
    time_offset: Scalar = leaf(0.0, "s", tuned="linear", moves_points=True)
    """Lag of the lidar's clock: a scan stamped t was taken at IMU time t + time_offset."""

    def T_imu_lidar(self) -> jaxlie.SE3:
        """Return the pose of the lidar in the IMU frame."""
        return jaxlie.SE3(
            jnp.concatenate([self.rotation[jnp.array([3, 0, 1, 2])], self.translation])
        ).normalize()


class RecipeParams(eqx.Module):
    """Traced parameters of a recipe: a subclass replaces or adds sections.

    Changing a leaf recompiles nothing, and leaves batch under vmap.
    """

    lidar: LidarParams = section(LidarParams)
    map: MapParams = section(MapParams)
    registration: RegistrationParams = section(RegistrationParams)
    initial: FirstMotionParams = section(FirstMotionParams)
    limits: LimitParams = section(LimitParams)
    extrinsics: ExtrinsicsParams = section(ExtrinsicsParams)


class InertialParams(RecipeParams):
    """Traced parameters of a recipe that uses inertial samples."""

    imu: ImuParams = section(ImuParams)
    initial: InitialParams = section(InitialParams)


@dataclass(frozen=True)
class RecipeConfig:
    """Static settings of a recipe: a subclass replaces or adds sections. Frozen and hashable, so that
    compiled programs can be kept by them."""

    lidar: ScanConfig = section(ScanConfig)
    map: MapConfig = section(MapConfig)
    registration: RegistrationConfig = section(RegistrationConfig)


@dataclass(frozen=True)
class InertialConfig(RecipeConfig):
    """Static settings of a recipe that uses inertial samples."""

    imu: ImuConfig = section(ImuConfig)
