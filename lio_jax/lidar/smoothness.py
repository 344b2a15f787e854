"""The curvature of a ring at each of its points, and the points that are unreliable as features.

Arrays of shape (k, rings) are those of :class:`~lio_jax.lidar.range_image.RangeImage`. Near a ring's ends and
beyond its points the values have no meaning; the selection does not use them.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float32, Int32, Shaped

from lio_jax.core.xla import computed_once


def point_smoothness(
    points: tuple[Float32[Array, "k rings"], ...], neighbours: int
) -> Float32[Array, "k rings"]:
    """Return the squared length of the sum of differences to the neighbours along the ring, m^2.

    The value is |sum over j of (p_j - p_i)|^2, over ``neighbours`` points before and as many after. It is the
    curvature of A-LOAM, and that of Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014,
    eq. (1), without the normalisation.

    Args:
        points: coordinates x, y and z, m.
        neighbours: number of neighbours on either side.
    """
    total = jnp.zeros_like(points[0])
    for axis in points:
        total += _bend(axis, neighbours) ** 2
    return total


def range_smoothness(ranges: Float32[Array, "k rings"], neighbours: int) -> Float32[Array, "k rings"]:
    """Return the squared sum of range differences to the neighbours along the ring, m^2 (LIO-SAM).

    Args:
        ranges: m.
        neighbours: number of neighbours on either side.
    """
    return _bend(ranges, neighbours) ** 2


def occluded(
    ranges: Float32[Array, "k rings"],
    column: Int32[Array, "k rings"],
    mask: Bool[Array, "k rings"],
    *,
    step: Float32[Array, ""],
    columns_apart: Float32[Array, ""],
    neighbours: int,
) -> Bool[Array, "k rings"]:
    """Return which points are behind an edge that hides the rest of their surface from the sensor (LIO-SAM).

    If two consecutive points are fewer than ``columns_apart`` columns apart and their ranges differ by more
    than ``step``, the farther one and ``neighbours`` more points on its side are occluded.

    Args:
        ranges: m.
        column: column of the sweep that each point lies in.
        mask: which rows are points.
        step: least difference of the ranges at an edge, m.
        columns_apart: distance of the two points, columns.
        neighbours: number of further points on the side of the farther one.
    """
    close = mask & after_each(mask)
    close &= jnp.abs(after_each(column) - column).astype(jnp.float32) < columns_apart
    further = after_each(ranges) - ranges
    hides_before, hides_after = close & (-further > step), close & (further > step)
    edges = hides_before.astype(jnp.int8) + 2 * hides_after.astype(jnp.int8)
    framed = computed_once(_framed(edges, neighbours + 1))
    hidden = jnp.zeros_like(mask)
    for by in range(neighbours + 1):
        hidden |= _window(framed, by, neighbours + 1) == 1
        hidden |= _window(framed, -by - 1, neighbours + 1) == 2
    return hidden


def parallel_to_beam(ranges: Float32[Array, "k rings"], ratio: Float32[Array, ""]) -> Bool[Array, "k rings"]:
    """Return which points differ in range from both neighbours by more than a share of their range (LIO-SAM).

    Args:
        ranges: m.
        ratio: the share, no unit.
    """
    framed = _framed(ranges, 1)
    limit = ratio * ranges
    before, after = (jnp.abs(_window(framed, by, 1) - ranges) > limit for by in (-1, 1))
    return before & after


def reach(
    connected: Bool[Array, "k rings"], neighbours: int
) -> tuple[Int32[Array, "k rings"], Int32[Array, "k rings"]]:
    """Return the numbers of points before and after a pick that it suppresses, for a pick at each place.

    Args:
        connected: whether suppression passes from a point to the next one.
        neighbours: largest number on either side.
    """
    passes = computed_once(_framed(connected, neighbours))
    before, after = jnp.zeros(connected.shape, jnp.int32), jnp.zeros(connected.shape, jnp.int32)
    for step in reversed(range(neighbours)):
        after = jnp.where(_window(passes, step, neighbours), after + 1, 0)
        before = jnp.where(_window(passes, -step - 1, neighbours), before + 1, 0)
    return before, after


def after_each(values: Shaped[Array, "k rings"]) -> Shaped[Array, "k rings"]:
    """Return the value of the next point along the ring; zero for the last row."""
    return jnp.concatenate([values[1:], jnp.zeros_like(values[:1])])


def _bend(values: Float32[Array, "k rings"], neighbours: int) -> Float32[Array, "k rings"]:
    """Return the sum of the differences to the neighbours, which loses fewer digits than sum - 2 n v."""
    inner = values[neighbours:-neighbours]
    total = jnp.zeros_like(inner)
    for step in range(1, neighbours + 1):
        later, earlier = _window(values, step, neighbours), _window(values, -step, neighbours)
        total += (later - inner) + (earlier - inner)
    return _framed(total, neighbours)


def _framed(values: Shaped[Array, "k rings"], margin: int) -> Shaped[Array, "f rings"]:
    """Return the values with ``margin`` rows of zeros before and after: windows then need no bounds test."""
    return jnp.pad(values, ((margin, margin), (0, 0)))


def _window(framed: Shaped[Array, "f rings"], by: int, margin: int) -> Shaped[Array, "k rings"]:
    """Return the values ``by`` places further along each ring."""
    return jax.lax.slice_in_dim(framed, margin + by, framed.shape[0] - margin + by, axis=0)
