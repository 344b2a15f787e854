"""LOAM's map: corners and surface points, kept in a grid of cubes that shifts with the sensor.

Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014, section VI, in A-LOAM's form: the
grid decides what is kept and what is matched.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lio_jax.mapping.point_map import Insertion, PointMap, shift_box
from lio_jax.registration import feature_map
from lio_jax.registration.feature_map import FeatureMap
from lio_jax.registration.lines_and_planes import FeaturePoints, Frames
from lio_jax.registration.params import Params
from lio_jax.registration.voxel_plane_icp import Frame


class ScanToCubes(feature_map.ScanToMap):
    """A scan against the points in the cubes around the sensor's own."""

    def searched(self, placed: Float[Array, "k 3"], frame: Frame) -> Bool[Array, " k"]:
        return matched_cubes(placed, frame, self.T_predicted.translation(), self.params)


def matched_cubes(
    placed: Float[Array, "k 3"], frame: Frame, position: Float[Array, "3"], params: Params
) -> Bool[Array, " k"]:
    """Return which points lie in the cubes around the sensor's own.

    Cubes are centred on multiples of their edge, counted from the world's origin.

    Args:
        placed: m, in ``frame``.
        frame: near the sensor.
        position: of the sensor, m in world.
        params: ``params.cubes``.
    """
    cubes = params.cubes
    numbers = jnp.stack([cubes.matched_across, cubes.matched_across, cubes.matched_up])
    own = jnp.round(position / cubes.edge) * cubes.edge
    away = placed - (own - frame.origin).astype(placed.dtype)
    return jnp.all(jnp.abs(away) < (numbers / 2 * cubes.edge).astype(placed.dtype), -1)


def added_to(
    cubes_map: FeatureMap, points: FeaturePoints, keep: Bool[Array, ""], frames: Frames, params: Params
) -> tuple[FeatureMap, Insertion, Insertion]:
    """Return the map with a scan's points, its grid shifted to the sensor; and what was added of either kind.

    Args:
        cubes_map: donate it.
        points: each kind in its frame, m.
        keep: whether to add any.
        frames: near the sensor.
        params: voxel sizes, ``params.cubes`` and ``params.point_map.nearer_by``.
    """
    cubes = params.cubes
    half_sides = jnp.stack([cubes.across, cubes.across, cubes.up]) / 2 * cubes.edge

    def follow(pmap: PointMap, frame: Frame, block: Float[Array, ""]) -> PointMap:
        cube = (cubes.edge / block).astype(jnp.float32)
        half = (half_sides / block).astype(jnp.float32)
        return shift_box(pmap, frame.anchor, half, cubes.margin.astype(jnp.float32) * cube, cube)

    return feature_map.added_to(cubes_map, points, keep, frames, params, half_sides, follow)
