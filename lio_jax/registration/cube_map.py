"""LOAM's map: corners and surface points, kept in a grid of cubes that shifts with the sensor.

Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014, section VI, in A-LOAM's form. Both
kinds of points are kept one per voxel in a hashed table; the grid decides what is kept and what is matched.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.params import Params
from lio_jax.mapping.point_map import EDGE, Insertion, PointMap, empty_map, insert, shift_box
from lio_jax.mapping.voxel_map import anchor_of
from lio_jax.registration.knn_planes import planes_near
from lio_jax.registration.lines_and_planes import FeaturePoints, Frames, LinesAndPlanes, lines_near
from lio_jax.registration.rounds import Task
from lio_jax.registration.scan_to_map import Frame


class CubeMap(eqx.Module):
    """Both kinds of points."""

    corner: PointMap
    surface: PointMap


def empty_cube_map(capacity: int) -> CubeMap:
    """Return a map with ``capacity`` free blocks of either kind, its grid around the world's origin."""
    return CubeMap(empty_map(capacity), empty_map(capacity))


def frames_at(position: Float[Array, "3"], params: Params) -> Frames:
    """Return the frames of both kinds near a position, m in world."""
    sizes = params.map.corner_voxel_size, params.map.voxel_size
    return Frames(*(Frame(*anchor_of(position, EDGE * size)) for size in sizes))


class ScanToMap(Task):
    """A scan's compensated corners and surface points, and the map."""

    map: CubeMap
    points: FeaturePoints
    T_predicted: jaxlie.SE3
    params: Params
    neighbours: int = eqx.field(static=True)

    def points_at(self, T_target_lidar: jaxlie.SE3) -> FeaturePoints:
        return self.points

    def frames(self) -> Frames:
        return frames_at(self.T_predicted.translation(), self.params)

    def associate(self, points: FeaturePoints, T_target_lidar: jaxlie.SE3) -> LinesAndPlanes:
        """Find lines and planes through the nearest map points; only points in the cubes around have one."""
        frames, params = self.frames(), self.params
        _, corner = frames.corner.place(points.corner, T_target_lidar)
        _, surface = frames.surface.place(points.surface, T_target_lidar)
        position = self.T_predicted.translation()
        return LinesAndPlanes(
            lines_near(
                self.map.corner,
                corner,
                points.corner_mask & matched_cubes(corner, frames.corner, position, params),
                frames.corner.anchor,
                params.map.corner_voxel_size,
                params.knn,
                self.neighbours,
            ),
            planes_near(
                self.map.surface,
                surface,
                points.surface_mask & matched_cubes(surface, frames.surface, position, params),
                frames.surface.anchor,
                params.map.voxel_size,
                params.knn,
                self.neighbours,
            ),
        )


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
    cube_map: CubeMap, points: FeaturePoints, keep: Bool[Array, ""], frames: Frames, params: Params
) -> tuple[CubeMap, Insertion, Insertion]:
    """Return the map with a scan's points, its grid shifted to the sensor.

    Args:
        cube_map: donate it.
        points: each kind in its frame, m.
        keep: whether to add any.
        frames: near the sensor.
        params: voxel sizes, ``params.cubes`` and ``params.point_map.nearer_by``.
    """
    kinds = (
        (cube_map.corner, points.corner, points.corner_mask, frames.corner, params.map.corner_voxel_size),
        (cube_map.surface, points.surface, points.surface_mask, frames.surface, params.map.voxel_size),
    )
    cubes = params.cubes
    numbers = jnp.stack([cubes.across, cubes.across, cubes.up])
    maps, insertions = [], []
    for pmap, placed, mask, frame, size in kinds:
        in_blocks = (cubes.edge / (EDGE * size)).astype(jnp.float32)
        half_sides = (numbers / 2).astype(jnp.float32) * in_blocks
        pmap, insertion = insert(
            pmap,
            placed,
            mask & keep,
            frame.anchor,
            size.astype(jnp.float32),
            half_sides,
            params.point_map.nearer_by.astype(jnp.float32),
        )
        # last, because whatever still reads the map beside it would make XLA copy the map
        margin = cubes.margin.astype(jnp.float32) * in_blocks
        maps.append(shift_box(pmap, frame.anchor, half_sides, margin, in_blocks))
        insertions.append(insertion)
    return CubeMap(*maps), insertions[0], insertions[1]
