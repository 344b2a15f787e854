"""A scan as an image: each column of the array holds the points of one ring, without gaps.

In an array of shape (k, rings) the neighbours along a ring are one row apart, so a window along all rings is
a sum of whole, contiguous rows.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float32, Int32

from lio_jax.core.prefix_sum import counts_before
from lio_jax.core.types import Scan
from lio_jax.lidar.params import LidarParams, RingConfig


class RangeImage(eqx.Module):
    """Which point of a scan lies at each place of each ring; a ring's points are 0 .. count-1."""

    index: Int32[Array, "k rings"]
    """Index of the point in the scan; 0 beyond a ring's count."""
    column: Int32[Array, "k rings"]
    """Column of the sweep by azimuth; with ``order="arrival"`` the place along the ring."""
    count: Int32[Array, " rings"]
    """Number of points of each ring."""
    dropped: Int32[Array, ""]
    """Number of points beyond the capacity: those of rings above the configured number, and those by which
    rings that are too long were thinned evenly."""

    @property
    def mask(self) -> Bool[Array, "k rings"]:
        """Return True where there is a point."""
        return jnp.arange(self.index.shape[0], dtype=jnp.int32)[:, None] < self.count


def range_image(config: RingConfig, lidar: LidarParams, scan: Scan) -> RangeImage:
    """Sort a scan's points into rings.

    With ``order="azimuth"`` (LIO-SAM) a column keeps the first point that falls into it, and later points are
    left out. Columns count counter-clockwise from straight behind. With ``order="arrival"`` (A-LOAM, and
    LIO-SAM for the lines of a Livox) all points are kept in the order of the scan.

    Args:
        config: numbers of rings and columns, and the order.
        params: ``lidar.min_range`` and ``lidar.max_range`` bound the points that count.
        scan: padded sweep. Points that are not finite are left out.
    """
    x, y, z = (scan.points[:, axis] for axis in range(3))
    squared_range = x**2 + y**2 + z**2
    near, far = lidar.min_range.astype(jnp.float32), lidar.max_range.astype(jnp.float32)
    wanted = scan.mask & (squared_range > near**2) & (squared_range < far**2)
    wanted &= scan.ring >= 0
    if config.ring_step > 1:
        wanted &= scan.ring % config.ring_step == 0
    place = wanted & (scan.ring < config.rings)
    missed = jnp.sum(wanted & ~place, dtype=jnp.int32)
    if config.order == "azimuth":
        return _by_azimuth(config, scan, place, missed)
    return _by_arrival(config, scan, place, missed)


