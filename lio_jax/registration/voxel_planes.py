"""Match a scan with the planes of a voxel map: point-to-plane distances, robustly weighted by their noise."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.geometry import across, dot3, normal_slope3
from lio_jax.core.implicit import with_derivative_of
from lio_jax.core.xla import computed_once
from lio_jax.lidar.params import BeamParams
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.params import VoxelMapParams
from lio_jax.mapping.voxel_map import VoxelMap, anchor_of, mean_and_covariance, query_nearest
from lio_jax.registration.params import RobustMatch
from lio_jax.registration.point_sums import as_matrix, in_order, point_sums, products
from lio_jax.registration.scan_match import NormalEquations, ScanMatch


class Matches(eqx.Module):
    """What each point was associated with, in world axes from ``origin``."""

    mean: Float[Array, "k 3"]
    """m."""
    normal: Float[Array, "k 3"]
    """Unit normal of each voxel's plane."""
    variances: Float[Array, "k 2"]
    """The voxel's two smaller variances, ascending, m^2."""
    count: Float[Array, " k"]
    """Number of points of the voxel."""
    slot: Int32[Array, " k"]
    """Where the map holds the voxel."""
    used: Bool[Array, " k"]
    """True where a point has a match."""
    least_variance: Float[Array, ""] | float = 0.0
    """Variance across which a voxel is narrow, m^2; see :func:`point_noise`."""

    def coordinates_in(self, vmap: VoxelMap) -> Float[Array, "k 5"]:
        """Return coordinates of the matches, by which they have a derivative, as functions of their voxels.

        They are two tilts of the plane (rad), its offset along its normal (m), and the two smaller variances
        (m^2). The tilts and the offset are zero, but their derivative by the map's moments is not.
        """
        moments = vmap.moments.at[self.slot].get(mode="promise_in_bounds")
        held, normal, variances = jax.lax.stop_gradient((moments, self.normal, self.variances))
        known = jnp.concatenate([jnp.zeros_like(normal), variances], -1)
        return with_derivative_of(known, _coordinates, held, normal, moments)

    def in_same_voxel(self, slots: int) -> Int32[Array, " k"]:
        """Return how many matched points lie in the voxel of each point, out of a map of so many slots."""
        used = self.used.astype(jnp.int32)
        return jnp.zeros(slots, jnp.int32).at[self.slot].add(used)[self.slot]

    def at(self, coordinates: Float[Array, "k 5"] | None) -> "Matches":
        """Return the same matches as functions of :meth:`coordinates_in`; None: they are constants."""
        if coordinates is None:
            return self
        normal = jax.lax.stop_gradient(self.normal)
        tilts = zip(across(normal), coordinates[:, :2].T, strict=True)
        return replace(
            self,
            mean=self.mean + coordinates[:, 2:3] * normal,
            normal=normal + sum(angle[:, None] * direction for direction, angle in tilts),
            variances=coordinates[:, 3:],
        )


_SURFACE_SHARE = 1 / 3
"""Share of the matches that have to lie on surfaces; see :func:`associate`."""


def associate(
    vmap: VoxelMap,
    points: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    map_params: VoxelMapParams,
) -> Matches:
    """Return the distribution of the map that each point lies on at a pose.

    A plane of beams, which contains the sensor that saw it (:func:`lio_jax.mapping.voxel_map.insert`), is no
    match: it hides a turn of the sensor, and contradicts the pose once the vehicle has moved. Where less than
    a third of the matches would be left, all planes count.
    """
    _, placed = frame.place(jnp.where(mask[:, None], points, 0.0), T_world_lidar)
    near = query_nearest(
        vmap,
        placed,
        frame.anchor,
        map_params.voxel_size.astype(jnp.float32),
        map_params.min_points.astype(jnp.float32),
    )
    met = mask & near.valid
    surfaces = met & near.surface
    enough = jnp.sum(surfaces) >= _SURFACE_SHARE * jnp.sum(met)
    used = jnp.where(enough, surfaces, met)
    return Matches(near.mean, near.normal, near.variances, near.count, near.slot, used)


