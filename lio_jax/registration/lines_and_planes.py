"""Points against the lines and planes they lie on (LOAM, LIO-SAM): fits and normal equations.

A line is kept as two planes through it at right angles, so that a point's distance from it has the square
d1^2 + d2^2 and all residuals are alike.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.geometry import across, eigenvalues_and_normal3
from lio_jax.core.xla import computed_once
from lio_jax.mapping.feature_map import FeaturePoints, Frames
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.point_map import PointMap
from lio_jax.registration.knn_planes import FittedPlanes, match_score, neighbours_within, no_planes, spread
from lio_jax.registration.params import LineFitParams, ScoredFitParams
from lio_jax.registration.scan_match import NormalEquations

_Coordinates = Float32[Array, "n k"]
"""One coordinate of n points in each of k columns."""


class Lines(eqx.Module):
    """The line that each point lies on, as two planes; both have the same ``valid``."""

    first: FittedPlanes
    """First plane through each line."""
    second: FittedPlanes
    """Second plane through each line, normal to the first."""


class LinesAndPlanes(eqx.Module):
    """What corners and surface points were associated with, each in its frame."""

    lines: Lines
    planes: FittedPlanes


def no_lines_and_planes(points: FeaturePoints) -> LinesAndPlanes:
    """Return matches of none of the points."""
    none = no_planes(points.corner_mask)
    return LinesAndPlanes(Lines(none, none), no_planes(points.surface_mask))


def line_through(
    centre: tuple[Float32[Array, " k"], ...], direction: Float32[Array, "k 3"], valid: Bool[Array, " k"]
) -> Lines:
    """Return lines by a point and a unit vector each.

    Args:
        centre: x, y and z, m.
        direction: unit vectors.
        valid: which lines are real.
    """
    cx, cy, cz = centre

    def plane(normal: Array) -> FittedPlanes:
        return FittedPlanes(normal, -(normal[:, 0] * cx + normal[:, 1] * cy + normal[:, 2] * cz), valid)

    first, second = computed_once(across(direction))
    return Lines(plane(first), plane(second))


def fit_lines(
    x: _Coordinates, y: _Coordinates, z: _Coordinates
) -> tuple[Lines, Float32[Array, "k 3"], Float32[Array, "k 3"]]:
    """Fit a line to each column of n points: the one with the least sum of squared distances.

    It passes through the points' centre along the eigenvector of their largest variance.

    Args:
        x: m, as are y and z.

    Returns:
        The lines, all called valid, their directions, and the columns' variances in ascending order, m^2.
    """
    centre, _, moments = spread(x, y, z)
    # the largest eigenvalue is the smallest one of the negative
    negative, direction = computed_once(eigenvalues_and_normal3(-moments[:, :3], -moments[:, 3:]))
    lines = line_through(centre, direction, jnp.ones(x.shape[1], bool))
    return lines, direction, -negative[:, ::-1]


def lines_near(
    pmap: PointMap,
    placed: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
    knn: LineFitParams,
    neighbours: int,
) -> Lines:
    """Return the line through the nearest map points of each point.

    A line is valid if all neighbours lie within ``knn.radius`` of the point and their largest variance is
    more than ``knn.line_ratio`` times the second.

    Args:
        pmap: the map.
        placed: m, in the frame anchored at ``anchor``.
        mask: which points are real.
        anchor: block whose lower corner is the origin of ``placed``.
        voxel_size: of the map, m.
        knn: limits.
        neighbours: how many per point.
    """
    x, y, z, enough = neighbours_within(pmap, placed, mask, anchor, voxel_size, knn.radius, neighbours)
    lines, _, variances = fit_lines(x, y, z)
    valid = enough & (variances[:, 2] > knn.line_ratio.astype(jnp.float32) * variances[:, 1])
    return eqx.tree_at(lambda both: (both.first.valid, both.second.valid), lines, (valid, valid))


Weight = Callable[[Float[Array, " k"], Float[Array, " k"]], Float[Array, " k"]]
"""Weight of a residual as a function of its squared distance (m^2) and the point's squared range (m^2)."""


class Weights(NamedTuple):
    """Robust weights of either kind's distances."""

    corner: Weight
    """Weight of a line; both of its distances have the same."""
    surface: Weight
    """Weight of a plane's distance."""


