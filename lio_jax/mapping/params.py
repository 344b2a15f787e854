"""Parameters of the maps."""

from dataclasses import dataclass

import equinox as eqx

from lio_jax.core.leaf import leaf, static
from lio_jax.core.types import Scalar


class MapParams(eqx.Module):
    """What every map has."""

    voxel_size: Scalar = leaf(1.2, "m", above=0)
    """Edge length of a voxel."""
    point_spacing: Scalar = leaf(0.25, "m", above=0)
    """Clouds are thinned to one point per cube of this edge length before they enter a map: the voxel map of
    the default recipe, and the back end's map of any recipe."""


class VoxelMapParams(MapParams):
    """A voxel map of running statistics."""

    min_points: Scalar = leaf(3.0, above=0)
    """Points that a voxel needs before scans are matched against it."""
    reach: Scalar = leaf(120.0, "m", above=0)
    """Voxels farther than this from the sensor may be forgotten."""


class FeatureMapParams(MapParams):
    """Two maps of points: one of surface points, one of corners."""

    corner_voxel_size: Scalar = leaf(0.4, "m", above=0)
    """Edge length of a voxel in the map of corners."""


class PointMapParams(eqx.Module):
    """A map of one point per voxel."""

    nearer_by: Scalar = leaf(0.1, "m", least=0)
    """A point replaces the point of its voxel if it is nearer to the voxel's centre by more than this. With a
    margin below the range noise the point with the luckiest noise would stay, and surfaces would be biased
    towards the voxel centres."""


class CubeParams(PointMapParams):
    """A map of one point per voxel, inside a cube that follows the sensor."""

    cube_side_length: Scalar = leaf(1000.0, "m", above=0)
    """Side length of the cube. Points outside of it are forgotten."""


class MovingCubeParams(CubeParams):
    """A cube that moves before the sensor reaches its faces."""

    cube_margin: Scalar = leaf(1.5, least=0)
    """The cube moves when the sensor is nearer to a face than this many times ``lidar.max_range``."""


class CubeGridParams(eqx.Module):
    """The grid of cubes that LOAM keeps its map in."""

    edge: Scalar = leaf(50.0, "m", above=0)
    """Edge length of a cube."""
    across: Scalar = leaf(21.0, "cubes", above=0)
    """Number of cubes along x, and along y."""
    up: Scalar = leaf(11.0, "cubes", above=0)
    """Number of cubes along z."""
    margin: Scalar = leaf(3.0, "cubes", above=0)
    """The grid moves, by whole cubes, when fewer cubes than this are left in front of the sensor."""
    matched_across: Scalar = leaf(5.0, "cubes", above=0)
    """Number of cubes around the sensor, along x and along y, whose points are matched."""
    matched_up: Scalar = leaf(3.0, "cubes", above=0)
    """Number of cubes around the sensor, along z, whose points are matched."""


class SubmapParams(eqx.Module):
    """Keyframes, and those of them around the vehicle that scans are matched with."""

    keyframe_distance: Scalar = leaf(1.0, "m", above=0)
    """A scan farther than this from the last keyframe becomes a keyframe."""
    keyframe_angle: Scalar = leaf(0.2, "rad", above=0)
    """A scan turned by more than this since the last keyframe becomes a keyframe."""
    radius: Scalar = leaf(50.0, "m", above=0)
    """Keyframes within this distance are kept in the map. A keyframe that comes back into it enters anew."""
    spacing: Scalar = leaf(2.0, "m", least=0)
    """Distance between keyframes that stay in the map. The places of keyframes in between are reused once
    they are older than ``recent``."""
    recent: Scalar = leaf(10.0, "s", least=0)
    """Keyframes younger than this always stay in the map."""
    min_corners: Scalar = leaf(10.0, least=0)
    """A scan with fewer corners than this is not matched."""
    min_surfaces: Scalar = leaf(100.0, least=0)
    """A scan with fewer surface points than this is not matched."""


@dataclass(frozen=True)
class MapConfig:
    """Capacity of the map."""

    capacity: int = static(131072, power_of_two=True)
    """Number of voxel slots, or of blocks of 3 x 3 x 3 voxels in a map of points; a power of two."""
