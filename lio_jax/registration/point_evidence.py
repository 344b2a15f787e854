"""What matched points tell of the noise: how far they lie from the map."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.params import Params
from lio_jax.registration.scan_to_map import Frame, Matches, point_noise


class PointEvidence(eqx.Module):
    """Sums over the matched points at the solution, robustly weighted."""

    squared_error: Float[Array, ""]
    """Of the distances in units of their noise."""
    log_det: Float[Array, ""]
    """Of the logarithms of the noise's variances, m^2."""
    scale: Float[Array, ""]
    """How many points each counts as, ``registration.information_scale``."""


def point_evidence(
    matches: Matches,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    params: Params,
) -> PointEvidence:
    """Return what the matched points tell at a pose, weighted as they were in the solve.

    Args:
        matches: of the points.
        points: m, lidar frame.
        T_world_lidar: the solution.
        frame: of the matches.
        params: traced.
    """
    noise = point_noise(matches, points, T_world_lidar, frame, params)
    kernel = params.registration.kernel.astype(points.dtype)
    # as in iteratively reweighted least squares, the weights are no part of the derivative
    weight = jax.lax.stop_gradient(noise.weight(kernel))
    sums = jnp.stack(
        [
            jnp.sum(weight * noise.precision * noise.distance**2),
            jnp.sum(weight * jnp.log(noise.variance)),
            params.registration.information_scale.astype(points.dtype),
        ]
    ).astype(T_world_lidar.wxyz_xyz.dtype)
    return PointEvidence(*sums)