def no_matches(mask: Bool[Array, " k"], dtype: DTypeLike) -> Matches:
    """Return matches of none of the points, with a map of this dtype."""
    zeros = jnp.zeros((*mask.shape, 3), dtype)
    return Matches(
        zeros, zeros, zeros[:, :2], zeros[:, 0], jnp.zeros(len(mask), jnp.int32), jnp.zeros_like(mask)
    )


class Surface(NamedTuple):
    """The distributions of k voxels, with means relative to their centres."""

    mean: Float[Array, "k 3"]
    normal: Float[Array, "k 3"]
    variances: Float[Array, "k 2"]


def surface_slope(
    moments: Float[Array, "k 10"], normal: Float[Array, "k 3"], change: Float[Array, "k 10"]
) -> Surface:
    """Return how means, normals and the two smaller variances change with the moments.

    Args:
        moments: of each voxel.
        normal: of each voxel's plane.
        change: of the moments; that of the number of points has no effect.
    """
    count = jnp.maximum(moments[:, :1], 1.0)
    mean, diagonal, off_diagonal = mean_and_covariance(moments)
    moved = change[:, 1:4] / count
    both = mean[:, :, None] * moved[:, None, :]
    second = _symmetric(change[:, 4:7] / count, change[:, 7:10] / count)
    dA = second - both - jnp.swapaxes(both, 1, 2)
    return Surface(moved, *normal_slope3(_symmetric(diagonal, off_diagonal), normal, dA))


def _coordinates(
    held: Float[Array, "k 10"], normal: Float[Array, "k 3"], moments: Float[Array, "k 10"]
) -> Array:
    """Return a linear function of the moments whose slope is that of :meth:`Matches.coordinates_in`.

    The slope is worked out by each of the nine moments that have an effect, once for all tangents.
    """
    first, second = across(normal)

    def along(unit: Array) -> Array:
        change = surface_slope(held, normal, jnp.broadcast_to(unit, held.shape))
        components = ((change.normal, first), (change.normal, second), (change.mean, normal))
        moved = [dot3(of, axis) for of, axis in components]
        return jnp.stack([*moved, *change.variances.T], -1)

    slopes = computed_once(jnp.moveaxis(jax.vmap(along)(jnp.eye(10, dtype=held.dtype)[1:]), -1, 1))
    columns = zip(slopes, moments.T[1:], strict=True)
    return sum((slope * moment for slope, moment in columns), jnp.zeros_like(slopes[0])).T


def _symmetric(diagonal: Float[Array, "k 3"], off_diagonal: Float[Array, "k 3"]) -> Array:
    (xx, yy, zz), (xy, xz, yz) = diagonal.T, off_diagonal.T
    return jnp.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], -1).reshape(-1, 3, 3)


_BLUR_KERNEL = 0.5
"""Scale of the kernel of :meth:`PointNoise.blur` in standard deviations of a distance."""


class PointNoise(eqx.Module):
    """Each matched point's distance from its plane and the noise of that distance."""

    matched: Bool[Array, " k"]
    """True where there is a match."""
    arm: Float[Array, "k 3"]
    """Vector from the sensor to each point, in world axes, m."""
    distance: Float[Array, " k"]
    """Distance from the plane along its normal, m; zero where there is no match."""
    variance: Float[Array, " k"]
    """Variance of the distance, m^2; one where there is no match."""
    precision: Float[Array, " k"]
    """Precision with which the distance is weighted, 1/m^2; zero where there is no match."""
    scaled_squared: Float[Array, " k"]
    """Squared distance, scaled by its noise, m^2; in a flat voxel it is the squared distance itself."""

    def weight(self, kernel: Float[Array, ""]) -> Float[Array, " k"]:
        """Return the Geman-McClure weights of the noise-scaled distances, zero where there is no match."""
        return jnp.where(self.matched, (kernel**2 / (kernel**2 + self.scaled_squared)) ** 2, 0.0)

    def blur(self, facing: Float[Array, ""]) -> Float[Array, " k"]:
        """Return the Geman-McClure losses of the distances, m^2, with a kernel as narrow as their noise.

        The registration's kernel is wider, so that a wrong prediction finds the map. Through it, edges and
        plants add to the blur. Their distances are smaller in a smaller world, which would favour ranges that
        are too short.

        Args:
            facing: variance of a point along its plane's normal, m^2.
        """
        wide = _BLUR_KERNEL**2 * facing
        return jnp.where(self.matched, wide * self.scaled_squared / (wide + self.scaled_squared), 0.0)


