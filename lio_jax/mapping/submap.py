"""The keyframes around the vehicle as one map of corners and surface points (LIO-SAM).

A keyframe's points are moved into the map once, when it is made or when the vehicle comes back to it; what
has not moved is not touched again. LIO-SAM itself puts its map together anew for each scan.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.mapping import feature_map
from lio_jax.mapping.feature_map import FeatureMap, FeaturePoints, Frames, frames_at, placed_in
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.keyframes import KeyframeCloud, Keyframes, next_to_enter, with_keyframe
from lio_jax.mapping.params import CubeParams, FeatureMapParams, SubmapParams
from lio_jax.mapping.point_map import Insertion, PointMap, move_cube


class Submap(eqx.Module):
    """Keyframes, and the points of those around the vehicle."""

    keyframes: Keyframes
    """Keyframes with their clouds."""
    features: FeatureMap
    """Map of the points of the keyframes around the vehicle."""


def with_scan(
    submap: Submap,
    keep: Bool[Array, ""],
    points: FeaturePoints,
    T_world_lidar: jaxlie.SE3,
    time: Float[Array, ""],
    map_params: FeatureMapParams,
    point_map: CubeParams,
    settings: SubmapParams,
) -> tuple[Submap, Frames, FeaturePoints, tuple[Insertion, Insertion]]:
    """Return the submap with a scan as a keyframe, and with one that the vehicle comes back to, if any.

    Args:
        submap: donate it.
        keep: whether the scan becomes a keyframe.
        points: of the scan, compensated, m, lidar frame.
        T_world_lidar: its pose.
        time: s, on the keyframes' clock.
        map_params: for the voxel sizes.
        point_map: for the side of the box around the vehicle and ``nearer_by``.
        settings: what a keyframe is, and when one enters anew.

    Returns:
        The submap, the frames of its points near the scan, the scan's points in them, and what was added of
        either kind: the scan's points first.
    """
    single = [kind.astype(jnp.float32) for kind in (points.corner, points.surface)]
    cloud = KeyframeCloud(single[0], points.corner_mask, single[1], points.surface_mask)
    keyframes = with_keyframe(submap.keyframes, keep, T_world_lidar, time, cloud, settings)
    keyframes, T_world_back, back = next_to_enter(keyframes, T_world_lidar, time, settings)
    frames = frames_at(T_world_lidar.translation(), map_params)
    placed = placed_in(frames, points, T_world_lidar)
    returned = FeaturePoints(back.corner, back.corner_mask, back.surface, back.surface_mask)
    entering = placed_in(frames, returned, T_world_back)
    both = FeaturePoints(
        corner=jnp.concatenate([placed.corner.astype(jnp.float32), entering.corner]),
        corner_mask=jnp.concatenate([placed.corner_mask & keep, entering.corner_mask]),
        surface=jnp.concatenate([placed.surface.astype(jnp.float32), entering.surface]),
        surface_mask=jnp.concatenate([placed.surface_mask & keep, entering.surface_mask]),
    )
    half_side = point_map.cube_side_length / 2
    margin = half_side / 2

    def follow(pmap: PointMap, frame: Frame, block: Float[Array, ""]) -> PointMap:
        in_blocks = (jnp.stack([half_side, margin]) / block).astype(jnp.float32)
        return move_cube(pmap, frame.anchor, in_blocks[0], in_blocks[1])

    features, *added = feature_map.added_to(
        submap.features, both, jnp.array(True), frames, map_params, point_map, half_side, follow
    )
    return Submap(keyframes, features), frames, placed, (added[0], added[1])
