"""A hashed voxel table of fixed capacity that holds the running distribution of the points in each voxel.

Coordinates inside a voxel are kept relative to its centre and voxel coordinates as integers, so float32 stays
precise however far the vehicle drives. Points are given in an *anchored* frame: the world shifted by a whole
number of voxels, such that the vehicle is near its origin.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Float32, Int32, UInt32

from lio_jax.core.hashing import voxel_hash

WAYS = 2
"""Slots a voxel may lie in: neighbours in memory, so that both are read together."""
FREE = -(2**31)
"""Coordinate that no voxel has."""
SUBDIVISION = 4
"""Cells per voxel edge; each cell takes one point, remembered in 4 x 4 x 4 = 64 bits."""


class VoxelMap(eqx.Module):
    """All slots."""

    voxel: Int32[Array, "c 3"]
    """Which voxel a slot holds; ``FREE`` in a free slot."""
    moments: Float32[Array, "c 10"]
    """Count; sums of x y z; sums of xx yy zz xy xz yz; m, relative to the voxel's centre."""
    cells: UInt32[Array, "c 2"]
    """Bit set of the cells that hold a point."""


class Insertion(eqx.Module):
    """What an insertion did."""

    added: Bool[Array, " m"]
    """Which points filled an empty cell."""
    dropped: Int32[Array, ""]
    """Points whose voxel found no free slot: the table is too full."""


class Distributions(eqx.Module):
    """Mean and covariance of the map's points around each query."""

    mean: Float32[Array, "k 3"]
    """m, in the anchored frame."""
    diagonal: Float32[Array, "k 3"]
    """Variances xx yy zz, m^2."""
    off_diagonal: Float32[Array, "k 3"]
    """Covariances xy xz yz, m^2."""
    valid: Bool[Array, " k"]
    """False where no voxel around the query holds enough points."""


def empty_map(capacity: int) -> VoxelMap:
    """Return a map of ``capacity`` free slots (a power of two)."""
    return VoxelMap(
        voxel=jnp.full((capacity, 3), FREE, jnp.int32),
        moments=jnp.zeros((capacity, 10), jnp.float32),
        cells=jnp.zeros((capacity, 2), jnp.uint32),
    )


def anchor_of(position: Float[Array, "3"], voxel_size: Float[Array, ""]) -> tuple[Int32[Array, "3"], Array]:
    """Return the voxel that holds ``position`` and its lower corner (m, in world, position's dtype)."""
    anchor = jnp.floor(position / voxel_size).astype(jnp.int32)
    return anchor, anchor.astype(position.dtype) * voxel_size


def query_nearest(
    vmap: VoxelMap,
    points: Float32[Array, "k 3"],
    anchor: Int32[Array, "3"],
    voxel_size: Float32[Array, ""],
    min_points: Float32[Array, ""],
) -> Distributions:
    """Return, for each point, the distribution with the nearest mean among four voxels.

    The four are the point's own voxel and the face neighbour on the nearer side along each axis.

    Args:
        vmap: the map.
        points: m, in the frame anchored at ``anchor``.
        anchor: voxel whose lower corner is the origin of ``points``.
        voxel_size: edge length, m.
        min_points: points a voxel needs to count.
    """
    scaled = points / voxel_size
    own = jnp.floor(scaled)
    side = jnp.where(scaled - own > 0.5, 1, -1).astype(jnp.int32)
    offsets = jnp.concatenate([jnp.zeros((1, 3), jnp.int32), jnp.eye(3, dtype=jnp.int32)])
    local = own.astype(jnp.int32)[:, None] + offsets * side[:, None]
    slot = find_slots(vmap, local + anchor)
    centre = (local.astype(jnp.float32) + 0.5) * voxel_size
    count, sums = _count_and_sums(vmap.moments, jnp.maximum(slot, 0))
    usable = (slot >= 0) & (count >= min_points)
    away = points[:, None] - centre - sums / jnp.maximum(count, 1.0)[..., None]
    distance = jnp.where(usable, jnp.sum(away**2, -1), jnp.inf)
    row, best = jnp.arange(points.shape[0]), _smallest_column(distance)
    moments = _take(vmap.moments, jnp.maximum(_take(slot, (row, best)), 0))
    mean, diagonal, off_diagonal = _mean_and_covariance(moments)
    return Distributions(
        mean=_take(centre, (row, best)) + mean,
        diagonal=diagonal,
        off_diagonal=off_diagonal,
        valid=jnp.any(usable, -1),
    )