def point_noise(
    matches: Matches,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    lidar: BeamParams,
) -> PointNoise:
    """Return the distances of associated points from their planes at a pose, and their noise.

    A point is measured along the normal of its voxel, with the precision
    k = 1 / (s^2 + l0) - 1 / (s^2 + m), where l0 <= l1 are the two smaller variances of the voxel and
    m = max(l0, l1 - b): what is known about the normal in excess of the next direction. A flat voxel acts
    as a plane; a shapeless one does not act at all, and neither does a narrow one, with no class boundaries
    between. Narrow is a scan line that noise or the vehicle's motion has spread to less than the variance b,
    ``Matches.least_variance``. Noise spreads it along the beams, which meet the ground at a small angle.
    Motion moves it over the surface, and the tilt of the strip is the error of the motion: the next scan
    continues it, so that the strip confirms any drift. Where there is nothing else to go by, such planes are
    better than none, and b is zero. The point's own variance s^2 is r^2, that of range and surface, plus that
    of the beam's direction times the squared offset along the surface, which grows with range and grazing
    incidence.
    """
    R, shift = frame.placing(T_world_lidar, points.dtype)
    arm = jnp.where(matches.used[:, None], points, 0.0) @ R.T
    return plane_noise(matches, arm, shift, *point_variances(lidar, points.dtype))


def point_variances(lidar: BeamParams, dtype: jnp.dtype) -> tuple[Array, Array]:
    """Return the variances of a point along its plane's normal (m^2) and of a beam's direction (rad^2)."""
    facing = lidar.range_sigma**2 + lidar.surface_sigma**2
    return facing.astype(dtype), (lidar.angle_sigma**2).astype(dtype)


def plane_noise(matches: Matches, arm: Array, shift: Array, facing: Array, turning: Array) -> PointNoise:
    along = dot3(arm, matches.normal)
    range_squared = dot3(arm, arm)
    across = jnp.maximum(range_squared - along**2, 0.0)
    flat, wide = matches.variances[:, 0], matches.variances[:, 1]
    shaped = jnp.stack([flat, jnp.maximum(flat, wide - matches.least_variance)], -1)
    variances = (facing + turning * across)[:, None] + shaped
    known = 1 / variances
    distance = dot3(matches.normal, arm + shift - matches.mean)
    distance = jnp.where(matches.used, distance, 0.0)
    precision = jnp.where(matches.used, known[:, 0] - known[:, 1], 0.0)
    return PointNoise(
        matched=matches.used,
        arm=arm,
        distance=distance,
        variance=jnp.where(matches.used, variances[:, 0], 1.0),
        precision=precision,
        scaled_squared=facing * precision * distance**2,
    )


