"""Statistics of matched points' distances from the map, which show the noise, and what the noise of the map's
planes alone seems to tell of the pose."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.lidar.params import BeamParams
from lio_jax.mapping.frame import Frame
from lio_jax.mapping.voxel_map import PLANE_DOF, VoxelMap, mean_and_covariance
from lio_jax.registration.params import RobustFilterMatch
from lio_jax.registration.point_sums import point_sums
from lio_jax.registration.scan_match import NormalEquations
from lio_jax.registration.voxel_planes import Matches, PointNoise, plane_noise, point_noise, point_variances


class PointEvidence(eqx.Module):
    """Sums over the matched points at the solution, robustly weighted."""

    squared_error: Float[Array, ""]
    """Weighted sum of the squared distances in units of their noise."""
    log_det: Float[Array, ""]
    """Weighted sum of the logarithms of the noise's variances (m^2)."""
    scale: Float[Array, ""]
    """Factor of each point's information, ``registration.information_scale``."""
    plane_share: Float[Array, ""]
    """Variance of the pose by the planes' errors, as a share of its variance by the scan's own noise."""


_EVERY = 4
"""One of so many points is enough for a mean over all."""
_UNSHARED = 2
"""Number of a plane's three coordinates whose error a scan line across it does not average out: its offset,
and its tilt across the line."""


def point_evidence(
    slots: int,
    matches: Matches,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    lidar: BeamParams,
    registration: RobustFilterMatch,
    coordinates: Float[Array, "k 5"] | None = None,
) -> PointEvidence:
    """Return the statistics of the matched points at a pose, with the weights of the solve.

    Args:
        slots: size of the map's table.
        matches: matches of the points.
        points: m, lidar frame.
        T_world_lidar: the solution.
        frame: of the matches.
        lidar: the noise of ranges and directions.
        registration: the kernel, and how many points each counts as.
        coordinates: of the matches, by which the statistics have a derivative.
    """
    kind, dtype = points.dtype, T_world_lidar.wxyz_xyz.dtype
    noise = point_noise(matches, points, T_world_lidar, frame, lidar)
    # as in iteratively reweighted least squares, the weights are no part of the derivative
    weight = jax.lax.stop_gradient(noise.weight(registration.kernel.astype(kind)))
    each = weight, jax.lax.stop_gradient(_shared(slots, matches, kind))
    sums = point_sums(
        jax.lax.stop_gradient(jnp.sum(_each(noise, matches, *each), -1)),
        _rows,
        points,
        *frame.placing(T_world_lidar, kind),
        jnp.stack(point_variances(lidar, kind)),
        coordinates,
        (matches, *each),
    ).astype(dtype)
    squared_error, log_det, plane_share = sums
    return PointEvidence(squared_error, log_det, registration.information_scale.astype(dtype), plane_share)


def plane_share(
    slots: int,
    matches: Matches,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    lidar: BeamParams,
) -> Float[Array, ""]:
    """Return ``PointEvidence.plane_share`` alone, by some of the points and without a derivative.

    A plane through n points with the variance l0 along its normal is off by the variance 2 l0 / (n - 3) where
    a scan line crosses it, and all points of the scan in its voxel share that error. For the sum of m of them
    it counts m^2 times, and their own variances v count m times: the plane's share is 2 m l0 / ((n - 3) v).
    The mean over all points stands for every direction of the pose.

    Args: as for :func:`point_evidence`.
    """
    settings = matches, points, T_world_lidar, lidar
    matches, points, T_world_lidar, lidar = jax.lax.stop_gradient(settings)
    matches, points = jax.tree.map(lambda rows: rows[::_EVERY] if rows.ndim else rows, (matches, points))
    shared = _shared(slots, matches, points.dtype, _EVERY)
    noise = point_noise(matches, points, T_world_lidar, frame, lidar)
    return jnp.sum(shared * matches.variances[:, 0] / noise.variance).astype(T_world_lidar.wxyz_xyz.dtype)


def _shared(slots: int, matches: Matches, kind: jnp.dtype, every: int = 1) -> Float[Array, " k"]:
    """Return 2 m / (n - 3) of each point's voxel, divided by the number of matched points.

    Args:
        slots: size of the map's table.
        matches: of the points, or of one of so many.
        kind: dtype of the result.
        every: the number of points for which one stands; each of the others in its voxel counts as so many.
    """
    others = every * (matches.in_same_voxel(slots) - 1)
    together = jnp.where(matches.used, 1 + others, 0).astype(kind)
    alone = _UNSHARED / jnp.maximum(matches.count - PLANE_DOF, 1)
    return together * alone / jnp.maximum(jnp.sum(matches.used), 1)


def _rows(
    arm: Array,
    shift: Array,
    scales: Array,
    coordinates: Array | None,
    constants: tuple[Matches, Array, Array],
) -> Array:
    matches, weight, shared = constants
    matches = matches.at(coordinates)
    return _each(plane_noise(matches, arm.T, shift, *scales), matches, weight, shared)


def _each(noise: PointNoise, matches: Matches, weight: Array, shared: Array) -> Array:
    by_point = [noise.precision * noise.distance**2, jnp.log(noise.variance)]
    return jnp.stack(
        [*(weight * value for value in by_point), shared * matches.variances[:, 0] / noise.variance]
    )


