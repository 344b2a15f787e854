"""The derivative of the voxel map's moments by the points that were inserted."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.implicit import with_derivative_of
from lio_jax.core.prefix_sum import running_count
from lio_jax.core.xla import added_in_place, computed_once
from lio_jax.mapping.voxel_map import FREE, VoxelGrid, VoxelMap, find_slots, moment_row, take


def following(
    vmap: VoxelMap,
    before: VoxelMap,
    added: Bool[Array, " m"],
    points: Float[Array, "m 3"],
    mask: Bool[Array, " m"],
    placed_again: Callable[[Int32[Array, " n"]], Float[Array, "n 3"]],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
) -> VoxelMap:
    """Return the map after an insertion with the derivative of its moments.

    The moments depend on those before and on the points that were added. Which points fill a cell and which
    voxel gets which slot are choices, which the derivative holds.

    Args:
        vmap: the map after :func:`insert`.
        before: the map before; its moments may have a derivative.
        added: which of the m points filled an empty cell.
        points: as they were inserted, m, in the anchored frame.
        mask: which of them were real.
        placed_again: ``rows -> (n, 3)``: the points of these rows, computed once more for their derivative. A
            pytree.
        anchor: voxel whose lower corner is the origin of ``points``.
        voxel_size: edge length, m.
    """
    still = jax.lax.stop_gradient(vmap)
    choices = jax.lax.stop_gradient((before.voxel, still, added, points, mask, anchor, voxel_size))
    moments = with_derivative_of(still.moments, _moments_after, before.moments, placed_again, choices)
    return eqx.tree_at(lambda one: one.moments, still, moments)


_CHUNK = 1024
"""Number of points whose changes are worked out at a time; most scans add few."""


def _moments_after(
    before: Float[Array, "c 10"], placed_again: Callable[[Array], Array], choices: tuple
) -> Float[Array, "c 10"]:
    """Return the moments after an insertion whose choices are known."""
    old, vmap, added, points, mask, anchor, voxel_size = choices
    capacity, count, dtype = len(old), len(added), before.dtype
    points, voxel_size = points.astype(dtype), voxel_size.astype(dtype)
    grid = VoxelGrid(anchor, voxel_size, voxel_size)
    voxel, _, _ = grid.places(points)
    slot = find_slots(vmap, voxel)
    held = jnp.maximum(slot, 0)
    order = jnp.arange(count, dtype=jnp.int32)
    forgotten = take(old, held)
    fresh = mask & (slot >= 0) & jnp.any(forgotten != voxel, axis=1) & (forgotten[:, 0] != FREE)
    # of all points of a fresh voxel one takes away what its slot held before
    first = jnp.full(capacity, count, jnp.int32).at[jnp.where(fresh, slot, capacity)].min(order, mode="drop")
    clears = fresh & (take(first, held) == order)
    touched = clears | added
    total = jnp.sum(touched, dtype=jnp.int32)
    size = min(_CHUNK, count)
    padded = -(-count // size) * size
    place = jnp.where(touched, running_count(touched) - 1, padded)
    rows = computed_once(jnp.zeros(padded, jnp.int32).at[place].set(order, mode="drop"))
    slots, clearing = take(held, rows), take(clears, rows)

    def gained(some: Array) -> Array:
        # the module is an argument, because its arrays have a derivative
        again = with_derivative_of(
            take(points, some), lambda place, rows: place(rows).astype(dtype), placed_again, some
        )
        _, _, offset = grid.places(again)
        return jnp.where(take(added, some)[:, None], moment_row(offset), 0.0)

    def chunk(number: Array) -> Array:
        some = jax.lax.dynamic_slice(rows, (number * size,), (size,))
        return jax.lax.cond(number * size < total, gained, lambda rows: jnp.zeros((size, 10), dtype), some)

    def lost(before: Array) -> Array:
        return jnp.where(clearing[:, None], take(before, slots), 0.0)

    gains = jax.lax.map(chunk, jnp.arange(padded // size)).reshape(padded, 10)
    # few scans overwrite voxels
    losses = jax.lax.cond(jnp.any(clears), lost, lambda before: jnp.zeros((padded, 10), dtype), before)
    return added_in_place(before, slots, gains - losses, total)