def linearise(
    matches: Matches,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    kernel: Float[Array, ""],
    lidar: BeamParams,
    coordinates: Float[Array, "k 5"] | None = None,
) -> NormalEquations:
    """Return the robustly weighted normal equations of associated points at a pose.

    ``coordinates`` are those of the matches, by which the equations have a derivative.

    Robust weight: Geman-McClure on s sqrt(k) n'e, the noise-scaled distance in m of a point at offset e from
    its plane's mean, with precision k and s^2 of range and surface.
    """
    dtype, kind = T_world_lidar.wxyz_xyz.dtype, points.dtype
    noise = point_noise(matches, points, T_world_lidar, frame, lidar)
    weight = noise.weight(kernel.astype(kind))
    arm, distance = noise.arm, noise.distance

    # one matrix product gives every sum over the points: the normal equations from the rows, the rest from
    # the column of ones
    row = jnp.concatenate(
        [
            jnp.cross(arm, matches.normal),
            matches.normal,
            distance[:, None],
            jnp.ones_like(distance)[:, None],
        ],
        -1,
    )
    matched = matches.used.astype(kind)
    facing, turning = point_variances(lidar, kind)
    arm_squared = matched * dot3(arm, arm)
    scalars = [matched, weight, weight * noise.scaled_squared, arm_squared]
    scalars += [noise.blur(facing), _log_or_zero(arm_squared)]
    weighted = jnp.concatenate([(weight * noise.precision)[:, None] * row, jnp.stack(scalars, -1)], -1)
    sums = jax.lax.stop_gradient(row.T @ weighted)
    count, squares = sums[7, 8], sums[:7, :7].astype(dtype)
    squares = squares.at[:6, :6].set((squares[:6, :6] + squares[:6, :6].T) / 2)
    total = point_sums(
        jnp.concatenate([in_order(squares)[:-1], sums[7, 9:].astype(dtype)]),
        _rows,
        points,
        *frame.placing(T_world_lidar, kind),
        jnp.stack([facing, turning, kernel.astype(kind)]),
        coordinates,
        matches,
    )
    weight_sum, squared_error, arm_squared, loss, log_squares = total[27:]
    matched_points = jnp.maximum(count, 1.0).astype(dtype)
    equations = as_matrix(total[:28])[:6]
    return NormalEquations(
        hessian=equations[:, :6],
        gradient=equations[:, 6],
        matches=count.astype(jnp.int32),
        weight=weight_sum,
        squared_error=squared_error,
        arm_squared=arm_squared / matched_points,
        # the geometric mean of the ranges, of which near points change as much as far ones
        blur=loss / matched_points * jnp.exp(-log_squares / matched_points),
    )


def _rows(arm: Array, shift: Array, scales: Array, coordinates: Array | None, matches: Matches) -> Array:
    """Return what each point adds to the sums of :func:`linearise`."""
    facing, turning, kernel = scales
    matches = matches.at(coordinates)
    noise = plane_noise(matches, arm.T, shift, facing, turning)
    weight = noise.weight(kernel)
    columns = [*jnp.cross(noise.arm, matches.normal).T, *matches.normal.T, noise.distance]
    arm_squared = jnp.where(matches.used, dot3(noise.arm, noise.arm), 0.0)
    return jnp.concatenate(
        [
            products(columns, weight * noise.precision)[:-1],
            jnp.stack([weight, weight * noise.scaled_squared, arm_squared]),
            jnp.stack([noise.blur(facing), _log_or_zero(arm_squared)]),
        ]
    )


def _log_or_zero(squares: Float[Array, " k"]) -> Float[Array, " k"]:
    positive = squares > 0
    return jnp.where(positive, jnp.log(jnp.where(positive, squares, 1.0)), 0.0)


_WIDE_SHARE = 1 / 3
"""Share of the matches that stay wide, at least; see :func:`least_variance`."""
_HALVINGS = 3


def least_variance(found: Matches, least: Float[Array, ""]) -> Float[Array, ""]:
    """Return the variance across which a voxel is narrow, m^2: the given one, or less in a sparse map.

    A few beams, or small voxels, leave no voxel as wide as that. Without any plane the first unknown velocity
    stays unknown, and the estimate runs away. The width is halved until it leaves enough matches, and is zero
    if three halvings do not.
    """
    ladder = least * 0.25 ** jnp.arange(_HALVINGS + 1, dtype=least.dtype)
    wide = found.used & (found.variances[:, 1] > ladder[:, None])
    enough = jnp.sum(wide, -1) >= _WIDE_SHARE * jnp.sum(found.used)
    return jnp.max(jnp.where(enough, ladder, 0.0))


