"""Parameters and static settings of the recipe lio_sam, with LIO-SAM's values in SI units."""

from dataclasses import dataclass
from typing import Literal

import equinox as eqx

from lio_jax.core.leaf import leaf, section, static
from lio_jax.core.types import Scalar
from lio_jax.imu.params import ImuParams, InitialParams, OrientedImuConfig
from lio_jax.lidar.params import LidarParams, LioSamFeatureParams, RingConfig
from lio_jax.mapping.params import CubeParams, FeatureMapParams, MapConfig, SubmapParams
from lio_jax.recipes.params import InertialConfig, InertialParams
from lio_jax.registration.params import (
    GaussNewtonMatch,
    KnnConfig,
    RegistrationConfig,
    ScoredLineFitParams,
    WeighedMatch,
)

_DEGREE = 3.141592653589793 / 180


class SmootherParams(eqx.Module):
    """How a scan match enters the smoother, and how the smoother's pose enters the next scan match."""

    rotation_sigma: Scalar = leaf(0.05, "rad", above=0, tuned="log")
    """Standard deviation of a scan match's rotation, where the sigmas are fixed."""
    translation_sigma: Scalar = leaf(0.1, "m", above=0, tuned="log")
    """Standard deviation of a scan match's position, where the sigmas are fixed."""
    degenerate_sigma: Scalar = leaf(1.0, "rad and m", above=0, tuned="log")
    """Standard deviation of a degenerate scan match's rotation and position."""
    kernel: Scalar = leaf(1e6, "sigmas", above=0, tuned="log")
    """Scale of the robust kernel on scan matches. It is wide: a narrow kernel would reject all matches once
    the velocity is wrong."""
    tolerance: Scalar = leaf(1e-3, "sigmas", above=0)
    """The smoother has converged when the next step would be shorter than this."""
    tilt_weight: Scalar = leaf(0.01, least=0, most=1, tuned="log")
    """Share by which the matched roll and pitch are moved to the inertial ones."""
    tilt_limit: Scalar = leaf(1000.0, "rad", above=0)
    """Larger roll and pitch are clipped to this."""
    height_limit: Scalar = leaf(1000.0, "m", above=0)
    """Larger absolute z is clipped to this."""
    mapping_interval: Scalar = leaf(0.0, "s", least=0)
    """Smallest time between two scan matches. In between the pose is the inertial prediction."""


class LioSamMatch(GaussNewtonMatch, WeighedMatch):
    """A match of features by Gauss-Newton, whose result enters the smoother."""


class LioSamParams(InertialParams):
    """Traced parameters of LIO-SAM, in SI units."""

    # LIO-SAM's own densities, first biases and gravity are those of one sensor at one place
    imu: ImuParams = section(ImuParams)
    # LIO-SAM's velocity sigma of 1e4 next to a sample's information is singular in double precision
    initial: InitialParams = section(InitialParams, velocity_sigma=100.0)
    lidar: LidarParams = section(LidarParams, min_range=1.0, max_range=1000.0)
    map: FeatureMapParams = section(FeatureMapParams, voxel_size=0.4, corner_voxel_size=0.2)
    registration: LioSamMatch = section(
        LioSamMatch,
        information_scale=1.0,
        reassociation_distance=0.05,
        rotation_tolerance=0.05 * _DEGREE,
        translation_tolerance=5e-4,
    )
    knn: ScoredLineFitParams = section(ScoredLineFitParams, radius=1.0, plane_tolerance=0.2, min_score=0.1)
    features: LioSamFeatureParams = section(
        LioSamFeatureParams, corner_threshold=1.0, flat_threshold=0.1, surface_spacing=0.4
    )
    # keyframes within 50 m see farther than that
    point_map: CubeParams = section(CubeParams, cube_side_length=400.0)
    submap: SubmapParams = section(SubmapParams)
    smoother: SmootherParams = section(SmootherParams)


@dataclass(frozen=True)
class LioSamSizes:
    """Smoother and capacities."""

    window: int = static(10, least=2, why="the smoother ties each state to the one before it")
    """Number of states that are smoothed together. Older states are marginalised."""
    smoother_iterations: int = static(5, above=0)
    """Largest number of linearisations of the window."""
    lidar_noise: Literal["fixed", "information"] = static("information")
    """Noise of a scan match in the smoother: its information, and the pose is the smoothed one; or LIO-SAM's
    fixed sigmas of ``params.smoother``, and the pose is the matched one."""
    map_points: Literal["nearest", "mean"] = static("nearest")
    """Point of each voxel of the submap: the one nearest to the voxel's centre; or the mean of the points of
    all keyframes that have entered, as LIO-SAM's VoxelGrid leaves it."""
    keyframes: int = static(256, above=0)
    """Capacity of keyframes on the device. Beyond it the submap's spent keyframes are dropped first, then the
    farthest ones. A run keeps these on the host, and they come back near the vehicle."""
    corner_points: int = static(2048, above=0)
    """Capacity of the corners that are matched with the map, after thinning."""
    surface_points: int = static(8192, above=0)
    """Capacity of the surface points that are matched with the map, after thinning."""


@dataclass(frozen=True)
class LioSamConfig(InertialConfig):
    """Static settings of LIO-SAM."""

    imu: OrientedImuConfig = section(OrientedImuConfig)
    map: MapConfig = section(MapConfig, capacity=65536)
    registration: RegistrationConfig = section(RegistrationConfig, max_iterations=30)
    knn: KnnConfig = section(KnnConfig)
    features: RingConfig = section(RingConfig, rings=0, columns=0, surface_points=0, order="azimuth")
    lio_sam: LioSamSizes = section(LioSamSizes)
