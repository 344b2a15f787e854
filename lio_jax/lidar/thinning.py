"""What of a scan goes into the map, and what of that is matched."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.params import Params
from lio_jax.core.types import Scan
from lio_jax.lidar.downsample import Selection, select_per_voxel


class ThinnedScan(eqx.Module):
    """A scan's points for the map, and which of them are matched against it."""

    points: Float[Array, "m 3"]
    """m, lidar frame at each point's own firing time."""
    time: Float[Array, " m"]
    """Firing time from the scan's start, s."""
    mask: Bool[Array, " m"]
    matched: Selection
    """Rows of the above."""
    dropped: Int32[Array, ""]
    """Occupied cells beyond the capacities."""


def thinned(
    params: Params,
    scan: Scan,
    registration_spacing: Float[Array, ""],
    insertion_points: int,
    registration_points: int,
) -> ThinnedScan:
    """Return the scan within its range limits, thinned to the spacings of map and registration.

    Args:
        params: range limits and the map's spacing.
        scan: padded sweep.
        registration_spacing: of the points to match, m.
        insertion_points: capacity for the map.
        registration_points: capacity of those to match.
    """
    squared_range = jnp.sum(scan.points**2, -1)
    near, far = params.lidar.min_range.astype(jnp.float32), params.lidar.max_range.astype(jnp.float32)
    mask = scan.mask & (squared_range > near**2) & (squared_range < far**2)
    chosen = select_per_voxel(scan.points, mask, params.map.point_spacing, insertion_points)
    # what is not finite in an empty row would spoil the derivatives of sums that leave it out
    points = jnp.where(chosen.mask[:, None], scan.points[chosen.index], 0.0)
    matched = select_per_voxel(points, chosen.mask, registration_spacing, registration_points)
    return ThinnedScan(
        points, scan.time[chosen.index], chosen.mask, matched, chosen.dropped + matched.dropped
    )
