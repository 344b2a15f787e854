"""LOAM's map: corners and surface points, kept in a grid of cubes that shifts with the sensor.

Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014, section VI, in A-LOAM's form: the
grid decides what is kept and what is matched.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lio_jax.mapping import feature_map
from lio_jax.mapping.feature_map import FeatureMap, FeaturePoints, Frames
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.params import CubeGridParams, FeatureMapParams, PointMapParams
from lio_jax.mapping.point_map import Insertion, PointMap, shift_box


def matched_cubes(
    placed: Float[Array, "k 3"], frame: Frame, position: Float[Array, "3"], cubes: CubeGridParams
) -> Bool[Array, " k"]:
    """Return which points lie in the cubes around the sensor's own.

    Cubes are centred on multiples of their edge, counted from the world's origin.

    Args:
        placed: m, in ``frame``.
        frame: near the sensor.
        position: of the sensor, m in world.
        cubes: their edge, and how many are matched.
    """
    numbers = jnp.stack([cubes.matched_across, cubes.matched_across, cubes.matched_up])
    own = jnp.round(position / cubes.edge) * cubes.edge
    away = placed - (own - frame.origin).astype(placed.dtype)
    return jnp.all(jnp.abs(away) < (numbers / 2 * cubes.edge).astype(placed.dtype), -1)


def added_to(
    cubes_map: FeatureMap,
    points: FeaturePoints,
    keep: Bool[Array, ""],
    frames: Frames,
    map_params: FeatureMapParams,
    point_map: PointMapParams,
    cubes: CubeGridParams,
) -> tuple[FeatureMap, Insertion, Insertion]:
    """Return the map with a scan's points, its grid shifted to the sensor; and what was added of either kind.

    Args:
        cubes_map: donate it.
        points: each kind in its frame, m.
        keep: whether to add any.
        frames: near the sensor.
        map_params: for the voxel sizes.
        point_map: for ``nearer_by``.
        cubes: the grid.
    """
    half_sides = jnp.stack([cubes.across, cubes.across, cubes.up]) / 2 * cubes.edge

    def follow(pmap: PointMap, frame: Frame, block: Float[Array, ""]) -> PointMap:
        cube = (cubes.edge / block).astype(jnp.float32)
        half = (half_sides / block).astype(jnp.float32)
        return shift_box(pmap, frame.anchor, half, cubes.margin.astype(jnp.float32) * cube, cube)

    return feature_map.added_to(cubes_map, points, keep, frames, map_params, point_map, half_sides, follow)
