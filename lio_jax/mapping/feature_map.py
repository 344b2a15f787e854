"""Maps of corners and surface points: a point per voxel, in cubes (LOAM) or from keyframes (LIO-SAM)."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float

from lio_jax.mapping.frame import Frame
from lio_jax.mapping.keyframes import (
    KeyframeCloud,
    Keyframes,
    keyframe_at,
    next_to_enter,
    with_keyframe,
    with_poses,
)
from lio_jax.mapping.params import CubeGridParams, CubeParams, FeatureMapParams, PointMapParams, SubmapParams
from lio_jax.mapping.point_map import (
    EDGE,
    PointInsertion,
    PointMap,
    empty_map,
    following,
    insert,
    move_cube,
    shift_box,
)
from lio_jax.mapping.voxel_map import anchor_of


class FeaturePoints(eqx.Module):
    """Corners and surface points of a scan, m, lidar frame of one instant."""

    corner: Float[Array, "c 3"]
    corner_mask: Bool[Array, " c"]
    surface: Float[Array, "s 3"]
    surface_mask: Bool[Array, " s"]

    def together(self) -> tuple[Float[Array, "k 3"], Bool[Array, " k"]]:
        """Return the points of both kinds, corners first, and which of them are real."""
        points = jnp.concatenate([self.corner, self.surface])
        return points, jnp.concatenate([self.corner_mask, self.surface_mask])


class FeatureMap(eqx.Module):
    """Both kinds of points."""

    corner: PointMap
    surface: PointMap

    def varying(self) -> "FeatureMap":
        """Return a tree of booleans: the points of both kinds have a derivative."""
        return FeatureMap(self.corner.varying(), self.surface.varying())


class Frames(eqx.Module):
    """The frames of the corners and of the surface points: their maps may have different grids."""

    corner: Frame
    surface: Frame


def empty_feature_map(capacity: int, dtype: DTypeLike = jnp.float32, of_means: bool = False) -> FeatureMap:
    """Return a map with ``capacity`` free blocks of either kind, its boxes around the world's origin."""
    return FeatureMap(empty_map(capacity, dtype, of_means), empty_map(capacity, dtype, of_means))


def frames_at(position: Float[Array, "3"], map_params: FeatureMapParams) -> Frames:
    """Return the frames of both kinds near a position, m in world."""
    sizes = map_params.corner_voxel_size, map_params.voxel_size
    return Frames(*(Frame(*anchor_of(position, EDGE * size)) for size in sizes))


def placed_in(frames: Frames, points: FeaturePoints, T_world_lidar: jaxlie.SE3) -> FeaturePoints:
    """Return points of the lidar frame, each kind in its own frame of the map."""
    _, corner = frames.corner.place(points.corner, T_world_lidar)
    _, surface = frames.surface.place(points.surface, T_world_lidar)
    return FeaturePoints(corner, points.corner_mask, surface, points.surface_mask)


Follow = Callable[[PointMap, Frame, Float[Array, ""]], PointMap]
"""Moves the box of a map, given the frame at the sensor and a block's length (m), and clears the rest."""


def added_to(
    feature_map: FeatureMap,
    points: FeaturePoints,
    keep: Bool[Array, ""],
    frames: Frames,
    map_params: FeatureMapParams,
    point_map: PointMapParams,
    half_sides: Float[Array, "*d"],
    follow: Follow,
) -> tuple[FeatureMap, PointInsertion, PointInsertion]:
    """Return the map with points added, its box moved to the sensor; and what was added of either kind.

    Args:
        feature_map: donate it.
        points: each kind in its frame, m.
        keep: whether to add any.
        frames: near the sensor.
        map_params: for the voxel sizes.
        point_map: for ``nearer_by``.
        half_sides: half the edges of the box outside of which nothing is kept, m.
        follow: moves that box.

    The points of the map follow those that were added, if these have a derivative.
    """
    kinds = (
        (feature_map.corner, points.corner, points.corner_mask, frames.corner, map_params.corner_voxel_size),
        (feature_map.surface, points.surface, points.surface_mask, frames.surface, map_params.voxel_size),
    )
    maps, insertions = [], []
    for before, placed, mask, frame, size in kinds:
        block = EDGE * size
        inserted, insertion = insert(
            before,
            placed,
            mask & keep,
            frame.anchor,
            size.astype(jnp.float32),
            (half_sides / block).astype(jnp.float32),
            point_map.nearer_by.astype(jnp.float32),
        )
        # last: XLA copies the map if another operation reads it afterwards
        moved = follow(inserted, frame, block)
        entered = insertion.moved
        maps.append(following(moved, before, inserted, entered, placed, frame.anchor, size))
        insertions.append(insertion)
    return FeatureMap(*maps), insertions[0], insertions[1]


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


def added_to_cubes(
    cubes_map: FeatureMap,
    points: FeaturePoints,
    keep: Bool[Array, ""],
    frames: Frames,
    map_params: FeatureMapParams,
    point_map: PointMapParams,
    cubes: CubeGridParams,
) -> tuple[FeatureMap, PointInsertion, PointInsertion]:
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

    return added_to(cubes_map, points, keep, frames, map_params, point_map, half_sides, follow)


