"""Statistics of matched points' distances from the map, which show the noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.lidar.params import BeamParams
from lio_jax.mapping.frame import Frame
from lio_jax.registration.params import RobustFilterMatch
from lio_jax.registration.point_sums import point_sums
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


_PLANE_DOF = 3
"""A plane through so many points shows none of their noise."""
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
    alone = _UNSHARED / jnp.maximum(matches.count - _PLANE_DOF, 1)
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
