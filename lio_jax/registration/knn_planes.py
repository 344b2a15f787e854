"""Match a scan with planes through its nearest neighbours in a map of points (FAST-LIO2)."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.geometry import eigenvalues_and_normal3
from lio_jax.core.xla import computed_once
from lio_jax.lidar.params import LidarParams
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.nearest_points import nearest_points
from lio_jax.mapping.params import MapParams
from lio_jax.mapping.point_map import PointMap
from lio_jax.registration.params import KnnParams, ScoredFitParams
from lio_jax.registration.scan_match import NormalEquations, ScanMatch

_Coordinates = Float32[Array, "n k"]
"""One coordinate of n points in each of k columns."""


class FittedPlanes(eqx.Module):
    """The plane that each point lies on, in world axes from the frame's origin."""

    normal: Float32[Array, "k 3"]
    """Unit normal of each plane."""
    offset: Float32[Array, " k"]
    """The plane is where normal'p + offset = 0, m."""
    valid: Bool[Array, " k"]
    """True where a point has a plane."""


def no_planes(mask: Bool[Array, " k"]) -> FittedPlanes:
    """Return planes of none of the points."""
    zeros = jnp.zeros((*mask.shape, 3), jnp.float32)
    return FittedPlanes(zeros, zeros[:, 0], jnp.zeros_like(mask))


def associate(
    pmap: PointMap,
    points: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    map_params: MapParams,
    knn: KnnParams,
    neighbours: int,
) -> FittedPlanes:
    """Return the plane through the nearest map points of each point at a pose.

    A plane is valid if all neighbours lie within ``knn.radius`` of the point and within
    ``knn.plane_tolerance`` of the plane.
    """
    _, placed = frame.place(jnp.where(mask[:, None], points, 0.0), T_world_lidar)
    placed = computed_once(placed)
    return planes_near(pmap, placed, mask, frame.anchor, map_params.voxel_size, knn, neighbours)


def planes_near(
    pmap: PointMap,
    placed: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
    knn: KnnParams,
    neighbours: int,
) -> FittedPlanes:
    """Return the planes of :func:`associate` for points in the frame anchored at ``anchor``, m."""
    x, y, z, enough = neighbours_within(pmap, placed, mask, anchor, voxel_size, knn.radius, neighbours)
    planes, farthest = fit_planes(x, y, z)
    valid = enough & (farthest <= knn.plane_tolerance.astype(jnp.float32))
    return FittedPlanes(planes.normal, planes.offset, valid)


def neighbours_within(
    pmap: PointMap,
    placed: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
    radius: Float[Array, ""],
    neighbours: int,
) -> tuple[_Coordinates, _Coordinates, _Coordinates, Bool[Array, " k"]]:
    """Return x, y and z of each point's nearest map points, and which have all of them within a radius.

    Args:
        pmap: the map.
        placed: m, in the frame anchored at ``anchor``.
        mask: which points are real.
        anchor: block whose lower corner is the origin of ``placed``.
        voxel_size: of the map, m.
        radius: m.
        neighbours: how many per point.

    Returns:
        Columns in the same frame, zero where there are too few.
    """
    size, radius = voxel_size.astype(jnp.float32), radius.astype(jnp.float32)
    near = nearest_points(pmap, placed, mask, anchor, size, neighbours, radius)
    enough = mask & (near.squared_distance[-1] < radius**2)
    x, y, z = (jnp.where(enough, column, 0.0) for column in (near.x, near.y, near.z))
    return x, y, z, enough


def fit_planes(
    x: _Coordinates, y: _Coordinates, z: _Coordinates
) -> tuple[FittedPlanes, Float32[Array, " k"]]:
    """Fit a plane to each column of n points: the one with the least sum of squared distances.

    FAST-LIO2 itself minimises the error of m'p = -1, whose solution leans towards the world's origin and
    has none for planes through it; distances know no origin.

    Args:
        x: m, as are y and z.

    Returns:
        The planes, all called valid, and the largest distance of each plane's own points from it, m.
    """
    (cx, cy, cz), (qx, qy, qz), moments = spread(x, y, z)
    _, normal = computed_once(eigenvalues_and_normal3(moments[:, :3], moments[:, 3:]))
    nx, ny, nz = normal[:, 0], normal[:, 1], normal[:, 2]
    farthest = jnp.max(jnp.abs(nx * qx + ny * qy + nz * qz), 0)
    return FittedPlanes(normal, -(nx * cx + ny * cy + nz * cz), jnp.ones(x.shape[1], bool)), farthest


