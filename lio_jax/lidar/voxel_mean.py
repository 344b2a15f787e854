"""Thin a scan to the mean of the points in each voxel, without sorting."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.hashing import voxel_hash
from lio_jax.core.materialise import materialised
from lio_jax.core.prefix_sum import running_count


class MeanPoints(eqx.Module):
    """One point per occupied voxel, the real ones first."""

    points: Float[Array, "k 3"]
    """m."""
    time: Float[Array, " k"] | None
    """s; None where the points have none."""
    mask: Bool[Array, " k"]
    dropped: Int32[Array, ""]
    """Occupied voxels that found no room in the capacity."""


def mean_per_voxel(
    points: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
    voxel_size: Float32[Array, ""],
    capacity: int,
    time: Float[Array, " n"] | None = None,
) -> MeanPoints:
    """Return the mean of each cubic voxel's points, of at most ``capacity`` voxels.

    Voxels are hashed into slots. Of two that share one the second is left out, and slots beyond the capacity
    are cut off; both thin the scan evenly over space, because slots are hashes.

    Args:
        points: m, any frame.
        mask: which rows are real.
        voxel_size: edge length, m.
        capacity: number of returned rows.
        time: of the points, to be averaged with them, s.
    """
    table_size = 1 << (4 * capacity - 1).bit_length()
    voxel = jnp.floor(jnp.where(mask[:, None], points, 0.0) / voxel_size).astype(jnp.int32)
    slot = jnp.where(mask, voxel_hash(voxel) & jnp.uint32(table_size - 1), table_size).astype(jnp.int32)
    order = jnp.arange(points.shape[0], dtype=jnp.int32)
    last = jnp.full(table_size, -1, jnp.int32).at[slot].max(order, mode="drop")
    rank = running_count(last >= 0) - 1
    row, winner = (table.at[slot].get(mode="clip") for table in (rank, last))
    x, y, z = (voxel[:, axis] == voxel[jnp.maximum(winner, 0), axis] for axis in range(3))
    row = materialised(jnp.where(mask & x & y & z & (row < capacity), row, capacity))
    count = jnp.zeros(capacity, points.dtype).at[row].add(1.0, mode="drop")

    def mean(values: Array) -> Array:
        return jnp.zeros(capacity, values.dtype).at[row].add(values, mode="drop") / jnp.maximum(count, 1.0)

    means = jnp.zeros((capacity, 3), points.dtype)
    for axis in range(3):
        means = means.at[:, axis].set(mean(points[:, axis]))
    times = None if time is None else mean(time)
    return MeanPoints(means, times, count > 0, jnp.maximum(rank[-1] + 1 - capacity, 0))