_LEAST = 1e-9
"""Least variance along a plane, m^2."""
_MOTION = 0.5
"""Share of the square of a direction that is a translation, from which it is a motion rather than a turn."""
_BY_NOISE = 2.0
"""Information, over that expected by noise alone, up to which noise may have given all of it: less than half
of it would be the motion's. What the noise of m planes gives has the relative standard deviation sqrt(2 / m),
so that for 18 planes twice is three standard deviations above the expectation."""


def shown_by_noise(
    vmap: VoxelMap,
    matches: Matches,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    lidar: BeamParams,
    kernel: Float[Array, ""],
    equations: NormalEquations,
) -> Float[Array, "6 3"]:
    """Return the directions of motion of which noise alone may have given all information.

    The normal n + e of a plane through noisy points is tilted by an error e. A matched point of precision k
    adds the information k (n + e)(n + e)' on the sensor's position. The expectation is k n n' + k T, with the
    covariance T of e. So the height between smooth walls seems to be shown, although no plane shows it. What
    the tilts say of it does not depend on the motion (errors in the variables: Fuller, "Measurement error
    models", 1987, section 1.1).

    The directions are the principal ones of the information, weakest first, as
    :func:`lio_jax.estimation.pose_measurement.keep_observed` finds them, and of these the ones that are
    motions rather than turns. The result has no derivative.

    Args:
        vmap: the map.
        matches: matches of the points.
        points: m, lidar frame.
        T_world_lidar: the solution.
        frame: of the matches.
        lidar: the noise of ranges and directions.
        kernel: of the match, m.
        equations: of the matches at the solution.

    Returns:
        A row for each direction of the pose: the motion in world axes, or zeros. With the turn, times the
        root mean square range of the points, it would have unit length.
    """
    given = vmap.moments, matches, points, T_world_lidar, lidar, kernel, equations
    moments, matches, points, T_world_lidar, lidar, kernel, equations = jax.lax.stop_gradient(given)
    some, points = jax.tree.map(lambda rows: rows[::_EVERY] if rows.ndim else rows, (matches, points))
    noise = point_noise(some, points, T_world_lidar, frame, lidar)
    weight = _EVERY * noise.weight(kernel.astype(points.dtype)) * noise.precision
    _, diagonal, off_diagonal = mean_and_covariance(moments.at[some.slot].get(mode="promise_in_bounds"))
    least, _ = point_variances(lidar, points.dtype)
    tilts = tilt_covariance(some.variances, some.count, diagonal, off_diagonal, least)
    expected = information_by_tilts(weight, some.normal, tilts).astype(equations.hessian.dtype)
    turn = jax.lax.rsqrt(equations.arm_squared + 1e-6)
    scale = jnp.concatenate([jnp.full(3, turn), jnp.ones(3, turn.dtype)])
    values, vectors = jnp.linalg.eigh(scale[:, None] * equations.hessian * scale)
    motions = vectors[3:].T
    by_noise = jnp.sum((motions @ expected) * motions, 1)
    found = (values <= _BY_NOISE * by_noise) & (jnp.sum(motions**2, 1) > _MOTION) & (by_noise > 0)
    return jnp.where(found[:, None], motions, 0.0)


def information_by_tilts(
    weight: Float[Array, " k"], normal: Float[Array, "k 3"], tilts: tuple[Array, Array, Array]
) -> Float[Array, "3 3"]:
    """Return the expected information on the sensor's position by the errors of the normals alone, 1/m^2.

    Args:
        weight: with which each squared distance counts, 1/m^2.
        normal: unit normals.
        tilts: their errors' covariance T, as :func:`tilt_covariance` returns it.
    """
    axial, diagonal, off_diagonal = tilts
    x, y, z = normal.T
    squares = jnp.stack([x * x, y * y, z * z, x * y, x * z, y * z])
    rest = jnp.concatenate([diagonal, off_diagonal], -1)
    sums = squares @ (weight * axial) + weight @ rest
    return sums[jnp.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])]


def tilt_covariance(
    variances: Float[Array, "k 2"],
    count: Float[Array, " k"],
    diagonal: Float[Array, "k 3"],
    off_diagonal: Float[Array, "k 3"],
    noise: Float[Array, ""],
) -> tuple[Array, Array, Array]:
    """Return the covariance T of the error of each normal n: a, D and O with T = a n n' + D + O.

    With the variances l0 <= l1 <= l2 of n points, the plane is tilted along its axis j by the variance
    l0 / ((n - 3) (lj - l0)), to first order in the noise. No more than the whole normal can be wrong.

    Args:
        variances: l0 and l1, m^2.
        count: number of points n.
        diagonal: of the points' covariance C, m^2.
        off_diagonal: its entries xy, xz and yz, m^2.
        noise: least variance of a point across its plane, m^2: few points may lie on their plane by chance.

    Returns:
        a (k,), the diagonal of D + O (k, 3), and its entries xy, xz and yz (k, 3).
    """
    flat, wide = variances.T
    longest = jnp.sum(diagonal, -1) - flat - wide
    first, second = jnp.maximum(wide - flat, _LEAST), jnp.maximum(longest - flat, _LEAST)
    of_mean = jnp.maximum(flat / jnp.maximum(count - PLANE_DOF, 1), noise / jnp.maximum(count, 1))
    # C - l0 I is zero along the normal; within the plane its inverse follows by Cayley and Hamilton
    both = first + second
    scale = of_mean / (first * second + of_mean * both)
    return -scale * both, scale[:, None] * ((both + flat)[:, None] - diagonal), -scale[:, None] * off_diagonal