def spread(
    x: _Coordinates, y: _Coordinates, z: _Coordinates
) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array], Float32[Array, "k 6"]]:
    """Return each column's centre, its points from there, and their second moments.

    Args:
        x: m, as are y and z.

    Returns:
        The moments divided by the number of points, xx, yy, zz, xy, xz and yz, m^2.
    """
    n = x.shape[0]
    cx, cy, cz = computed_once((jnp.sum(x, 0) / n, jnp.sum(y, 0) / n, jnp.sum(z, 0) / n))
    qx, qy, qz = x - cx, y - cy, z - cz
    pairs = ((qx, qx), (qy, qy), (qz, qz), (qx, qy), (qx, qz), (qy, qz))
    moments = computed_once(jnp.stack([jnp.sum(u * v, 0) / n for u, v in pairs], -1))
    return (cx, cy, cz), (qx, qy, qz), moments


def match_score(
    distance: Float[Array, " k"], range_squared: Float[Array, " k"], knn: ScoredFitParams
) -> Float[Array, " k"]:
    """Return 1 - w d / sqrt(r) of points at ranges r and distances d from their planes, m (w: ``knn``'s)."""
    return (
        1 - knn.distance_weight.astype(distance.dtype) * distance / jnp.maximum(range_squared, 1e-6) ** 0.25
    )


def linearise(
    planes: FittedPlanes,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    knn: ScoredFitParams,
    lidar: LidarParams,
) -> NormalEquations:
    """Return the normal equations of the points' distances from their planes at a pose.

    A point at range r and distance d from its plane counts if 1 - w |d| / sqrt(r) exceeds a threshold
    (``knn.distance_weight`` w and ``knn.min_score``); all that count, count alike.
    """
    dtype, kind = T_world_lidar.wxyz_xyz.dtype, points.dtype
    arm, placed = frame.place(jnp.where(planes.valid[:, None], points, 0.0), T_world_lidar)
    (px, py, pz), (rx, ry, rz), (nx, ny, nz) = computed_once(
        (tuple(placed.T), tuple(arm.T), tuple(planes.normal.T))
    )
    distance = nx * px + ny * py + nz * pz + planes.offset
    range_squared = rx**2 + ry**2 + rz**2
    score = match_score(jnp.abs(distance), range_squared, knn)
    used = planes.valid & (score > knn.min_score.astype(kind))
    counts = used.astype(kind)
    distance = jnp.where(used, distance, 0.0)
    # one matrix product gives every sum over the points
    columns = (ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx, nx, ny, nz, distance)
    rows = jnp.stack([counts * column for column in columns] + [counts], 0)
    sums = (rows @ rows.T).astype(dtype)
    precision = 1 / lidar.range_sigma**2
    count = sums[7, 7]
    return NormalEquations(
        hessian=precision * sums[:6, :6],
        gradient=precision * sums[:6, 6],
        matches=count.astype(jnp.int32),
        weight=count,
        squared_error=sums[6, 6],
        arm_squared=(jnp.sum(counts * range_squared) / jnp.maximum(jnp.sum(counts), 1.0)).astype(dtype),
    )


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

    def together(self, points: Float[Array, "k 3"]) -> tuple[Float[Array, "k 3"], Bool[Array, " k"]]:
        return points, self.mask

    def unmatched(self) -> FittedPlanes:
        return no_planes(self.mask)

    def associate(self, points: Float[Array, "k 3"], T_world_lidar: jaxlie.SE3) -> FittedPlanes:
        settings = self.map_params, self.knn, self.neighbours
        return associate(self.map, points, self.mask, T_world_lidar, self.frame(), *settings)

    def linearise(
        self, T_world_lidar: jaxlie.SE3, found: FittedPlanes, iteration: Int32[Array, ""]
    ) -> NormalEquations:
        points = self.points_at(T_world_lidar)
        return linearise(found, points, T_world_lidar, self.frame(), self.knn, self.lidar)

    def frame(self) -> Frame:
        """Return the frame of the matches."""
        return self.origin