def insert(
    vmap: VoxelMap,
    points: Float32[Array, "m 3"],
    mask: Bool[Array, " m"],
    anchor: Int32[Array, "3"],
    voxel_size: Float32[Array, ""],
    reach: Float32[Array, ""],
) -> tuple[VoxelMap, Insertion]:
    """Add points to the distributions of their voxels.

    A point is taken if its cell is still empty, which keeps a distribution even where the sensor's lines are
    not. A new voxel claims a slot that is free or holds a voxel farther than ``reach`` from the anchor: that
    is how the map forgets.

    Args:
        vmap: donate it where it is not needed afterwards.
        points: m, in the frame anchored at ``anchor``.
        mask: which rows are real.
        anchor: voxel whose lower corner is the origin of ``points``.
        voxel_size: edge length, m.
        reach: distance from the anchor beyond which voxels may be overwritten, m.
    """
    capacity = vmap.voxel.shape[0]
    scaled = points / voxel_size
    local = jnp.floor(scaled)
    fraction = scaled - local
    voxel = local.astype(jnp.int32) + anchor

    slot, fresh, homeless = _claim_slots(vmap, voxel, mask, anchor, reach / voxel_size)
    cleared = jnp.where(fresh, slot, capacity)
    table_voxel = vmap.voxel.at[cleared].set(voxel, mode="drop")
    moments = vmap.moments.at[cleared].set(0.0, mode="drop")
    cells = vmap.cells.at[cleared].set(jnp.uint32(0), mode="drop")

    step = jnp.clip((fraction * SUBDIVISION).astype(jnp.int32), 0, SUBDIVISION - 1)
    cell = (step[:, 0] * SUBDIVISION + step[:, 1]) * SUBDIVISION + step[:, 2]
    word, bit = cell >> 5, jnp.uint32(1) << (cell & 31).astype(jnp.uint32)
    held = (cells.at[jnp.maximum(slot, 0), word].get(mode="promise_in_bounds") & bit) != 0
    wants = _one_per_cell((slot >= 0) & ~held, voxel * SUBDIVISION + step)

    target = jnp.where(wants, slot, capacity)
    x, y, z = jnp.moveaxis((fraction - 0.5) * voxel_size, -1, 0)
    row = jnp.stack([jnp.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], -1)
    moments = moments.at[target].add(row, mode="drop")
    cells = cells.at[target, word].add(bit, mode="drop")
    report = Insertion(wants, jnp.sum(homeless, dtype=jnp.int32))
    return VoxelMap(table_voxel, moments, cells), report


def find_slots(vmap: VoxelMap, voxel: Int32[Array, "*b 3"]) -> Int32[Array, "*b"]:
    """Return the slot of each voxel, -1 where the map does not hold it."""
    first = _first_slot(vmap, voxel)
    slot = jnp.full(voxel.shape[:-1], -1, jnp.int32)
    for way in range(WAYS):
        candidate = first + way
        slot = jnp.where(jnp.all(_take(vmap.voxel, candidate) == voxel, -1), candidate, slot)
    return slot


