"""The keyframes around the vehicle as one map of lines and planes, and scans against it (LIO-SAM).

A keyframe's points are moved into the map once, when it is made or when the vehicle comes back to it; what
has not moved is not touched again. LIO-SAM itself puts its map together anew for each scan.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.mapping.keyframes import KeyframeCloud, Keyframes, next_to_enter, with_keyframe
from lio_jax.mapping.point_map import Insertion, PointMap, move_cube
from lio_jax.registration import feature_map
from lio_jax.registration.feature_map import FeatureMap, frames_at, placed_in
from lio_jax.registration.lines_and_planes import FeaturePoints, Frames, Weights, scored
from lio_jax.registration.params import Params
from lio_jax.registration.voxel_plane_icp import Frame


class Submap(eqx.Module):
    """Keyframes, and the points of those around the vehicle."""

    keyframes: Keyframes
    """Keyframes with their clouds."""
    features: FeatureMap
    """Map of the points of the keyframes around the vehicle."""


class ScanToSubmap(feature_map.ScanToMap):
    """A scan's compensated corners and surface points, weighed by their scores as in LIO-SAM."""

    def weights(self) -> Weights:
        return scored(self.params.knn)


def with_scan(
    submap: Submap,
    keep: Bool[Array, ""],
    points: FeaturePoints,
    T_world_lidar: jaxlie.SE3,
    time: Float[Array, ""],
    params: Params,
) -> tuple[Submap, Frames, FeaturePoints, tuple[Insertion, Insertion]]:
    """Return the submap with a scan as a keyframe, and with one that the vehicle comes back to, if any.

    Args:
        submap: donate it.
        keep: whether the scan becomes a keyframe.
        points: of the scan, compensated, m, lidar frame.
        T_world_lidar: its pose.
        time: s, on the keyframes' clock.
        params: ``params.submap``, ``params.point_map`` and the voxel sizes.

    Returns:
        The submap, the frames of its points near the scan, the scan's points in them, and what was added of
        either kind: the scan's points first.
    """
    single = [kind.astype(jnp.float32) for kind in (points.corner, points.surface)]
    cloud = KeyframeCloud(single[0], points.corner_mask, single[1], points.surface_mask)
    keyframes = with_keyframe(submap.keyframes, keep, T_world_lidar, time, cloud, params.submap)
    keyframes, T_world_back, back = next_to_enter(keyframes, T_world_lidar, time, params.submap)
    frames = frames_at(T_world_lidar.translation(), params)
    placed = placed_in(frames, points, T_world_lidar)
    returned = FeaturePoints(back.corner, back.corner_mask, back.surface, back.surface_mask)
    entering = placed_in(frames, returned, T_world_back)
    both = FeaturePoints(
        corner=jnp.concatenate([placed.corner.astype(jnp.float32), entering.corner]),
        corner_mask=jnp.concatenate([placed.corner_mask & keep, entering.corner_mask]),
        surface=jnp.concatenate([placed.surface.astype(jnp.float32), entering.surface]),
        surface_mask=jnp.concatenate([placed.surface_mask & keep, entering.surface_mask]),
    )
    half_side = params.point_map.cube_side_length / 2
    margin = half_side / 2

    def follow(pmap: PointMap, frame: Frame, block: Float[Array, ""]) -> PointMap:
        in_blocks = (jnp.stack([half_side, margin]) / block).astype(jnp.float32)
        return move_cube(pmap, frame.anchor, in_blocks[0], in_blocks[1])

    features, *added = feature_map.added_to(
        submap.features, both, jnp.array(True), frames, params, half_side, follow
    )
    return Submap(keyframes, features), frames, placed, (added[0], added[1])
