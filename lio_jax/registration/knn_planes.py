"""Match a scan with planes through its nearest neighbours in a map of points (FAST-LIO2)."""

import functools
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.geometry import dot3, eigenvalues_and_normal3, normal_slope3
from lio_jax.core.implicit import with_derivative_of
from lio_jax.core.xla import computed_once
from lio_jax.lidar.params import LidarParams
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.nearest_points import coordinates_at, nearest_points
from lio_jax.mapping.params import MapParams
from lio_jax.mapping.point_map import PointMap
from lio_jax.registration.params import KnnParams, ScoredFitParams
from lio_jax.registration.point_sums import as_matrix, distance_columns, in_order, point_sums, products
from lio_jax.registration.scan_match import NormalEquations, ScanMatch, relative_blur

_Coordinates = Float[Array, "n k"]
"""One coordinate of n points in each of k columns."""
PLANE_SHARE = 1.0
"""Variance of the pose by the errors of the map's points, as a share of its variance by the scan's own, where
map and scan have one point per cube of the same size. With the weights that the points of five have in the
planes through them, the share is 0.6 to 1.1 in simulated streets, cities and offices."""


class FittedPlanes(eqx.Module):
    """The plane that each point lies on, in world axes from the frame's origin."""

    normal: Float[Array, "k 3"]
    """Unit normal of each plane."""
    offset: Float[Array, " k"]
    """The plane is where normal'p + offset = 0, m."""
    valid: Bool[Array, " k"]
    """True where a point has a plane."""
    entry: Int32[Array, "n k"]
    """Where the target holds the n points that each plane was fitted to."""

    def following(self, points: Float[Array, "k j"]) -> "FittedPlanes":
        """Return the same planes with their derivative by the points they were fitted to."""
        held, normal = jax.lax.stop_gradient((points, self.normal))
        known = (normal, self.offset)
        normal, offset = with_derivative_of(known, _plane_slope, held, normal, points)
        return replace(self, normal=normal, offset=offset)


def no_planes(mask: Bool[Array, " k"], neighbours: int, dtype: DTypeLike = jnp.float32) -> FittedPlanes:
    """Return planes of none of the points.

    Args:
        mask: which points are real.
        neighbours: number of points that a plane is fitted to.
        dtype: of the target's coordinates.
    """
    zeros, entry = jnp.zeros((*mask.shape, 3), dtype), jnp.zeros((neighbours, len(mask)), jnp.int32)
    return FittedPlanes(zeros, zeros[:, 0], jnp.zeros_like(mask), entry)


def fitted_to(
    pmap: PointMap, planes: FittedPlanes, anchor: Int32[Array, "3"], voxel_size: Float[Array, ""]
) -> Float[Array, "k j"]:
    """Return x of the n points of each plane, then y, then z, m; zero where there is no plane.

    Args:
        pmap: the map that holds the points, which may have a derivative.
        planes: of :func:`planes_near`.
        anchor: block whose lower corner is the origin of the result.
        voxel_size: of the map, m.
    """
    entry, size = jnp.where(planes.valid, planes.entry, 0), voxel_size.astype(pmap.point.dtype)
    return beside_each_match(coordinates_at(pmap, entry, anchor, size), planes.valid)


def beside_each_match(points: Float[Array, "3 n k"], valid: Bool[Array, " k"]) -> Float[Array, "k j"]:
    """Return a row per match with its n points' x, then y, then z; zero where there is no match."""
    return jnp.where(valid, points, 0.0).reshape(-1, len(valid)).T


def associate(
    pmap: PointMap,
    points: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    map_params: MapParams,
    knn: KnnParams,
    neighbours: int,
    least_width: Float[Array, ""] | float = 0.0,
) -> FittedPlanes:
    """Return the plane through the nearest map points of each point at a pose.

    A plane is valid if all neighbours lie within ``knn.radius`` of the point and within
    ``knn.plane_tolerance`` of the plane, and if their second largest standard deviation is at least
    ``least_width`` (m): the normal of a plane through points on a line is a matter of their noise.
    """
    _, placed = frame.place(jnp.where(mask[:, None], points, 0.0), T_world_lidar)
    placed = computed_once(placed)
    size = map_params.voxel_size
    return planes_near(pmap, placed, mask, frame.anchor, size, knn, neighbours, least_width)