def huber(kernel: Float[Array, ""]) -> Weights:
    """Return Huber's weight of any distance, 1 up to the kernel and kernel / distance beyond (m)."""

    def weight(squared_distance: Float[Array, " k"], _: Float[Array, " k"]) -> Float[Array, " k"]:
        scale = kernel.astype(squared_distance.dtype)
        return scale / jnp.sqrt(jnp.maximum(squared_distance, scale**2))

    return Weights(weight, weight)


def scored(knn: ScoredFitParams) -> Weights:
    """Return LIO-SAM's weights: the squared score s of a match, or 0 where it is not above ``min_score``.

    s = 1 - w d for a corner and 1 - w d / sqrt(r) for a surface point at range r (``distance_weight`` w); it
    multiplies distance and derivative.
    """

    def distance(squared: Float[Array, " k"]) -> Float[Array, " k"]:
        # the square root's slope is infinite at 0
        return jnp.sqrt(jnp.maximum(squared, 1e-12))

    def weight(score: Float[Array, " k"]) -> Float[Array, " k"]:
        return jnp.where(score > knn.min_score.astype(score.dtype), score**2, 0.0)

    return Weights(
        lambda squared, _: weight(1 - knn.distance_weight.astype(squared.dtype) * distance(squared)),
        lambda squared, range_squared: weight(match_score(distance(squared), range_squared, knn)),
    )


def linearise(
    matches: LinesAndPlanes,
    points: FeaturePoints,
    T_world_lidar: jaxlie.SE3,
    frames: Frames,
    weights: Weights,
    range_sigma: Float[Array, ""],
) -> NormalEquations:
    """Return the weighted normal equations of the points' distances from their lines and planes at a pose.

    Args:
        matches: of the points.
        points: m, lidar frame.
        T_world_lidar: the pose.
        frames: of the matches.
        weights: robust weights.
        range_sigma: standard deviation of a distance, m.
    """
    lines, planes = matches.lines, matches.planes
    across_first = _Rows.of(lines.first, points.corner, T_world_lidar, frames.corner)
    across_second = _Rows.of(lines.second, points.corner, T_world_lidar, frames.corner)
    surface = _Rows.of(planes, points.surface, T_world_lidar, frames.surface)
    corner_squared = across_first.distance**2 + across_second.distance**2
    surface_squared = surface.distance**2
    at_corner = lines.first.valid * weights.corner(corner_squared, across_first.range_squared)
    at_surface = planes.valid * weights.surface(surface_squared, surface.range_squared)

    dtype = T_world_lidar.wxyz_xyz.dtype
    rows = jnp.concatenate([across_first.columns, across_second.columns, surface.columns], 1)
    # one matrix product gives every sum over the rows
    sums = ((jnp.concatenate([at_corner, at_corner, at_surface]) * rows) @ rows.T).astype(dtype)
    count = (jnp.sum(lines.first.valid) + jnp.sum(planes.valid)).astype(jnp.int32)
    squared_ranges = jnp.sum(lines.first.valid * across_first.range_squared)
    squared_ranges += jnp.sum(planes.valid * surface.range_squared)
    precision = 1 / range_sigma**2
    return NormalEquations(
        hessian=precision * (sums[:6, :6] + sums[:6, :6].T) / 2,
        gradient=precision * sums[:6, 6],
        matches=count,
        weight=(jnp.sum(at_corner) + jnp.sum(at_surface)).astype(dtype),
        squared_error=sums[6, 6],
        arm_squared=squared_ranges.astype(dtype) / jnp.maximum(count, 1).astype(dtype),
    )


class _Rows(eqx.Module):
    """Distances of points from planes, and their derivatives."""

    columns: Float[Array, "7 k"]
    """Derivatives of the distance by rotation and translation, in world axes; then the distance, m."""
    distance: Float[Array, " k"]
    range_squared: Float[Array, " k"]

    @staticmethod
    def of(planes: FittedPlanes, points: Array, T_world_lidar: jaxlie.SE3, frame: Frame) -> "_Rows":
        arm, placed = frame.place(jnp.where(planes.valid[:, None], points, 0.0), T_world_lidar)
        normal = jnp.where(planes.valid[:, None], planes.normal, 0.0)
        (px, py, pz), (rx, ry, rz), (nx, ny, nz) = computed_once(
            (tuple(placed.T), tuple(arm.T), tuple(normal.T))
        )
        offset = jnp.where(planes.valid, planes.offset, 0.0)
        distance = nx * px + ny * py + nz * pz + offset
        turned = (ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx)
        columns = jnp.stack([*turned, nx, ny, nz, distance])
        return _Rows(columns, distance, rx**2 + ry**2 + rz**2)
