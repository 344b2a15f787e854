"""Range residuals of a scan against planes through neighbouring returns: the range noise, without a map."""

from collections.abc import Iterable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float
from scipy.optimize import brentq

from lio_jax.core.types import Scan
from lio_jax.lidar.params import BeamParams, LidarParams

_APART = (1e-5, 0.025)
"""Smallest and largest angle between neighbours of a ring, rad. Closer returns belong to one pulse; between
farther ones a return is missing."""
_STEEPEST = 0.866
"""Largest sine of the angle of incidence: at grazing incidence the residuals are those of the beams'
directions."""


class RangeScatter(eqx.Module):
    """Residuals of returns against the plane through their two neighbours; each return is used once."""

    deviation: Float[Array, " t"]
    """Measured range less the range of that plane, m."""
    spread: Float[Array, " t"]
    """Standard deviation of ``deviation``, m, for range noise of 1 m on each of the three returns."""
    slope: Float[Array, " t"]
    """Standard deviation of ``deviation``, m, for noise of 1 rad on the beams' directions; it has a sign."""
    valid: Bool[Array, " t"]
    """True where all three returns are usable neighbours."""


def range_scatter(scan: Scan, lidar: LidarParams) -> RangeScatter:
    """Return the range residuals of every third return of each ring.

    On a plane the inverse range is linear in the beam's direction, so the ranges of two neighbours predict
    the range between them. Edges between the three returns make outliers.

    Args:
        scan: padded sweep; the returns of each ring are in the order in which they were taken.
        lidar: ``min_range`` and ``max_range`` bound the returns that count.
    """
    distance = jnp.linalg.norm(scan.points, axis=-1)
    usable = scan.mask & (distance > lidar.min_range) & (distance < lidar.max_range)
    ring = jnp.where(usable, scan.ring, jnp.iinfo(scan.ring.dtype).max)
    order = jnp.argsort(ring, stable=True)
    order = order[: 3 * (order.shape[0] // 3)].reshape(-1, 3)
    (first, middle, last), ranges = jnp.moveaxis(scan.points[order], 1, 0), distance[order]
    near, here, far = (jnp.where(usable[order[:, k]], ranges[:, k], 1.0) for k in range(3))
    before = _angle(first / near[:, None], middle / here[:, None])
    after = _angle(middle / here[:, None], last / far[:, None])
    both = jnp.sin(before + after)
    own = jnp.where(both > 0, both, 1.0)
    # the middle direction is a linear combination of the outer ones
    share_near, share_far = jnp.sin(after) / own, jnp.sin(before) / own
    inverse = share_near / near + share_far / far
    foretold = 1 / jnp.where(inverse > 0, inverse, 1.0)
    by_near, by_far = share_near * (foretold / near) ** 2, share_far * (foretold / far) ** 2
    spread = jnp.sqrt(1 + by_near**2 + by_far**2)
    along = far - near
    sine = jnp.abs(along) / jnp.maximum(jnp.linalg.norm(last - first, axis=-1), 1e-6)
    together = jnp.all(usable[order], -1) & (scan.ring[order[:, 0]] == scan.ring[order[:, 2]])
    apart = [(angle > _APART[0]) & (angle < _APART[1]) for angle in (before, after)]
    valid = together & apart[0] & apart[1] & (sine < _STEEPEST)
    return RangeScatter(
        deviation=jnp.where(valid, here - foretold, 0.0),
        spread=jnp.where(valid, spread, 1.0),
        slope=jnp.where(valid, spread * along / jnp.where(valid, before + after, 1.0), 0.0),
        valid=valid,
    )


def _angle(one: Float[Array, "t 3"], other: Float[Array, "t 3"]) -> Float[Array, " t"]:
    """Return the angles between unit vectors, rad; from the chord, which is precise for small angles."""
    return 2 * jnp.arcsin(jnp.minimum(jnp.linalg.norm(one - other, axis=-1) / 2, 1.0))


_MEDIAN_OF_NORMAL = 0.6745
"""Median of the absolute value of a standard normal variable."""
_LEAST_SIGMA, _LARGEST_SIGMA = 1e-4, 1.0
"""Interval of a range's standard deviation, m."""


def scattered_range_noise(scans: Iterable[Scan], lidar: LidarParams, fewest: int) -> float | None:
    """Return the standard deviation of a range by the median of the scatter of neighbouring returns, m.

    The median does not follow edges between neighbours, unless they are as many as the planes.

    Args:
        scans: padded sweeps; the first ones that together have ``fewest`` residuals are read, no more.
        lidar: bounds of the ranges, and the noise of the beams' directions where it is known.
        fewest: number of residuals below which nothing is said.

    Returns:
        the noise; None for too few residuals.
    """
    found: list[RangeScatter] = []
    for scan in scans:
        found.append(jax.device_get(_scatter_of(scan, lidar)))
        if sum(int(one.valid.sum()) for one in found) >= fewest:
            break
    else:
        return None
    parts = [[getattr(one, name)[one.valid] for one in found] for name in ("deviation", "spread", "slope")]
    deviation, spread, slope = (np.concatenate(part).astype(np.float64) for part in parts)
    angle = float(lidar.angle_sigma) if isinstance(lidar, BeamParams) else 0.0

    def excess(sigma: float) -> float:
        variance = (sigma * spread) ** 2 + (angle * slope) ** 2
        return float(np.median(np.abs(deviation) / np.sqrt(variance))) - _MEDIAN_OF_NORMAL

    if excess(_LEAST_SIGMA) <= 0 or excess(_LARGEST_SIGMA) >= 0:
        return None
    return float(brentq(excess, _LEAST_SIGMA, _LARGEST_SIGMA, xtol=1e-5))


_scatter_of = jax.jit(range_scatter)