def planes_near(
    pmap: PointMap,
    placed: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
    knn: KnnParams,
    neighbours: int,
    least_width: Float[Array, ""] | float = 0.0,
) -> FittedPlanes:
    """Return the planes of :func:`associate` for points in the frame anchored at ``anchor``, m."""
    near = neighbours_within(pmap, placed, mask, anchor, voxel_size, knn.radius, neighbours)
    fit = fit_planes(near.x, near.y, near.z)
    valid = near.enough & (fit.farthest <= knn.plane_tolerance.astype(jnp.float32))
    valid &= fit.width_squared >= jnp.asarray(least_width, jnp.float32) ** 2
    return FittedPlanes(fit.normal, fit.offset, valid, near.entry)


class Within(NamedTuple):
    """Each point's nearest map points, in the points' frame; zero where there are too few."""

    x: _Coordinates
    y: _Coordinates
    z: _Coordinates
    enough: Bool[Array, " k"]
    """Which points have all of them."""
    entry: Int32[Array, "n k"]
    """Where the map holds them, see :class:`lio_jax.mapping.nearest_points.Neighbours`."""


def neighbours_within(
    pmap: PointMap,
    placed: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
    radius: Float[Array, ""],
    neighbours: int,
) -> Within:
    """Return each point's nearest map points within a radius.

    Args:
        pmap: the map.
        placed: m, in the frame anchored at ``anchor``.
        mask: which points are real.
        anchor: block whose lower corner is the origin of ``placed``.
        voxel_size: of the map, m.
        radius: m.
        neighbours: how many per point.
    """
    size, radius = voxel_size.astype(jnp.float32), radius.astype(jnp.float32)
    near = nearest_points(pmap, placed, mask, anchor, size, neighbours, radius)
    enough = mask & (near.squared_distance[-1] < radius**2)
    x, y, z = (jnp.where(enough, column, 0.0) for column in (near.x, near.y, near.z))
    return Within(x, y, z, enough, near.entry)


class PlaneFit(NamedTuple):
    """Planes through n points each."""

    normal: Float[Array, "k 3"]
    """Unit normals."""
    offset: Float[Array, " k"]
    """See :class:`FittedPlanes`, m."""
    farthest: Float[Array, " k"]
    """Largest distance of each plane's own points from it, m."""
    width_squared: Float[Array, " k"]
    """Second largest variance of each plane's points, m^2; small where they lie on a line."""


def fit_planes(x: _Coordinates, y: _Coordinates, z: _Coordinates) -> PlaneFit:
    """Fit a plane to each column of n points: the one with the least sum of squared distances.

    FAST-LIO2 itself minimises the error of m'p = -1, whose solution leans towards the world's origin and
    has none for planes through it; distances know no origin.

    Args:
        x: m, as are y and z.
    """
    (cx, cy, cz), (qx, qy, qz), moments = spread(x, y, z)
    variances, normal = computed_once(eigenvalues_and_normal3(moments[:, :3], moments[:, 3:]))
    nx, ny, nz = normal[:, 0], normal[:, 1], normal[:, 2]
    farthest = functools.reduce(jnp.maximum, jnp.abs(nx * qx + ny * qy + nz * qz))
    return PlaneFit(normal, -(nx * cx + ny * cy + nz * cz), farthest, variances[:, 1])


