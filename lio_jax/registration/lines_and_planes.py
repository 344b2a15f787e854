"""Points against the lines and planes they lie on (LOAM, LIO-SAM): fits and normal equations.

A line is kept as two planes through it at right angles, so that a point's distance from it has the square
d1^2 + d2^2 and all residuals are alike.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.geometry import across, eigenvalues_and_normal3, normal_slope3
from lio_jax.core.implicit import with_derivative_of
from lio_jax.core.xla import computed_once
from lio_jax.mapping.feature_map import FeaturePoints, Frames
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.point_map import PointMap
from lio_jax.registration.knn_planes import (
    FittedPlanes,
    columns_of,
    match_score,
    neighbours_within,
    no_planes,
    spread,
    spread_slope,
)
from lio_jax.registration.params import LineFitParams, ScoredFitParams
from lio_jax.registration.point_sums import as_matrix, distance_columns, in_order, point_sums, products
from lio_jax.registration.scan_match import NormalEquations, relative_blur

_Coordinates = Float[Array, "n k"]
"""One coordinate of n points in each of k columns."""


class Lines(eqx.Module):
    """The line that each point lies on, as two planes; both have the same ``valid`` and ``entry``."""

    first: FittedPlanes
    """First plane through each line."""
    second: FittedPlanes
    """Second plane through each line, normal to the first."""

    def following(self, points: Float[Array, "k j"]) -> "Lines":
        """Return the same lines with their derivative by the points they were fitted to."""
        held = jax.lax.stop_gradient((points, self.first.normal, self.second.normal))
        known = (self.first.normal, self.first.offset, self.second.normal, self.second.offset)
        normal, offset, other_normal, other_offset = with_derivative_of(known, _line_slope, *held, points)
        first = replace(self.first, normal=normal, offset=offset)
        return Lines(first, replace(self.second, normal=other_normal, offset=other_offset))


class LinesAndPlanes(eqx.Module):
    """What corners and surface points were associated with, each in its frame."""

    lines: Lines
    planes: FittedPlanes


class FittedTo(NamedTuple):
    """The points that lines and planes were fitted to: x, then y, then z, m, a row per match."""

    lines: Float[Array, "c i"]
    planes: Float[Array, "s j"]


def no_lines_and_planes(
    points: FeaturePoints, in_line: int, in_plane: int, dtype: DTypeLike
) -> LinesAndPlanes:
    """Return matches of none of the points.

    Args:
        points: corners and surface points.
        in_line: number of points that a line is fitted to.
        in_plane: number of points that a plane is fitted to.
        dtype: of the target's coordinates.
    """
    none = no_planes(points.corner_mask, in_line, dtype)
    return LinesAndPlanes(Lines(none, none), no_planes(points.surface_mask, in_plane, dtype))


def line_through(
    centre: tuple[Float[Array, " k"], ...],
    direction: Float[Array, "k 3"],
    valid: Bool[Array, " k"],
    entry: Int32[Array, "n k"],
) -> Lines:
    """Return lines by a point and a unit vector each.

    Args:
        centre: x, y and z, m.
        direction: unit vectors.
        valid: which lines are real.
        entry: where the target holds the points of each line.
    """
    cx, cy, cz = centre

    def plane(normal: Array) -> FittedPlanes:
        offset = -(normal[:, 0] * cx + normal[:, 1] * cy + normal[:, 2] * cz)
        return FittedPlanes(normal, offset, valid, entry)

    first, second = computed_once(across(direction))
    return Lines(plane(first), plane(second))


def _line_slope(
    points: Float[Array, "k j"],
    first: Float[Array, "k 3"],
    second: Float[Array, "k 3"],
    change: Float[Array, "k j"],
) -> tuple[Array, Array, Array, Array]:
    """Return how both planes' normals and offsets change with the points that a line was fitted to, m.

    The planes turn with the line's direction, and not about it: the sum of both squared distances is the same
    whichever way they lie.
    """
    centre, shift, covariance, spreading = spread_slope(points, change)
    direction = jnp.cross(first, second)
    # the largest eigenvalue is the smallest one of the negative
    turn, _ = normal_slope3(-covariance, direction, -spreading)

    def tilted(normal: Array) -> tuple[Array, Array]:
        change = -jnp.sum(normal * turn, -1, keepdims=True) * direction
        return change, -jnp.sum(change * centre + normal * shift, -1)

    return *tilted(first), *tilted(second)


def fit_lines(
    x: _Coordinates, y: _Coordinates, z: _Coordinates
) -> tuple[tuple[Array, Array, Array], Float[Array, "k 3"], Float[Array, "k 3"]]:
    """Fit a line to each column of n points: the one with the least sum of squared distances.

    It passes through the points' centre along the eigenvector of their largest variance.

    Args:
        x: m, as are y and z.

    Returns:
        The columns' centres (m), the lines' directions, and the columns' variances in ascending order, m^2.
    """
    centre, _, moments = spread(x, y, z)
    # the largest eigenvalue is the smallest one of the negative
    negative, direction = computed_once(eigenvalues_and_normal3(-moments[:, :3], -moments[:, 3:]))
    return centre, direction, -negative[:, ::-1]


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
    near = neighbours_within(pmap, placed, mask, anchor, voxel_size, knn.radius, neighbours)
    centre, direction, variances = fit_lines(near.x, near.y, near.z)
    valid = near.enough & (variances[:, 2] > knn.line_ratio.astype(jnp.float32) * variances[:, 1])
    return line_through(centre, direction, valid, near.entry)


Weight = Callable[[Float[Array, " s"], Float[Array, " k"], Float[Array, " k"]], Float[Array, " k"]]
"""Weight of a residual, given the scales, its squared distance (m^2) and the point's squared range (m^2)."""


