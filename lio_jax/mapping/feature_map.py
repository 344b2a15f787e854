"""A map of corners and surface points (LOAM, LIO-SAM), each kind one per voxel in a hashed table."""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.mapping.frame import Frame
from lio_jax.mapping.params import FeatureMapParams, PointMapParams
from lio_jax.mapping.point_map import EDGE, Insertion, PointMap, empty_map, insert
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


class Frames(eqx.Module):
    """The frames of the corners and of the surface points: their maps may have different grids."""

    corner: Frame
    surface: Frame


def empty_feature_map(capacity: int) -> FeatureMap:
    """Return a map with ``capacity`` free blocks of either kind, its boxes around the world's origin."""
    return FeatureMap(empty_map(capacity), empty_map(capacity))


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
) -> tuple[FeatureMap, Insertion, Insertion]:
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
    """
    kinds = (
        (feature_map.corner, points.corner, points.corner_mask, frames.corner, map_params.corner_voxel_size),
        (feature_map.surface, points.surface, points.surface_mask, frames.surface, map_params.voxel_size),
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
            point_map.nearer_by.astype(jnp.float32),
        )
        # last, because whatever still reads the map beside it would make XLA copy the map
        maps.append(follow(pmap, frame, block))
        insertions.append(insertion)
    return FeatureMap(*maps), insertions[0], insertions[1]
