"""Parameters and static settings of the default recipe."""

from dataclasses import dataclass

import equinox as eqx

from lio_jax.core.leaf import leaf, section, static
from lio_jax.core.types import Scalar
from lio_jax.imu.params import ImuConfig
from lio_jax.lidar.params import BeamParams, ScanConfig
from lio_jax.mapping.params import VoxelMapParams
from lio_jax.recipes.params import InertialConfig, InertialParams, MotionParams
from lio_jax.registration.params import GaussNewtonMatch, RobustFilterMatch, ThinnedMatch


class InertialMatch(eqx.Module):
    """What differs in the match where a filter predicts the pose."""

    inertial_point_spacing: Scalar = leaf(0.5, "m", above=0)
    """With inertial samples, the scan is thinned to one point per cube of this edge length before it is
    matched: the prediction needs fewer points to correct it."""
    least_width: Scalar = leaf(0.18, "m", least=0)
    """With inertial samples, a voxel whose second largest standard deviation is smaller acts as a scan line,
    which defines no plane; a wider one acts as if it were as much narrower. Where that leaves less than a
    third of the matches, the width is halved, three times at most, and then zero."""


class UnpredictedMatch(eqx.Module):
    """What differs in the match where nothing but the last velocity predicts the pose."""

    plane_points: Scalar = leaf(6.0, above=0)
    """Without inertial samples, a voxel with fewer points than this counts as a single scan line, which
    defines no plane. Where less than half of the scan's points would be matched,
    ``params.map.min_points`` points are enough."""


class VoxelMatch(GaussNewtonMatch, RobustFilterMatch, ThinnedMatch, InertialMatch, UnpredictedMatch):
    """A match with the planes of a voxel map, by Gauss-Newton or in the filter."""


class DefaultParams(InertialParams):
    """Traced parameters of the default recipe."""

    lidar: BeamParams = section(BeamParams)
    map: VoxelMapParams = section(VoxelMapParams)
    registration: VoxelMatch = section(VoxelMatch)
    motion: MotionParams = section(MotionParams)


@dataclass(frozen=True)
class ThinnedScanConfig(ScanConfig):
    """Capacities of the thinned scan without inertial samples."""

    registration_points: int = static(12288, above=0)
    """Capacity of the downsampled scan that is registered."""
    insertion_points: int = static(32768, above=0)
    """Capacity of the downsampled scan that is written into the map."""


@dataclass(frozen=True)
class ThinnedInertialConfig(ImuConfig):
    """Capacities of the thinned scan with inertial samples."""

    registration_points: int = static(2048, above=0)
    """Capacity of the downsampled scan that is registered where there are inertial samples; it replaces
    ``config.lidar.registration_points``."""
    insertion_points: int = static(8192, above=0)
    """Capacity of the downsampled scan that is written into the map where there are inertial samples; it
    replaces ``config.lidar.insertion_points``."""


@dataclass(frozen=True)
class DefaultConfig(InertialConfig):
    """Static settings of the default recipe."""

    lidar: ThinnedScanConfig = section(ThinnedScanConfig)
    imu: ThinnedInertialConfig = section(ThinnedInertialConfig)
