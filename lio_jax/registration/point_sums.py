"""Sums over a scan's points at a pose, whose derivative costs little however many parameters there are."""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from lio_jax.core.implicit import with_derivative_of
from lio_jax.core.xla import computed_once

Rows = Callable[[Array, Array, Array, Any, Any], Array]
"""``(arm (3, k), shift (3,), scales (s,), met (k, j), constants) -> (m, k)``: what each point adds to m sums.
Its place in world axes is ``arm`` from the sensor and ``arm + shift`` from the map's origin."""


def point_sums(
    total: Float[Array, " m"],
    rows: Rows,
    points: Float[Array, "k 3"],
    R_world_lidar: Float[Array, "3 3"],
    shift: Float[Array, "3"],
    scales: Float[Array, " s"],
    met: Float[Array, "k j"] | None,
    constants: Any,
) -> Float[Array, " m"]:
    """Return ``total``, computed already, with the derivative of the sum of ``rows`` over the points.

    The derivative by each point's place is worked out once; a tangent of the points is then one product with
    it, and those of pose and scales only see its sums. Differentiating the sum itself would work through all
    points once per parameter.

    Args:
        total: the sum over the points.
        rows: what is summed; it must not close over arrays that are differentiated.
        points: in the lidar frame, m.
        R_world_lidar: turns them into ``arm``.
        shift: see :data:`Rows`, m.
        scales: anything smooth that all points share.
        met: anything smooth that the map knows about where each point lies; None: the map has no derivative.
        constants: a pytree without a derivative.
    """
    # zeros are for the products with the pose's tangents; a row that counts keeps its point
    finite = jax.lax.stop_gradient(jnp.where(jnp.isfinite(points), points, 0.0))
    points = with_derivative_of(finite, lambda points: points, points)
    return _summed(total, rows, points, R_world_lidar, shift, scales, met, constants)


@eqx.filter_custom_jvp
def _summed(
    total: Array,
    rows: Rows,
    points: Array,
    R: Array,
    shift: Array,
    scales: Array,
    met: Array | None,
    constants: Any,
) -> Array:
    return total


@_summed.def_jvp
def _summed_jvp(primals: tuple, tangents: tuple) -> tuple[Array, Array]:
    total, rows, points, R, shift, scales, met, constants = primals
    points_dot, R_dot, shift_dot, scales_dot, met_dot = tangents[2:7]
    arm = R @ points.T
    arguments = [arm, shift, scales, met]

    def along(by: int, direction: Array) -> Array:
        def moved(argument: Array) -> Array:
            return rows(*arguments[:by], argument, *arguments[by + 1 :], constants)

        return jax.jvp(moved, (arguments[by],), (direction,))[1]

    def slopes(by: int) -> Array:
        """Return the rows' derivatives by each component of one of their arguments."""
        shape, dtype = arguments[by].shape, arguments[by].dtype
        units = jnp.eye(shape[1 if by == 3 else 0], dtype=dtype)
        spread = {0: units[:, :, None], 3: units[:, None, :]}.get(by, units)
        return jax.vmap(partial(along, by))(jnp.broadcast_to(spread, (len(units), *shape)))

    by_place = slopes(0)
    total_dot = jnp.zeros_like(total)
    if points_dot is not None:
        flat = jnp.swapaxes(by_place, 0, 1).reshape(len(total), -1)
        total_dot += flat @ (R @ points_dot.T).ravel()
    if R_dot is not None:
        total_dot += jnp.tensordot(R_dot, jnp.tensordot(by_place, points, ((2,), (0,))), ((0, 1), (0, 2)))
    if shift_dot is not None:
        total_dot += shift_dot @ jnp.sum(slopes(1), -1)
    if scales_dot is not None:
        total_dot += scales_dot @ jnp.sum(slopes(2), -1)
    if met_dot is not None:
        total_dot += jnp.tensordot(slopes(3), met_dot, ((0, 2), (1, 0)))
    return total, total_dot


_Axes = tuple[Array, Array, Array]


def distance_columns(arm: _Axes, placed: _Axes, normal: _Axes, offset: Float[Array, " k"]) -> list[Array]:
    """Return the derivatives of distances from planes by rotation and translation; then the distances, m.

    Args:
        arm: x, y and z of each point from the sensor, world axes, m.
        placed: the same from the frame's origin.
        normal: of each plane.
        offset: of each plane, m.
    """
    (rx, ry, rz), (px, py, pz), (nx, ny, nz) = arm, placed, normal
    distance = nx * px + ny * py + nz * pz + offset
    return [ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx, nx, ny, nz, distance]


_PAIRS = tuple(place.astype(np.int32) for place in np.triu_indices(7))
_PLACES = np.zeros((7, 7), np.int32)
_PLACES[_PAIRS] = _PLACES.T[_PAIRS] = np.arange(28)


def products(columns: list[Array], weight: Float[Array, " k"]) -> Float[Array, "28 k"]:
    """Return weight times column times column, for each pair of columns in the order of :func:`in_order`."""
    rows = jnp.stack(columns)
    weighted, rows = computed_once((weight * rows, rows))
    return weighted[_PAIRS[0]] * rows[_PAIRS[1]]


def in_order(sums: Float[Array, "7 7"]) -> Float[Array, "28"]:
    """Return the upper triangle of a symmetric matrix, row after row."""
    return sums[_PAIRS]


def as_matrix(total: Float[Array, "28"]) -> Float[Array, "7 7"]:
    """Return the symmetric matrix of :func:`in_order`."""
    return total[_PLACES]
