"""A scan against the one before it: corners on lines, flat points on planes through adjacent rings (A-LOAM).

Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014, section V.B.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from lio_jax.core.xla import computed_once
from lio_jax.lidar.features import FeatureCloud
from lio_jax.mapping.feature_map import FeaturePoints, Frames
from lio_jax.mapping.frame import Frame
from lio_jax.registration.feature_match import FeatureMatch
from lio_jax.registration.knn_planes import FittedPlanes, beside_each_match
from lio_jax.registration.lines_and_planes import (
    FittedTo,
    Lines,
    LinesAndPlanes,
    line_through,
    no_lines_and_planes,
)
from lio_jax.registration.params import ScanToScanParams
from lio_jax.registration.ring_index import Nearest, Queries, RingIndex, nearest_by_ring, ring_index

_Vectors = tuple[Array, Array, Array]


class LastScan(eqx.Module):
    """What the next scan is matched with, in the lidar frame of one instant."""

    index: RingIndex
    """Less sharp points, then less flat ones, which count as rings of their own."""

    def varying(self) -> "LastScan":
        """Return a tree of booleans: the points have a derivative."""
        fixed = jax.tree.map(lambda _: False, self)
        return eqx.tree_at(lambda one: (one.index.x, one.index.y, one.index.z), fixed, (True, True, True))


def last_scan(
    corner: FeatureCloud,
    surface: FeatureCloud,
    corner_points: Float[Array, "c 3"],
    surface_points: Float[Array, "s 3"],
    rings: int,
) -> LastScan:
    """Prepare a scan's less sharp and less flat points for the next scan.

    Args:
        corner: less sharp points, for their rings and mask.
        surface: less flat points, for their rings and mask.
        corner_points: of ``corner``, in the frame of the instant, m.
        surface_points: of ``surface``, in the frame of the instant, m.
        rings: number of the sensor's rings.
    """
    points = jnp.concatenate([corner_points, surface_points])
    ring = jnp.concatenate([corner.ring, surface.ring + rings])
    return LastScan(ring_index(points, ring, jnp.concatenate([corner.mask, surface.mask]), 2 * rings))


def empty_scan(corners: int, surfaces: int, rings: int, dtype: DTypeLike = jnp.float32) -> LastScan:
    """Return a scan without points, of the given capacities and the dtype of coordinates."""
    none = jnp.zeros(corners + surfaces, jnp.int32)
    return LastScan(ring_index(jnp.zeros((len(none), 3), dtype), none, none > 0, 2 * rings))


class ScanToScan(FeatureMatch):
    """A scan's sharp and flat points, and the last scan. The pose sought is that in the last scan's frame."""

    last: LastScan
    limits: ScanToScanParams

    def frames(self) -> Frames:
        # the last scan's own axes
        here = Frame(jnp.zeros(3, jnp.int32), jnp.zeros_like(self.T_predicted.translation()))
        return Frames(here, here)

    def unmatched(self) -> LinesAndPlanes:
        return no_lines_and_planes(self.points_at(self.T_predicted), 2, 3, self.last.index.x.dtype)

    def fitted_to(self, found: LinesAndPlanes) -> FittedTo:
        def at(planes: FittedPlanes) -> Array:
            points = jnp.stack(self.last.index.at(jnp.where(planes.valid, planes.entry, 0)))
            return beside_each_match(points, planes.valid)

        return FittedTo(at(found.lines.first), at(found.planes))

    def associate(self, points: FeaturePoints, T_world_lidar: jaxlie.SE3) -> LinesAndPlanes:
        """Find lines and planes.

        A sharp point lies on the line through the nearest less sharp point and the nearest one of another
        ring; a flat point lies on the plane through the nearest less flat point, the next one of its ring and
        the nearest one of another ring. A-LOAM's two loops, up and down the rings from the nearest point,
        come to the same.
        """
        frame, corners = self.frames().corner, len(points.corner)
        together, mask = points.together()
        _, placed = frame.place(together, T_world_lidar)
        x, y, z = computed_once(tuple(jnp.where(mask[:, None], placed, 0.0).astype(jnp.float32).T))
        index = self.last.index
        rings = len(index.elevation) // 2
        lowest = jnp.where(jnp.arange(len(mask)) < corners, 0, rings).astype(jnp.int32)
        found = nearest_by_ring(
            index,
            Queries(x, y, z, lowest),
            mask,
            rings,
            self.limits.radius.astype(jnp.float32),
            self.limits.rings_apart.astype(jnp.float32),
        )
        at_corner, at_surface = (
            jax.tree.map(lambda place, part=part: place[part], found)
            for part in (slice(0, corners), slice(corners, None))
        )
        return LinesAndPlanes(_lines(index, at_corner), _planes(index, at_surface))


def _lines(index: RingIndex, found: Nearest) -> Lines:
    entry = jnp.stack([found.nearest, found.other_ring])
    here, there = (index.at(place) for place in jnp.maximum(entry, 0))
    along = _difference(there, here)
    length = _length(along)
    valid = (found.other_ring >= 0) & (length > 0)
    direction = jnp.stack(along, -1) / jnp.where(valid, length, 1.0)[:, None]
    return line_through(here, direction, valid, entry)


def _planes(index: RingIndex, found: Nearest) -> FittedPlanes:
    entry = jnp.stack([found.nearest, found.same_ring, found.other_ring])
    here, along, aside = computed_once(tuple(index.at(place) for place in jnp.maximum(entry, 0)))
    along, aside = _difference(along, here), _difference(aside, here)
    normal = computed_once(_cross(along, aside))
    area = _length(normal)
    valid = (found.same_ring >= 0) & (found.other_ring >= 0) & (area > 0)
    nx, ny, nz = (axis / jnp.where(valid, area, 1.0) for axis in normal)
    offset = -(nx * here[0] + ny * here[1] + nz * here[2])
    return FittedPlanes(jnp.stack([nx, ny, nz], -1), offset, valid, entry)


def _difference(left: _Vectors, right: _Vectors) -> _Vectors:
    return left[0] - right[0], left[1] - right[1], left[2] - right[2]


def _cross(left: _Vectors, right: _Vectors) -> _Vectors:
    (ax, ay, az), (bx, by, bz) = left, right
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


def _length(vector: _Vectors) -> Array:
    return jnp.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
