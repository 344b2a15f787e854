"""What matched points tell of the noise: how far they lie from the map, and how thick its planes are."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.params import Params
from lio_jax.registration.scan_to_map import Frame, Matches, point_noise

FACING = 0.5
"""Cosine of incidence from which the scatter about a plane is that of the ranges: at grazing incidence it is
that of the beam's direction and of the map's own error."""
ENOUGH = 6.0
"""Points a voxel needs for its thickness to say anything."""


class PointEvidence(eqx.Module):
    """Sums over the matched points at the solution, robustly weighted."""

    squared_error: Float[Array, ""]
    """Of the distances in units of their noise."""
    log_det: Float[Array, ""]
    """Of the logarithms of the noise's variances, m^2."""
    scale: Float[Array, ""]
    """How many points each counts as, ``registration.information_scale``."""
    thickness: Float[Array, ""]
    """Mean negative log-likelihood of the planes' thicknesses; see :func:`thickness_loss`."""


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
    weight = jax.lax.stop_gradient(noise.weight(kernel, params.lidar.range_sigma.astype(points.dtype)))
    sums = jnp.stack(
        [
            jnp.sum(weight * noise.precision * noise.distance**2),
            jnp.sum(weight * jnp.log(noise.variance)),
            params.registration.information_scale.astype(points.dtype),
            thickness_loss(matches, noise.facing, params),
        ]
    ).astype(T_world_lidar.wxyz_xyz.dtype)
    return PointEvidence(*sums)


def thickness_loss(matches: Matches, facing: Float[Array, " k"], params: Params) -> Float[Array, ""]:
    """Return the mean negative log-likelihood of the thicknesses of the planes that face the sensor.

    About a true plane seen at incidence c, n points scatter with variance s^2 c^2, and n l0 / (s^2 c^2) is
    chi-square of n - 3 degrees of freedom: log(l0 n / (n - 3)) lies about log(s^2 c^2) with variance
    2 / (n - 3). Many voxels hold more than a plane and are thicker; a Cauchy density of that width leaves
    them aside.

    Args:
        matches: of the points; each counts for its voxel.
        facing: cosine of incidence.
        params: ``lidar.range_sigma`` is s.
    """
    some = matches.used & (facing > FACING) & (matches.count >= ENOUGH)
    spare = jnp.where(some, matches.count - 3, 1.0)
    measured = jnp.where(some, matches.variances[:, 0] * matches.count / spare, 1.0)
    expected = (params.lidar.range_sigma.astype(facing.dtype) * jnp.where(some, facing, 1.0)) ** 2
    # the logarithm of a mean of squares is low by about 1 / dof
    off = jnp.log(jnp.maximum(measured, 1e-10)) - jnp.log(expected) + 1 / spare
    loss = jnp.log1p(off**2 * spare / 2) - jnp.log(spare) / 2
    return jnp.sum(jnp.where(some, loss, 0.0)) / jnp.maximum(jnp.sum(some), 1)