class Weights(eqx.Module):
    """Robust weights of either kind's distances."""

    scales: Float[Array, " s"]
    """What the weights depend on; they have a derivative by it."""
    corner: Weight = eqx.field(static=True)
    """Weight of a line; both of its distances have the same."""
    surface: Weight = eqx.field(static=True)
    """Weight of a plane's distance."""


def huber(kernel: Float[Array, ""]) -> Weights:
    """Return Huber's weight of any distance, 1 up to the kernel and kernel / distance beyond (m)."""
    return Weights(kernel[None], _huber, _huber)


def _huber(scales: Array, squared_distance: Array, _: Array) -> Array:
    return scales[0] / jnp.sqrt(jnp.maximum(squared_distance, scales[0] ** 2))


def scored(knn: ScoredFitParams) -> Weights:
    """Return LIO-SAM's weights: the squared score s of a match, or 0 where it is not above ``min_score``.

    s = 1 - w d for a corner and 1 - w d / sqrt(r) for a surface point at range r (``distance_weight`` w); it
    multiplies distance and derivative.
    """
    return Weights(jnp.stack([knn.distance_weight, knn.min_score]), _line_score, _plane_score)


def _line_score(scales: Array, squared: Array, _: Array) -> Array:
    return _squared_score(scales, 1 - scales[0] * _root(squared))


def _plane_score(scales: Array, squared: Array, range_squared: Array) -> Array:
    return _squared_score(scales, match_score(_root(squared), range_squared, scales[0]))


def _squared_score(scales: Array, score: Array) -> Array:
    return jnp.where(score > scales[1], score**2, 0.0)


def _root(squared: Array) -> Array:
    # the square root's slope is infinite at 0
    return jnp.sqrt(jnp.maximum(squared, 1e-12))


