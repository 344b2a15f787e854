"""All points of a scan in the world: compensated and placed once the scan's pose is known.

A recipe compensates only the points that it matches or adds to the map. This compensates the others in the
same way, after the step and apart from its program.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Float32

from lio_jax.core.geometry import dot3, rotation_matrix
from lio_jax.core.types import ImuBatch, NavState, Scan
from lio_jax.imu.path import deskew_along
from lio_jax.imu.strapdown import path_along
from lio_jax.lidar.deskew import deskew_constant_velocity
from lio_jax.recipes.params import RecipeParams


class Leg(eqx.Module):
    """The states between which the motion within a sweep is known: those at its own end and at one before."""

    start: NavState
    end: NavState
    interval: Float[Array, ""]
    """Time between the two, s; 0 where only one scan has a pose."""
    first: Bool[Array, ""]
    """The sweep ends at ``start`` instead: no scan before it had a pose, and the next one shows the turn."""


def placed_scan(
    compensates: bool,
    params: RecipeParams,
    nav: NavState,
    T_matched: jaxlie.SE3,
    leg: Leg,
    scan: Scan,
    imu: ImuBatch | None,
) -> tuple[Float32[Array, "n 3"], Bool[Array, " n"]]:
    """Return all points of a scan, m in world, and which of them are finite and within the range limits.

    With inertial samples, the motion within the sweep is that from the last scan's state along the samples,
    seen from the sweep's end, and the end lies at the scan's own pose: FAST-LIO2's backward propagation.
    Without samples, the velocity is that of the state and the angular rate the mean one since the last scan.

    Args:
        compensates: whether the motion within the sweep is compensated; static.
        params: of the recipe, for the range limits and the corrections of the points.
        nav: state at the scan's end.
        T_matched: T_world_lidar of the scan match, where points without compensation lie.
        leg: from the last scan to this one.
        scan: padded sweep, its coordinates as they were recorded.
        imu: samples that cover the scan; None: there are none.
    """
    squared_range = dot3(scan.points, scan.points)
    near, far = params.lidar.min_range.astype(jnp.float32), params.lidar.max_range.astype(jnp.float32)
    mask = scan.mask & (squared_range > near**2) & (squared_range < far**2)
    points = params.lidar.corrected(jnp.where(mask[:, None], scan.points, 0.0), scan.ring)
    if compensates:
        points = _at_the_end(points, nav, leg, scan, imu)
    T_world_lidar = nav.T_world_imu @ nav.T_imu_lidar if compensates else T_matched
    turned = points @ rotation_matrix(T_world_lidar.rotation()).astype(points.dtype).T
    world = turned.astype(nav.velocity.dtype) + T_world_lidar.translation()
    return world.astype(jnp.float32), mask & jnp.all(jnp.isfinite(world), -1)


def _at_the_end(
    points: Float[Array, "n 3"], nav: NavState, leg: Leg, scan: Scan, imu: ImuBatch | None
) -> Float[Array, "n 3"]:
    """Return points in the lidar frame of the scan's end, m; arguments as of :func:`placed_scan`."""
    dtype = nav.velocity.dtype
    end, interval = scan.duration.astype(dtype), leg.interval.astype(dtype)
    if imu is not None:
        path = path_along(leg.start, imu, jnp.where(leg.first, 0.0, end - interval), end)
        return deskew_along(path, nav.T_imu_lidar, points, scan.time)
    known = interval > 0
    turn = (leg.start.T_world_imu.rotation().inverse() @ leg.end.T_world_imu.rotation()).log()
    rate = jnp.where(known, turn / jnp.where(known, interval, 1.0), 0.0)
    velocity = nav.T_world_imu.rotation().inverse() @ nav.velocity
    twist = nav.T_imu_lidar.inverse().adjoint() @ jnp.concatenate([velocity, rate])
    return deskew_constant_velocity(points, scan.time - scan.duration, twist)