def _claim_slots(
    vmap: VoxelMap, voxel: Int32[Array, "m 3"], mask: Array, anchor: Array, reach: Array
) -> tuple[Int32[Array, " m"], Bool[Array, " m"], Bool[Array, " m"]]:
    """Find or claim a slot for each voxel: (slot or -1, newly claimed, left without)."""
    capacity = vmap.voxel.shape[0]
    order = jnp.arange(voxel.shape[0], dtype=jnp.int32)
    first = _first_slot(vmap, voxel)
    slot = jnp.where(mask, find_slots(vmap, voxel), -1)
    homeless = mask & (slot < 0)
    fresh = jnp.zeros_like(mask)
    claims = jnp.full(capacity, -1, jnp.int32)
    for way in range(WAYS):
        candidate = first + way
        # in floats, because a free slot's coordinates would overflow; they count as far away
        apart = _take(vmap.voxel, candidate).astype(jnp.float32) - anchor.astype(jnp.float32)
        open_slot = jnp.linalg.norm(apart, axis=-1) > reach
        asks = homeless & open_slot & (_take(claims, candidate) < 0)
        claims = claims.at[jnp.where(asks, candidate, capacity)].max(order, mode="drop")
        winner = _take(claims, candidate)
        housed = homeless & (winner >= 0) & jnp.all(_take(voxel, jnp.maximum(winner, 0)) == voxel, -1)
        slot = jnp.where(housed, candidate, slot)
        fresh |= housed
        homeless &= ~housed
    # a voxel whose own slot was just claimed by another (it lay beyond reach) must not write into it
    evicted = (slot >= 0) & ~fresh & (_take(claims, jnp.maximum(slot, 0)) >= 0)
    return jnp.where(evicted, -1, slot), fresh, homeless | evicted


def _one_per_cell(wants: Bool[Array, " m"], cell: Int32[Array, "m 3"]) -> Bool[Array, " m"]:
    """Keep one candidate per cell; cells that share a hash wait for the next scan."""
    table = 1 << (4 * wants.shape[0] - 1).bit_length()
    order = jnp.arange(wants.shape[0], dtype=jnp.int32)
    ticket = jnp.where(wants, (voxel_hash(cell) & jnp.uint32(table - 1)).astype(jnp.int32), table)
    winner = jnp.full(table, -1, jnp.int32).at[ticket].max(order, mode="drop")
    return wants & (winner.at[ticket].get(mode="fill", fill_value=-1) == order)


def _mean_and_covariance(moments: Float32[Array, "*b 10"]) -> tuple[Array, Array, Array]:
    count = jnp.maximum(moments[..., :1], 1.0)
    mean = moments[..., 1:4] / count
    x, y, z = mean[..., 0], mean[..., 1], mean[..., 2]
    diagonal = jnp.maximum(moments[..., 4:7] / count - mean**2, 0.0)
    return mean, diagonal, moments[..., 7:10] / count - jnp.stack([x * y, x * z, y * z], -1)


def _first_slot(vmap: VoxelMap, voxel: Int32[Array, "*b 3"]) -> Int32[Array, "*b"]:
    buckets = vmap.voxel.shape[0] // WAYS
    return ((voxel_hash(voxel) & jnp.uint32(buckets - 1)) * WAYS).astype(jnp.int32)


def _count_and_sums(
    moments: Float32[Array, "c 10"], slot: Int32[Array, "*b"]
) -> tuple[Float32[Array, "*b"], Float32[Array, "*b 3"]]:
    """Gather only the count and the first powers."""
    count, *sums = (moments.at[slot, column].get(mode="promise_in_bounds") for column in range(4))
    return count, jnp.stack(sums, -1)


def _smallest_column(values: Float32[Array, "k c"]) -> Int32[Array, " k"]:
    """Return argmin over the columns: a chain of selections, several times faster than XLA's reduction."""
    best, smallest = jnp.zeros(values.shape[0], jnp.int32), values[:, 0]
    for column in range(1, values.shape[1]):
        best = jnp.where(values[:, column] < smallest, column, best)
        smallest = jnp.minimum(smallest, values[:, column])
    return best


def _take(table: Array, index: Array | tuple[Array, ...]) -> Array:
    return table.at[index].get(mode="promise_in_bounds")