def _plane_slope(
    points: Float[Array, "k j"], normal: Float[Array, "k 3"], change: Float[Array, "k j"]
) -> tuple[Float[Array, "k 3"], Float[Array, " k"]]:
    """Return how normals and offsets of fitted planes change with the points they were fitted to, m."""
    centre, shift, covariance, spreading = spread_slope(points, change)
    turn, _ = normal_slope3(covariance, normal, spreading)
    return turn, -jnp.sum(turn * centre + normal * shift, -1)


def spread_slope(
    points: Float[Array, "k j"], change: Float[Array, "k j"]
) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"], Float[Array, "k 3 3"], Float[Array, "k 3 3"]]:
    """Return the centre of each row's points, its change, their covariance, and its change (m, m^2)."""
    count = points.shape[1] // 3
    place, moved = (columns.reshape(-1, 3, count) for columns in (points, change))
    centre, shift = jnp.mean(place, -1), jnp.mean(moved, -1)
    place, moved = place - centre[:, :, None], moved - shift[:, :, None]
    half = jnp.einsum("kin,kjn->kij", place, moved) / count
    covariance = jnp.einsum("kin,kjn->kij", place, place) / count
    return centre, shift, covariance, half + jnp.swapaxes(half, 1, 2)


def spread(
    x: _Coordinates, y: _Coordinates, z: _Coordinates
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array], Float[Array, "k 6"]]:
    """Return each column's centre, its points from there, and their second moments.

    Args:
        x: m, as are y and z.

    Returns:
        The moments divided by the number of points, xx, yy, zz, xy, xz and yz, m^2.
    """
    n = x.shape[0]

    def mean(values: _Coordinates) -> Array:
        # row by row: XLA would sum a few long rows in a kernel of its own, which takes longer
        return sum(values[1:], values[0]) / n

    cx, cy, cz = computed_once((mean(x), mean(y), mean(z)))
    qx, qy, qz = x - cx, y - cy, z - cz
    pairs = ((qx, qx), (qy, qy), (qz, qz), (qx, qy), (qx, qz), (qy, qz))
    moments = computed_once(jnp.stack([mean(u * v) for u, v in pairs], -1))
    return (cx, cy, cz), (qx, qy, qz), moments


def match_score(
    distance: Float[Array, " k"], range_squared: Float[Array, " k"], weight: Float[Array, ""]
) -> Float[Array, " k"]:
    """Return 1 - w d / sqrt(r) of points at ranges r and distances d from their planes, m (w: ``weight``)."""
    return 1 - weight.astype(distance.dtype) * distance / jnp.maximum(range_squared, 1e-6) ** 0.25


def linearise(
    planes: FittedPlanes,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    knn: ScoredFitParams,
    lidar: LidarParams,
    fitted_to: Float[Array, "k j"],
) -> NormalEquations:
    """Return the normal equations of the points' distances from their planes at a pose.

    A point at range r and distance d from its plane counts if 1 - w |d| / sqrt(r) exceeds a threshold
    (``knn.distance_weight`` w and ``knn.min_score``); all that count, count alike.

    Args:
        planes: of the points.
        points: m, lidar frame.
        T_world_lidar: the pose.
        frame: of the planes.
        knn: limits.
        lidar: for the standard deviation of a distance.
        fitted_to: see :func:`fitted_to`; the equations have a derivative by it.
    """
    dtype, kind = T_world_lidar.wxyz_xyz.dtype, points.dtype
    points = jnp.where(planes.valid[:, None], points, 0.0)
    arm, placed = frame.place(points, T_world_lidar)
    axes = computed_once((tuple(arm.T), tuple(placed.T), tuple(planes.normal.T)))
    columns = distance_columns(*axes, planes.offset)
    x, y, z = axes[0]
    range_squared = x**2 + y**2 + z**2
    score = match_score(jnp.abs(columns[6]), range_squared, knn.distance_weight)
    counts = (planes.valid & (score > knn.min_score.astype(kind))).astype(kind)
    # one matrix product gives every sum over the points
    rows = jnp.stack([counts * column for column in columns] + [counts], 0)
    sums = rows @ rows.T
    count = jax.lax.stop_gradient(sums[7, 7]).astype(dtype)
    total = point_sums(
        jax.lax.stop_gradient(jnp.append(in_order(sums[:7, :7]), jnp.sum(counts * range_squared))),
        _rows,
        points,
        *frame.placing(T_world_lidar, kind),
        jnp.zeros(0, kind),
        fitted_to,
        (planes, counts),
    ).astype(dtype)
    sums = as_matrix(total[:-1])
    precision = 1 / lidar.range_sigma**2
    arm_squared = total[-1] / jnp.maximum(count, 1.0)
    return NormalEquations(
        hessian=precision * sums[:6, :6],
        gradient=precision * sums[:6, 6],
        matches=count.astype(jnp.int32),
        weight=count,
        squared_error=sums[6, 6],
        arm_squared=arm_squared,
        blur=relative_blur(sums[6, 6], count, arm_squared),
    )