class Submap(eqx.Module):
    """Keyframes, and the points of those around the vehicle."""

    keyframes: Keyframes
    """Keyframes with their clouds."""
    features: FeatureMap
    """Map of the points of the keyframes around the vehicle."""

    def varying(self) -> "Submap":
        """Return a tree of booleans: the keyframes' poses and the map's points have a derivative."""
        fixed = jax.tree.map(lambda _: False, self.keyframes)
        keyframes = eqx.tree_at(lambda some: some.T_world_lidar.wxyz_xyz, fixed, True)
        return Submap(keyframes, self.features.varying())


def with_scan(
    submap: Submap,
    keep: Bool[Array, ""],
    points: FeaturePoints,
    T_world_lidar: jaxlie.SE3,
    time: Float[Array, ""],
    map_params: FeatureMapParams,
    point_map: CubeParams,
    settings: SubmapParams,
) -> tuple[Submap, Frames, FeaturePoints, tuple[PointInsertion, PointInsertion]]:
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
    # a keyframe that enters anew moves with its pose alone
    single = [jax.lax.stop_gradient(kind).astype(jnp.float32) for kind in (points.corner, points.surface)]
    cloud = KeyframeCloud(single[0], points.corner_mask, single[1], points.surface_mask)
    keyframes = with_keyframe(submap.keyframes, keep, T_world_lidar, time, cloud, settings)
    keyframes, T_world_back, back = next_to_enter(keyframes, T_world_lidar, time, settings)
    frames = frames_at(T_world_lidar.translation(), map_params)
    placed = placed_in(frames, points, T_world_lidar)
    returned = FeaturePoints(back.corner, back.corner_mask, back.surface, back.surface_mask)
    entering = placed_in(frames, returned, T_world_back)
    both = FeaturePoints(
        corner=jnp.concatenate([placed.corner, entering.corner]),
        corner_mask=jnp.concatenate([placed.corner_mask & keep, entering.corner_mask]),
        surface=jnp.concatenate([placed.surface, entering.surface]),
        surface_mask=jnp.concatenate([placed.surface_mask & keep, entering.surface_mask]),
    )
    features, *added = _added_around(submap.features, both, frames, map_params, point_map)
    return Submap(keyframes, features), frames, jax.lax.stop_gradient(placed), (added[0], added[1])


def _added_around(
    features: FeatureMap,
    points: FeaturePoints,
    frames: Frames,
    map_params: FeatureMapParams,
    point_map: CubeParams,
) -> tuple[FeatureMap, PointInsertion, PointInsertion]:
    """Return the map of the keyframes around with points added, its cube moved to the vehicle."""
    half_side = point_map.cube_side_length / 2
    margin = half_side / 2

    def follow(pmap: PointMap, frame: Frame, block: Float[Array, ""]) -> PointMap:
        in_blocks = (jnp.stack([half_side, margin]) / block).astype(jnp.float32)
        return move_cube(pmap, frame.anchor, in_blocks[0], in_blocks[1])

    return added_to(features, points, jnp.array(True), frames, map_params, point_map, half_side, follow)


def rebuilt(
    submap: Submap,
    keyframes_T_world_lidar: jaxlie.SE3,
    T_world_lidar: jaxlie.SE3,
    time: Float[Array, ""],
    map_params: FeatureMapParams,
    point_map: CubeParams,
    settings: SubmapParams,
) -> Submap:
    """Return the submap with its keyframes at other poses, and the map of their points built anew.

    Args:
        submap: donate it.
        keyframes_T_world_lidar: new poses of the k rows, m.
        T_world_lidar: current pose, in the same frame.
        time: current time, s, on the keyframes' clock.
        map_params: for the voxel sizes.
        point_map: for the side of the box around the vehicle and ``nearer_by``.
        settings: which keyframes the map holds.
    """
    keyframes = with_poses(submap.keyframes, keyframes_T_world_lidar, T_world_lidar, time, settings)
    frames = frames_at(T_world_lidar.translation(), map_params)
    block, point = submap.features.corner.block, submap.features.corner.point
    empty = empty_feature_map(len(block), point.dtype, submap.features.corner.count is not None)
    empty = eqx.tree_at(
        lambda both: (both.corner.cube, both.surface.cube),
        empty,
        (frames.corner.anchor, frames.surface.anchor),
    )
    # in the order in which the map met them
    order = jnp.argsort(jnp.where(keyframes.entered, keyframes.time, jnp.inf))

    def with_one(number: Array, features: FeatureMap) -> FeatureMap:
        T_world_one, cloud = keyframe_at(keyframes, order[number])
        points = FeaturePoints(cloud.corner, cloud.corner_mask, cloud.surface, cloud.surface_mask)
        placed = placed_in(frames, points, T_world_one)
        return _added_around(features, placed, frames, map_params, point_map)[0]

    count = jnp.sum(keyframes.entered, dtype=jnp.int32)
    return Submap(keyframes, jax.lax.fori_loop(0, count, with_one, empty))