def linearise(
    matches: LinesAndPlanes,
    points: FeaturePoints,
    T_world_lidar: jaxlie.SE3,
    frames: Frames,
    weights: Weights,
    range_sigma: Float[Array, ""],
    fitted_to: FittedTo,
) -> NormalEquations:
    """Return the weighted normal equations of the points' distances from their lines and planes at a pose.

    Args:
        matches: of the points.
        points: m, lidar frame.
        T_world_lidar: the pose.
        frames: of the matches.
        weights: robust weights.
        range_sigma: standard deviation of a distance, m.
        fitted_to: the points of the matches; the equations have a derivative by them.
    """
    lines, planes = matches.lines, matches.planes
    dtype, kind = T_world_lidar.wxyz_xyz.dtype, points.surface.dtype
    across_first = _Rows.of(lines.first, points.corner, T_world_lidar, frames.corner)
    across_second = _Rows.of(lines.second, points.corner, T_world_lidar, frames.corner)
    surface = _Rows.of(planes, points.surface, T_world_lidar, frames.surface)
    corner_squared = across_first.distance**2 + across_second.distance**2
    scales = weights.scales.astype(kind)
    at_corner = lines.first.valid * weights.corner(scales, corner_squared, across_first.range_squared)
    at_surface = planes.valid * weights.surface(scales, surface.distance**2, surface.range_squared)

    rows = jnp.concatenate([across_first.columns, across_second.columns, surface.columns], 1)
    # one matrix product gives every sum over the rows
    sums = (jnp.concatenate([at_corner, at_corner, at_surface]) * rows) @ rows.T
    squared_ranges = jnp.sum(lines.first.valid * across_first.range_squared)
    squared_ranges += jnp.sum(planes.valid * surface.range_squared)
    weight = jnp.sum(at_corner) + jnp.sum(at_surface)
    known = jax.lax.stop_gradient(jnp.concatenate([in_order(sums), jnp.stack([weight, squared_ranges])]))
    total = point_sums(
        known,
        _line_rows,
        jnp.where(lines.first.valid[:, None], points.corner, 0.0),
        *frames.corner.placing(T_world_lidar, kind),
        scales,
        fitted_to.lines,
        (lines, weights),
    ) + point_sums(
        jnp.zeros_like(known),
        _plane_rows,
        jnp.where(planes.valid[:, None], points.surface, 0.0),
        *frames.surface.placing(T_world_lidar, kind),
        scales,
        fitted_to.planes,
        (planes, weights),
    )
    total = total.astype(dtype)
    products, (weight, squared_ranges) = as_matrix(total[:-2]), total[-2:]
    count = (jnp.sum(lines.first.valid) + jnp.sum(planes.valid)).astype(jnp.int32)
    precision = 1 / range_sigma**2
    arm_squared = squared_ranges / jnp.maximum(count, 1).astype(dtype)
    return NormalEquations(
        hessian=precision * products[:6, :6],
        gradient=precision * products[:6, 6],
        matches=count,
        weight=weight,
        squared_error=products[6, 6],
        arm_squared=arm_squared,
        blur=relative_blur(products[6, 6], weight, arm_squared),
    )


def counted(
    matches: LinesAndPlanes,
    points: FeaturePoints,
    T_world_lidar: jaxlie.SE3,
    frames: Frames,
    weights: Weights,
) -> Bool[Array, " k"]:
    """Return which points have a weight in :func:`linearise`, corners first; arguments as there."""
    lines, planes = matches.lines, matches.planes
    first = _Rows.of(lines.first, points.corner, T_world_lidar, frames.corner)
    second = _Rows.of(lines.second, points.corner, T_world_lidar, frames.corner)
    surface = _Rows.of(planes, points.surface, T_world_lidar, frames.surface)
    scales = weights.scales.astype(points.surface.dtype)
    squared = first.distance**2 + second.distance**2
    at_corner = lines.first.valid & (weights.corner(scales, squared, first.range_squared) > 0)
    at_surface = planes.valid & (weights.surface(scales, surface.distance**2, surface.range_squared) > 0)
    return jnp.concatenate([at_corner, at_surface])


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
        axes = computed_once((tuple(arm.T), tuple(placed.T), tuple(normal.T)))
        columns = distance_columns(*axes, jnp.where(planes.valid, planes.offset, 0.0))
        x, y, z = axes[0]
        return _Rows(jnp.stack(columns), columns[6], x**2 + y**2 + z**2)


def _line_rows(
    arm: Array, shift: Array, scales: Array, fitted_to: Array, constants: tuple[Lines, Weights]
) -> Array:
    """Return what each corner adds to the sums of :func:`linearise`."""
    lines, weights = constants
    lines, valid = lines.following(fitted_to), lines.first.valid
    both = [columns_of(plane, arm, shift) for plane in (lines.first, lines.second)]
    squared, range_squared = both[0][6] ** 2 + both[1][6] ** 2, jnp.sum(arm**2, 0)
    weight = valid * weights.corner(scales, squared, range_squared)
    added = products(both[0], weight) + products(both[1], weight)
    return jnp.concatenate([added, jnp.stack([weight, valid * range_squared])])


def _plane_rows(
    arm: Array, shift: Array, scales: Array, fitted_to: Array, constants: tuple[FittedPlanes, Weights]
) -> Array:
    """Return what each surface point adds to the sums of :func:`linearise`."""
    planes, weights = constants
    columns, range_squared = columns_of(planes.following(fitted_to), arm, shift), jnp.sum(arm**2, 0)
    weight = planes.valid * weights.surface(scales, columns[6] ** 2, range_squared)
    return jnp.concatenate([products(columns, weight), jnp.stack([weight, planes.valid * range_squared])])
