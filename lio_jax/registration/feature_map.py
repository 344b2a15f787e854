"""A map of corners and surface points, and scans against it (LOAM, LIO-SAM).

Both kinds of points are kept one per voxel in a hashed table.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.mapping.point_map import EDGE, Insertion, PointMap, empty_map, insert
from lio_jax.mapping.voxel_map import anchor_of
from lio_jax.registration.feature_icp import ScanRegistration
from lio_jax.registration.knn_planes import planes_near
from lio_jax.registration.lines_and_planes import FeaturePoints, Frames, LinesAndPlanes, lines_near
from lio_jax.registration.params import Params
from lio_jax.registration.voxel_plane_icp import Frame


class FeatureMap(eqx.Module):
    """Both kinds of points."""

    corner: PointMap
    surface: PointMap


def empty_feature_map(capacity: int) -> FeatureMap:
    """Return a map with ``capacity`` free blocks of either kind, its boxes around the world's origin."""
    return FeatureMap(empty_map(capacity), empty_map(capacity))


def frames_at(position: Float[Array, "3"], params: Params) -> Frames:
    """Return the frames of both kinds near a position, m in world."""
    sizes = params.map.corner_voxel_size, params.map.voxel_size
    return Frames(*(Frame(*anchor_of(position, EDGE * size)) for size in sizes))


class ScanToMap(ScanRegistration):
    """A scan's compensated corners and surface points, and the map."""

    map: FeatureMap
    points: FeaturePoints
    T_predicted: jaxlie.SE3
    params: Params
    neighbours: int = eqx.field(static=True)

    def points_at(self, T_target_lidar: jaxlie.SE3) -> FeaturePoints:
        return self.points

    def frames(self) -> Frames:
        return frames_at(self.T_predicted.translation(), self.params)

    def searched(self, placed: Float[Array, "k 3"], frame: Frame) -> Bool[Array, " k"]:
        """Return which points, in m from the frame's origin, are matched at all."""
        return jnp.ones(len(placed), bool)

    def associate(self, points: FeaturePoints, T_target_lidar: jaxlie.SE3) -> LinesAndPlanes:
        """Find lines and planes through the nearest map points."""
        frames, params = self.frames(), self.params
        _, corner = frames.corner.place(points.corner, T_target_lidar)
        _, surface = frames.surface.place(points.surface, T_target_lidar)
        return LinesAndPlanes(
            lines_near(
                self.map.corner,
                corner,
                points.corner_mask & self.searched(corner, frames.corner),
                frames.corner.anchor,
                params.map.corner_voxel_size,
                params.knn,
                self.neighbours,
            ),
            planes_near(
                self.map.surface,
                surface,
                points.surface_mask & self.searched(surface, frames.surface),
                frames.surface.anchor,
                params.map.voxel_size,
                params.knn,
                self.neighbours,
            ),
        )


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
    params: Params,
    half_sides: Float[Array, "*d"],
    follow: Follow,
) -> tuple[FeatureMap, Insertion, Insertion]:
    """Return the map with points added, its box moved to the sensor; and what was added of either kind.

    Args:
        feature_map: donate it.
        points: each kind in its frame, m.
        keep: whether to add any.
        frames: near the sensor.
        params: voxel sizes and ``params.point_map.nearer_by``.
        half_sides: half the edges of the box outside of which nothing is kept, m.
        follow: moves that box.
    """
    kinds = (
        (feature_map.corner, points.corner, points.corner_mask, frames.corner, params.map.corner_voxel_size),
        (feature_map.surface, points.surface, points.surface_mask, frames.surface, params.map.voxel_size),
    )
    maps, insertions = [], []
    for pmap, placed, mask, frame, size in kinds:
        block = EDGE * size
        pmap, insertion = insert(
            pmap,
            placed,
            mask & keep,
            frame.anchor,
            size.astype(jnp.float32),
            (half_sides / block).astype(jnp.float32),
            params.point_map.nearer_by.astype(jnp.float32),
        )
        # last, because whatever still reads the map beside it would make XLA copy the map
        maps.append(follow(pmap, frame, block))
        insertions.append(insertion)
    return FeatureMap(*maps), insertions[0], insertions[1]
