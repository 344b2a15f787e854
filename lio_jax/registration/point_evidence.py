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


def point_evidence(
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
    sums = point_sums(
        jax.lax.stop_gradient(jnp.sum(_weighted(noise, weight), -1)),
        _rows,
        points,
        *frame.placing(T_world_lidar, kind),
        jnp.stack(point_variances(lidar, kind)),
        coordinates,
        (matches, weight),
    ).astype(dtype)
    squared_error, log_det = sums
    return PointEvidence(squared_error, log_det, registration.information_scale.astype(dtype))


def _rows(
    arm: Array, shift: Array, scales: Array, coordinates: Array | None, constants: tuple[Matches, Array]
) -> Array:
    matches, weight = constants
    return _weighted(plane_noise(matches.at(coordinates), arm.T, shift, *scales), weight)


def _weighted(noise: PointNoise, weight: Array) -> Array:
    return weight * jnp.stack([noise.precision * noise.distance**2, jnp.log(noise.variance)])