def _rows(
    arm: Array, shift: Array, scales: Array, fitted_to: Array, constants: tuple[FittedPlanes, Array]
) -> Array:
    """Return what each point adds to the sums of :func:`linearise`."""
    planes, counts = constants
    columns = columns_of(planes.following(fitted_to), arm, shift)
    return jnp.concatenate([products(columns, counts), (counts * jnp.sum(arm**2, 0))[None]])


def columns_of(planes: FittedPlanes, arm: Float[Array, "3 k"], shift: Float[Array, "3"]) -> list[Array]:
    """Return the columns of :func:`distance_columns` of points ``arm`` from the sensor.

    Args:
        planes: of the points.
        arm: m, world axes.
        shift: from the frame's origin to the sensor, m.
    """
    x, y, z = arm
    placed = (x + shift[0], y + shift[1], z + shift[2])
    return distance_columns((x, y, z), placed, tuple(planes.normal.T), planes.offset)


class ScanToPoints(ScanMatch[Array, FittedPlanes]):
    """A scan against the planes through its nearest neighbours in a map of points."""

    map: PointMap
    mask: Bool[Array, " k"]
    """Which points are real."""
    map_params: MapParams
    knn: ScoredFitParams
    lidar: LidarParams
    origin: Frame
    """Frame of the matches, near the sensor."""
    neighbours: int = eqx.field(static=True)
    least_width: Float[Array, ""] | float = 0.0
    """See :func:`associate`, m."""

    def together(self, points: Float[Array, "k 3"]) -> tuple[Float[Array, "k 3"], Bool[Array, " k"]]:
        return points, self.mask

    def unmatched(self) -> FittedPlanes:
        return no_planes(self.mask, self.neighbours, self.map.point.dtype)

    def associate(self, points: Float[Array, "k 3"], T_world_lidar: jaxlie.SE3) -> FittedPlanes:
        settings = self.map_params, self.knn, self.neighbours, self.least_width
        return associate(self.map, points, self.mask, T_world_lidar, self.frame(), *settings)

    def linearise(
        self, T_world_lidar: jaxlie.SE3, found: FittedPlanes, iteration: Int32[Array, ""]
    ) -> NormalEquations:
        points, frame = self.points_at(T_world_lidar), self.frame()
        at = fitted_to(self.map, found, frame.anchor, self.map_params.voxel_size)
        return linearise(found, points, T_world_lidar, frame, self.knn, self.lidar, at)

    def counted(self, T_world_lidar: jaxlie.SE3, found: FittedPlanes) -> Bool[Array, " k"]:
        points = jnp.where(found.valid[:, None], self.points_at(T_world_lidar), 0.0)
        arm, placed = self.frame().place(points, T_world_lidar)
        distance = jnp.abs(dot3(found.normal, placed) + found.offset)
        score = match_score(distance, dot3(arm, arm), self.knn.distance_weight)
        return found.valid & (score > self.knn.min_score.astype(points.dtype))

    def frame(self) -> Frame:
        """Return the frame of the matches."""
        return self.origin