class ScanToVoxels(ScanMatch[Array, Matches]):
    """A scan against the planes of a voxel map.

    The kernel starts as wide as the prediction may be wrong and halves with each iteration down to its own
    scale, so that a scan without a velocity prior still finds the map (graduated non-convexity, Blake &
    Zisserman 1987). The solve ends only at the kernel's own scale, so the solution does not depend on the
    number of iterations.
    """

    registration: RobustMatch
    map: VoxelMap
    mask: Bool[Array, " k"]
    """Which points are real."""
    prediction_error: Float[Array, ""]
    """Expected error of the prediction, m."""
    map_params: VoxelMapParams
    lidar: BeamParams
    least_width: Float[Array, ""] | float = 0.0
    """Standard deviation across a voxel below which its points define no plane, m; 0: scan lines count as
    planes. They should not where inertial samples predict the pose. It is less where few voxels are wide."""
    plane_points: Float[Array, ""] | None = None
    """Number of points that a voxel needs to define a plane, where it is more than ``map_params.min_points``.

    Each of the 64 cells of a voxel holds one point, and a straight line along a face crosses four to seven of
    them. Through points on a line goes a plane in any direction, and noise or motion along the beam selects
    the one that contains the beam: a turn of the sensor then seems to be none. Where less than half of the
    points would be matched, ``map_params.min_points`` are enough."""

    def together(self, points: Float[Array, "k 3"]) -> tuple[Float[Array, "k 3"], Bool[Array, " k"]]:
        return points, self.mask

    def unmatched(self) -> Matches:
        return self._by_width(no_matches(self.mask, self.map.moments.dtype))

    def associate(self, points: Float[Array, "k 3"], T_world_lidar: jaxlie.SE3) -> Matches:
        def found(map_params: VoxelMapParams) -> Matches:
            return associate(self.map, points, self.mask, T_world_lidar, self.frame(), map_params)

        if self.plane_points is None:
            return self._by_width(found(self.map_params))
        needed = jnp.maximum(self.map_params.min_points, self.plane_points)
        on_planes = found(replace(self.map_params, min_points=needed))
        enough = 2 * jnp.sum(on_planes.used) >= jnp.sum(self.mask)
        matches = jax.lax.cond(enough, lambda: on_planes, lambda: found(self.map_params))
        return self._by_width(matches)

    def _by_width(self, found: Matches) -> Matches:
        least = jnp.asarray(self.least_width**2, found.variances.dtype)
        return replace(found, least_variance=jax.lax.stop_gradient(least_variance(found, least)))

    def linearise(
        self, T_world_lidar: jaxlie.SE3, found: Matches, iteration: Int32[Array, ""]
    ) -> NormalEquations:
        kernel = jnp.maximum(self.registration.kernel, self.opening(iteration))
        points = self.points_at(T_world_lidar)
        coordinates = found.coordinates_in(self.map)
        return linearise(found, points, T_world_lidar, self.frame(), kernel, self.lidar, coordinates)

    def counted(self, T_world_lidar: jaxlie.SE3, found: Matches) -> Bool[Array, " k"]:
        return found.used

    def settled(self, iteration: Int32[Array, ""]) -> Bool[Array, ""]:
        return self.opening(iteration) <= self.registration.kernel

    def opening(self, iteration: Int32[Array, ""]) -> Float[Array, ""]:
        """Return the least scale of the kernel at an iteration, m."""
        return self.prediction_error * 0.5 ** iteration.astype(self.prediction_error.dtype)

    def frame(self) -> Frame:
        """Return the frame of the matches, near the sensor."""
        return Frame(*anchor_of(self.T_predicted.translation(), self.map_params.voxel_size))
