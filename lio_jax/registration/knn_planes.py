"""Scan to map by planes through nearest neighbours (FAST-LIO2): association, fit and normal equations."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Float32

from lio_jax.core.geometry import eigenvalues_and_normal3
from lio_jax.core.materialise import materialised
from lio_jax.core.params import Params
from lio_jax.mapping.nearest_points import nearest_points
from lio_jax.mapping.point_map import PointMap
from lio_jax.registration.scan_to_map import Frame, NormalEquations

_Coordinates = Float32[Array, "n k"]
"""One coordinate of n points in each of k columns."""


class Planes(eqx.Module):
    """The plane that each point lies on, in world axes from the frame's origin."""

    normal: Float32[Array, "k 3"]
    offset: Float32[Array, " k"]
    """The plane is where normal'p + offset = 0, m."""
    valid: Bool[Array, " k"]


def no_planes(mask: Bool[Array, " k"]) -> Planes:
    """Return planes of none of the points."""
    zeros = jnp.zeros((*mask.shape, 3), jnp.float32)
    return Planes(zeros, zeros[:, 0], jnp.zeros_like(mask))


def associate(
    pmap: PointMap,
    points: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    params: Params,
    neighbours: int,
) -> Planes:
    """Return the plane through the nearest map points of each point at a pose.

    A plane is valid if all neighbours lie within ``params.knn.radius`` of the point and within
    ``params.knn.plane_tolerance`` of the plane.
    """
    _, placed = frame.place(jnp.where(mask[:, None], points, 0.0), T_world_lidar)
    placed = materialised(placed)
    near = nearest_points(
        pmap, placed, mask, frame.anchor, params.map.voxel_size.astype(jnp.float32), neighbours
    )
    radius, tolerance = (
        value.astype(jnp.float32) for value in (params.knn.radius, params.knn.plane_tolerance)
    )
    enough = mask & (near.squared_distance[-1] < radius**2)
    x, y, z = (jnp.where(enough, column, 0.0) for column in (near.x, near.y, near.z))
    planes, farthest = fit_planes(x, y, z)
    return Planes(planes.normal, planes.offset, enough & (farthest <= tolerance))


def fit_planes(x: _Coordinates, y: _Coordinates, z: _Coordinates) -> tuple[Planes, Float32[Array, " k"]]:
    """Fit a plane to each column of n points: the one with the least sum of squared distances.

    FAST-LIO2 itself minimises the error of m'p = -1, whose solution leans towards the world's origin and
    has none for planes through it; distances know no origin.

    Args:
        x: m; y and z likewise.

    Returns:
        The planes, all called valid, and the largest distance of each plane's own points from it, m.
    """
    n = x.shape[0]
    cx, cy, cz = materialised((jnp.sum(x, 0) / n, jnp.sum(y, 0) / n, jnp.sum(z, 0) / n))
    qx, qy, qz = x - cx, y - cy, z - cz
    pairs = ((qx, qx), (qy, qy), (qz, qz), (qx, qy), (qx, qz), (qy, qz))
    moments = materialised(jnp.stack([jnp.sum(u * v, 0) / n for u, v in pairs], -1))
    _, normal = materialised(eigenvalues_and_normal3(moments[:, :3], moments[:, 3:]))
    nx, ny, nz = normal[:, 0], normal[:, 1], normal[:, 2]
    farthest = jnp.max(jnp.abs(nx * qx + ny * qy + nz * qz), 0)
    return Planes(normal, -(nx * cx + ny * cy + nz * cz), jnp.ones(x.shape[1], bool)), farthest


def linearise(
    planes: Planes,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    params: Params,
) -> NormalEquations:
    """Return the normal equations of the points' distances from their planes at a pose.

    A point at range r and distance d from its plane counts if 1 - w |d| / sqrt(r) exceeds a threshold
    (``params.knn.distance_weight`` w and ``params.knn.min_score``); all that count, count alike.
    """
    dtype, kind = T_world_lidar.wxyz_xyz.dtype, points.dtype
    knn = params.knn
    arm, placed = frame.place(jnp.where(planes.valid[:, None], points, 0.0), T_world_lidar)
    (px, py, pz), (rx, ry, rz), (nx, ny, nz) = materialised(
        (tuple(placed.T), tuple(arm.T), tuple(planes.normal.T))
    )
    distance = nx * px + ny * py + nz * pz + planes.offset
    range_squared = rx**2 + ry**2 + rz**2
    weight = knn.distance_weight.astype(kind)
    score = 1 - weight * jnp.abs(distance) / jnp.maximum(range_squared, 1e-6) ** 0.25
    used = planes.valid & (score > knn.min_score.astype(kind))
    counts = used.astype(kind)
    distance = jnp.where(used, distance, 0.0)
    # one matrix product gives every sum over the points
    columns = (ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx, nx, ny, nz, distance)
    rows = jnp.stack([counts * column for column in columns] + [counts], 0)
    sums = (rows @ rows.T).astype(dtype)
    precision = 1 / params.lidar.range_sigma**2
    count = sums[7, 7]
    return NormalEquations(
        hessian=precision * sums[:6, :6],
        gradient=precision * sums[:6, 6],
        matches=count.astype(jnp.int32),
        weight=count,
        squared_error=sums[6, 6],
        arm_squared=(jnp.sum(counts * range_squared) / jnp.maximum(jnp.sum(counts), 1.0)).astype(dtype),
    )
