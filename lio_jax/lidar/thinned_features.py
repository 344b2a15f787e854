"""Features as the scan-to-map matches of LOAM and LIO-SAM take them."""

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int32

from lio_jax.core.config import Config
from lio_jax.core.params import Params
from lio_jax.core.types import Scan
from lio_jax.lidar.features import FeatureCloud
from lio_jax.lidar.voxel_mean import mean_per_voxel

_Features = TypeVar("_Features")


def in_single_precision(
    pick: Callable[[Config, Params, Scan], _Features], config: Config, params: Params, scan: Scan
) -> _Features:
    """Pick features in single precision, since which ones has no derivative; return them in the scan's."""
    dtype = scan.points.dtype
    single = dataclasses.replace(
        scan, points=scan.points.astype(jnp.float32), time=scan.time.astype(jnp.float32)
    )
    found = pick(config, params, single)
    return jax.tree.map(_cast_to(dtype), found)


def thinned_features(
    corner: FeatureCloud, surface: FeatureCloud, params: Params, corners: int, surfaces: int
) -> tuple[FeatureCloud, FeatureCloud, Int32[Array, ""]]:
    """Return the means per voxel of the map, and how many found no room.

    They are averaged before the motion is compensated and not after it, so that the groups do not depend on
    the motion: points as near to each other as these are moved alike.

    Args:
        corner: of a scan.
        surface: of a scan.
        params: voxel sizes.
        corners: capacity.
        surfaces: capacity.
    """
    kinds = ((corner, params.map.corner_voxel_size, corners), (surface, params.map.voxel_size, surfaces))
    clouds, dropped = [], jnp.int32(0)
    for cloud, size, capacity in kinds:
        mean = mean_per_voxel(cloud.points, cloud.mask, size.astype(jnp.float32), capacity, cloud.time)
        assert mean.time is not None
        clouds.append(FeatureCloud(mean.points, mean.time, jnp.zeros(capacity, jnp.int32), mean.mask))
        dropped += mean.dropped
    return clouds[0], clouds[1], dropped


def _cast_to(dtype: jnp.dtype) -> Callable[[Any], Any]:
    return lambda leaf: leaf.astype(dtype) if eqx.is_inexact_array(leaf) else leaf
