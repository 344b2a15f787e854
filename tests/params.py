"""Parameters and static settings with every section there is, for tests of the parts of recipes."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lio_jax.core.leaf import numbers_of, section, settings_of, traced
from lio_jax.imu.params import OrientedImuConfig
from lio_jax.lidar.params import (
    BeamParams,
    LioSamFeatureParams,
    LoamFeatureParams,
    LoamRingConfig,
)
from lio_jax.mapping.params import (
    CubeGridParams,
    FeatureMapParams,
    MovingCubeParams,
    SubmapParams,
    VoxelMapParams,
)
from lio_jax.recipes.default_params import ThinnedInertialConfig, ThinnedScanConfig, VoxelMatch
from lio_jax.recipes.lio_sam_params import SmootherParams
from lio_jax.recipes.params import InertialParams, MotionParams, RecipeConfig
from lio_jax.registration.params import KnnConfig, ScanToScanParams, ScoredLineFitParams


class Features(LoamFeatureParams, LioSamFeatureParams):
    """Features of both kinds."""


class Maps(VoxelMapParams, FeatureMapParams):
    """Maps of both kinds."""


class Params(InertialParams):
    """Every section, with its own defaults."""

    lidar: BeamParams = section(BeamParams)
    map: Maps = section(Maps)
    registration: VoxelMatch = section(VoxelMatch)
    scan_to_scan: ScanToScanParams = section(ScanToScanParams)
    knn: ScoredLineFitParams = section(ScoredLineFitParams)
    features: Features = section(Features)
    point_map: MovingCubeParams = section(MovingCubeParams)
    cubes: CubeGridParams = section(CubeGridParams)
    submap: SubmapParams = section(SubmapParams)
    smoother: SmootherParams = section(SmootherParams)
    motion: MotionParams = section(MotionParams)


@dataclass(frozen=True)
class ImuConfig(OrientedImuConfig, ThinnedInertialConfig):
    """Every setting of the inertial samples."""


@dataclass(frozen=True)
class Config(RecipeConfig):
    """Static settings of the parts."""

    lidar: ThinnedScanConfig = section(ThinnedScanConfig)
    imu: ImuConfig = section(ImuConfig, orientation=False)
    knn: KnnConfig = section(KnnConfig)
    features: LoamRingConfig = section(LoamRingConfig)


DEFAULTS = numbers_of(Params)
"""Plain numbers by section and name."""
DIFFERENTIABLE = tuple(path for path, setting in settings_of(Params).items() if setting.declared.tuned)
"""Paths of the parameters that have a derivative."""


def default_params() -> Params:
    """Return the defaults as arrays."""
    return traced(Params)


def params_from_values(values: Mapping[str, Mapping[str, Any]]) -> Params:
    """Return plain numbers as arrays."""
    return traced(Params, values)