def _by_azimuth(
    config: RingConfig, scan: Scan, place: Bool[Array, " n"], missed: Int32[Array, ""]
) -> RangeImage:
    rings, columns, n = config.rings, config.columns, scan.ring.shape[0]
    cell = azimuth_column(scan.points, columns) * rings + scan.ring
    order = jnp.arange(n, dtype=jnp.int32)
    cell = jnp.where(place, cell, columns * rings)
    first = jnp.full(columns * rings, n, jnp.int32).at[cell].min(order, mode="drop").reshape(columns, rings)
    taken = first < n
    before, count = counts_before(taken.astype(jnp.int32))
    ring = jnp.arange(rings, dtype=jnp.int32)
    target = jnp.where(taken, before * rings + ring, columns * rings).ravel()
    return RangeImage(
        index=_scattered(target, first.ravel(), config),
        column=_scattered(target, jnp.arange(columns * rings, dtype=jnp.int32) // rings, config),
        count=count,
        dropped=missed,
    )


def _by_arrival(
    config: RingConfig, scan: Scan, place: Bool[Array, " n"], missed: Int32[Array, ""]
) -> RangeImage:
    rings, columns = config.rings, config.columns
    rank, count = rank_within_ring(scan.ring, place, rings)
    share = jnp.minimum(columns / jnp.maximum(count, 1).astype(jnp.float32), 1.0)
    at = jnp.floor(rank * share.at[scan.ring].get(mode="clip")).astype(jnp.int32)
    target = jnp.where(place, at * rings + scan.ring, columns * rings)
    shape = (columns, rings)
    return RangeImage(
        index=_scattered(target, jnp.arange(scan.ring.shape[0], dtype=jnp.int32), config),
        column=jnp.broadcast_to(jnp.arange(columns, dtype=jnp.int32)[:, None], shape),
        count=jnp.minimum(count, columns),
        dropped=missed + jnp.sum(jnp.maximum(count - columns, 0), dtype=jnp.int32),
    )


def _scattered(
    target: Int32[Array, " n"], values: Int32[Array, " n"], config: RingConfig
) -> Int32[Array, "k rings"]:
    flat = jnp.zeros(config.columns * config.rings, jnp.int32).at[target].set(values, mode="drop")
    return flat.reshape(config.columns, config.rings)


_LANES = 32


def rank_within_ring(
    ring: Int32[Array, " n"], mask: Bool[Array, " n"], rings: int
) -> tuple[Int32[Array, " n"], Int32[Array, " rings"]]:
    """Return the number of earlier points in each point's ring, and the number of points in each ring.

    Each run of 32 points has a bit mask per ring. The numbers of bits are summed over the runs before, and
    the lower bits of the run's own mask are the earlier points of the same run. So no sort is needed.

    Args:
        ring: 0 .. rings-1 where the mask is true.
        mask: which points count.
        rings: number of rings.
    """
    n = ring.shape[0]
    runs = -(-n // _LANES)
    order = jnp.arange(n, dtype=jnp.int32)
    bit = jnp.uint32(1) << (order % _LANES).astype(jnp.uint32)
    cell = jnp.where(mask, order // _LANES * rings + ring, runs * rings)
    members = jnp.zeros(runs * rings, jnp.uint32).at[cell].add(bit, mode="drop")
    before, count = counts_before(_bits(members).reshape(runs, rings))
    earlier = members.at[cell].get(mode="clip") & (bit - 1)
    return before.ravel().at[cell].get(mode="clip") + _bits(earlier), count


def _bits(words: Array) -> Array:
    return jax.lax.population_count(words).astype(jnp.int32)


def azimuth_column(points: Float32[Array, "n 3"], columns: int) -> Int32[Array, " n"]:
    """Return the column of each point, counter-clockwise from straight behind.

    A point straight ahead lies in the middle of column ``columns / 2``, as in LIO-SAM.

    Args:
        points: m, lidar frame.
        columns: number of columns of a full turn.
    """
    turn = azimuth(points[:, 0], points[:, 1]) * jnp.float32(columns / (2 * np.pi))
    column = jnp.floor(turn + jnp.float32(0.5)).astype(jnp.int32) + columns // 2
    return jnp.where(column >= columns, column - columns, column)


_ARCTAN = (
    0.0028662257,
    -0.0161657367,
    0.0429096138,
    -0.0752896400,
    0.1065626393,
    -0.1420889944,
    0.1999355085,
    -0.3333314528,
    1.0,
)
"""Coefficients of arctan(x) / x in powers of x^2, highest first, with an error of 2e-8 on [0, 1].

Source: Abramowitz & Stegun, Handbook of Mathematical Functions, 4.4.49."""


def azimuth(x: Float32[Array, "*n"], y: Float32[Array, "*n"]) -> Float32[Array, "*n"]:
    """Return atan2(y, x), rad, with float32's precision.

    On a CPU ``jnp.arctan2`` calls a scalar routine for each point, which is slower.
    """
    across, along = jnp.abs(y), jnp.abs(x)
    ratio = jnp.minimum(across, along) / jnp.maximum(jnp.maximum(across, along), jnp.float32(1e-30))
    squared, series = ratio * ratio, jnp.zeros_like(ratio)
    for factor in _ARCTAN:
        series = series * squared + jnp.float32(factor)
    angle = series * ratio
    angle = jnp.where(across > along, jnp.float32(np.pi / 2) - angle, angle)
    angle = jnp.where(x < 0, jnp.float32(np.pi) - angle, angle)
    return jnp.where(y < 0, -angle, angle)
