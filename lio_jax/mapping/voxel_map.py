"""A hashed voxel table of fixed capacity: mean, covariance and plane of the points in each voxel.

A point's coordinates are relative to its voxel's centre, and voxels have integer coordinates, so float32 is
precise at any distance from the world's origin. Points are given in an *anchored* frame: the world shifted by
a whole number of voxels, such that the vehicle is near the origin.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int32, UInt32

from lio_jax.core.geometry import dot3, eigenvalues_and_normal3
from lio_jax.core.hashing import voxel_hash
from lio_jax.core.prefix_sum import running_count
from lio_jax.core.xla import computed_once

WAYS = 2
"""Number of slots that a voxel may lie in. They are neighbours in memory, so that both are read together."""
FREE = -(2**31)
"""Coordinate of a free slot, which no voxel has."""
SUBDIVISION = 4
"""Number of cells along a voxel's edge. Each cell takes one point, so 4 x 4 x 4 = 64 bits show which are
filled."""
_CLEAR = 2.0
"""Standard deviations of its tilt by which a plane has to pass beside the sensor that saw it."""
_LEAST_SPREAD = 3e-3
"""Least standard deviation of points about their plane, m: few may lie on one by chance."""
PLANE_DOF = 3
"""A plane through so many points shows none of their noise."""
_BATCH = 4096
"""Number of points inserted at a time. Most scans have fewer new points, and need one batch."""
_OFFSETS = np.concatenate([np.zeros((1, 3), np.int32), np.eye(3, dtype=np.int32)])
"""Offsets to a point's own voxel and to one neighbour along each axis."""


class VoxelMap(eqx.Module):
    """A table of c slots, each of which holds one voxel."""

    voxel: Int32[Array, "c 3"]
    """Integer coordinates of the voxel in each slot; ``FREE`` in a free slot."""
    moments: Float[Array, "c 10"]
    """Number of points; sums of x, y and z (m); sums of xx, yy, zz, xy, xz and yz (m^2); coordinates are
    relative to the voxel's centre."""
    cells: UInt32[Array, "c 2"]
    """Bit set of the cells that hold a point."""
    centroid: Float[Array, "c 4"]
    """Mean of the points relative to the voxel's centre, m, and their number, negative where their plane
    contains the sensor. A look-up compares these."""
    plane: Float[Array, "c 5"]
    """Unit normal, and the two smaller variances, ascending, m^2. A match uses these."""

    def varying(self) -> "VoxelMap":
        """Return a tree of booleans: the moments have a derivative, and what follows from them needs none."""
        fixed = jax.tree.map(lambda _: False, self)
        return eqx.tree_at(lambda one: one.moments, fixed, True)


class Insertion(eqx.Module):
    """The result of an insertion."""

    added: Bool[Array, " m"]
    """True for points that filled an empty cell."""
    dropped: Int32[Array, ""]
    """Number of points whose voxel found no free slot, because the table is too full."""


class VoxelPlanes(eqx.Module):
    """The plane and the distribution of the map's points around each of k queries."""

    mean: Float[Array, "k 3"]
    """Mean of the points, m, in the anchored frame."""
    normal: Float[Array, "k 3"]
    """Direction of the smallest variance, of unit length, in world axes."""
    variances: Float[Array, "k 2"]
    """The two smaller variances, ascending, m^2."""
    count: Float[Array, " k"]
    """Number of points of the distribution."""
    surface: Bool[Array, " k"]
    """False where the plane contains the sensor that saw it; see :func:`insert`."""
    slot: Int32[Array, " k"]
    """Where the table holds the points; 0 where it does not."""
    valid: Bool[Array, " k"]
    """False where no voxel around the query holds enough points."""


def empty_map(capacity: int, dtype: DTypeLike = jnp.float32) -> VoxelMap:
    """Return a map of free slots.

    Args:
        capacity: number of slots, a power of two.
        dtype: of what the map knows of its points.
    """
    return VoxelMap(
        voxel=jnp.full((capacity, 3), FREE, jnp.int32),
        moments=jnp.zeros((capacity, 10), dtype),
        cells=jnp.zeros((capacity, 2), jnp.uint32),
        centroid=jnp.zeros((capacity, 4), dtype),
        plane=jnp.zeros((capacity, 5), dtype),
    )


def anchor_of(position: Float[Array, "3"], voxel_size: Float[Array, ""]) -> tuple[Int32[Array, "3"], Array]:
    """Return the voxel that contains a position, and the voxel's lower corner.

    Args:
        position: m, in world.
        voxel_size: edge length, m.

    Returns:
        The voxel's integer coordinates, and its lower corner in world, m, in the dtype of ``position``.
    """
    anchor = jnp.floor(position / voxel_size).astype(jnp.int32)
    return anchor, anchor.astype(position.dtype) * voxel_size


def query_nearest(
    vmap: VoxelMap,
    points: Float[Array, "k 3"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
    min_points: Float[Array, ""],
) -> VoxelPlanes:
    """Return, for each point, the distribution with the nearest mean among four voxels.

    The four voxels are the point's own voxel and, along each axis, the face neighbour on the nearer side.

    Args:
        vmap: the map.
        points: m, in the frame anchored at ``anchor``.
        anchor: voxel whose lower corner is the origin of ``points``.
        voxel_size: edge length, m.
        min_points: least number of points of a voxel that is used.
    """
    points, voxel_size = points.astype(vmap.moments.dtype), voxel_size.astype(vmap.moments.dtype)
    scaled = points / voxel_size
    own = jnp.floor(scaled)
    side = jnp.where(scaled - own > 0.5, 1, -1).astype(jnp.int32)
    local = own.astype(jnp.int32) + _OFFSETS[:, None] * side
    slots = computed_once(find_slots(vmap, local + anchor))
    held = jnp.maximum(slots, 0)
    away = points - _centre(local, voxel_size) - take(vmap.centroid, held)[..., :3]
    usable = (slots >= 0) & (jnp.abs(take(vmap.centroid, (held, 3))) >= min_points)
    squared = jnp.where(usable, away[..., 0] ** 2 + away[..., 1] ** 2 + away[..., 2] ** 2, jnp.inf)
    distance, nearest = jnp.full_like(squared[0], jnp.inf), jnp.full_like(slots[0], -1)
    for other, slot in zip(squared, slots, strict=True):
        nearest = jnp.where(other < distance, slot, nearest)
        distance = jnp.minimum(other, distance)
    nearest = computed_once(nearest)
    found = jnp.maximum(nearest, 0)
    plane, centroid = take(vmap.plane, found), computed_once(take(vmap.centroid, found))
    count = centroid[:, 3]
    return VoxelPlanes(
        mean=_centre(take(vmap.voxel, found) - anchor, voxel_size) + centroid[:, :3],
        normal=plane[:, :3],
        variances=plane[:, 3:],
        count=jnp.abs(count),
        surface=count > 0,
        slot=found,
        valid=nearest >= 0,
    )


def insert(
    vmap: VoxelMap,
    points: Float[Array, "m 3"],
    mask: Bool[Array, " m"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
    reach: Float[Array, ""],
    sensor: Float[Array, "3"] | None = None,
) -> tuple[VoxelMap, Insertion]:
    """Add points to the distributions of their voxels.

    A point is added only if its cell is empty, so a distribution is uniform although the sensor's lines are
    not. A new voxel claims a slot that is free, or that holds a voxel farther than ``reach`` from the anchor.
    So the map forgets voxels that are far away.

    The points of one scan line that runs around the corner of a house spread over a plane: that of the beams,
    which is no surface. It contains the sensor. A voxel whose plane does so within the uncertainty of its
    tilt is no surface until points seen from elsewhere have changed the plane.

    Args:
        vmap: the map; donate it if it is not needed afterwards.
        points: m, in the frame anchored at ``anchor``.
        mask: which rows are real.
        anchor: voxel whose lower corner is the origin of ``points``.
        voxel_size: edge length, m.
        reach: distance from the anchor beyond which voxels may be overwritten, m.
        sensor: where the points were seen from, m, in the anchored frame; None: not known.
    """
    count = points.shape[0]
    vmap, points, sensor = jax.lax.stop_gradient((vmap, points.astype(vmap.moments.dtype), sensor))
    grid = VoxelGrid(anchor, voxel_size.astype(points.dtype), reach)
    voxel, cell, _ = grid.places(points)
    slot = computed_once(find_slots(vmap, voxel))
    new = mask & ~((slot >= 0) & _held(vmap, slot, cell))
    rank = running_count(new) - 1
    batch = min(_BATCH, count)
    waiting = jnp.full(-(-count // batch) * batch, count, jnp.int32)
    waiting = waiting.at[jnp.where(new, rank, waiting.shape[0])].set(
        jnp.arange(count, dtype=jnp.int32), mode="drop"
    )

    def insert_batch(number: Array, carry: tuple[VoxelMap, Array, Array]) -> tuple[VoxelMap, Array, Array]:
        vmap, added, dropped = carry
        index = jax.lax.dynamic_slice(waiting, (number * batch,), (batch,))
        row = jnp.minimum(index, count - 1)
        vmap, fills, homeless = _insert_new(vmap, take(points, row), index < count, grid, sensor)
        added = added.at[jnp.where(fills, index, count)].set(True, mode="drop")
        return vmap, added, dropped + jnp.sum(homeless, dtype=jnp.int32)

    start = (vmap, jnp.zeros(count, bool), jnp.int32(0))
    batches = (rank[-1] + batch) // batch
    vmap, added, dropped = jax.lax.fori_loop(0, batches, insert_batch, start)
    return vmap, Insertion(added, dropped)


def moment_row(offset: Float[Array, "m 3"]) -> Float[Array, "m 10"]:
    """Return what a point adds to the moments of its voxel, given its offset from the voxel's centre, m."""
    x, y, z = jnp.moveaxis(offset, -1, 0)
    return jnp.stack([jnp.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z], -1)


def find_slots(vmap: VoxelMap, voxel: Int32[Array, "*b 3"]) -> Int32[Array, "*b"]:
    """Return the slot of each voxel; -1 where the map does not hold it.

    Args:
        vmap: the map.
        voxel: integer coordinates.
    """
    first = _first_slot(vmap, voxel)
    slot = jnp.full(voxel.shape[:-1], -1, jnp.int32)
    for way in range(WAYS):
        candidate = first + way
        same = take(vmap.voxel, candidate) == voxel
        slot = jnp.where(same[..., 0] & same[..., 1] & same[..., 2], candidate, slot)
    return slot


class VoxelGrid(eqx.Module):
    """The grid of the table, seen from an anchor."""

    anchor: Int32[Array, "3"]
    voxel_size: Float[Array, ""]
    reach: Float[Array, ""]

    def places(
        self, points: Float[Array, "m 3"]
    ) -> tuple[Int32[Array, "m 3"], Int32[Array, "m 3"], Float[Array, "m 3"]]:
        """Return each point's voxel, its cell in that voxel, and its offset from the voxel's centre, m."""
        scaled = points / self.voxel_size
        local = jnp.floor(scaled)
        fraction = scaled - local
        cell = jnp.clip((fraction * SUBDIVISION).astype(jnp.int32), 0, SUBDIVISION - 1)
        return local.astype(jnp.int32) + self.anchor, cell, (fraction - 0.5) * self.voxel_size


def _insert_new(
    vmap: VoxelMap,
    points: Float[Array, "m 3"],
    mask: Bool[Array, " m"],
    grid: VoxelGrid,
    sensor: Float[Array, "3"] | None,
) -> tuple[VoxelMap, Bool[Array, " m"], Bool[Array, " m"]]:
    """Insert one batch; return the map, which points filled a cell, and which found no slot."""
    capacity = vmap.voxel.shape[0]
    voxel, cell, offset = grid.places(points)
    slot, fresh, homeless = _claim_slots(vmap, voxel, mask, grid.anchor, grid.reach / grid.voxel_size)
    slot, fresh, homeless = computed_once((slot, fresh, homeless))
    cleared = jnp.where(fresh, slot, capacity)
    table_voxel = vmap.voxel.at[cleared].set(voxel, mode="drop")
    moments = vmap.moments.at[cleared].set(0.0, mode="drop")
    cells = vmap.cells.at[cleared].set(jnp.uint32(0), mode="drop")
    vmap = VoxelMap(table_voxel, moments, cells, vmap.centroid, vmap.plane)

    fills = _one_per_cell((slot >= 0) & ~_held(vmap, slot, cell), voxel * SUBDIVISION + cell)
    target = computed_once(jnp.where(fills, slot, capacity))
    moments = moments.at[target].add(moment_row(offset), mode="drop")
    word, bit = _word_and_bit(cell)
    cells = cells.at[target, word].add(bit, mode="drop")

    held = jnp.maximum(slot, 0)
    mean, diagonal, off_diagonal = mean_and_covariance(take(moments, held))
    variances, normal = eigenvalues_and_normal3(diagonal, off_diagonal)
    count = take(moments, (held, 0))
    signed = count
    if sensor is not None:
        way = mean - offset + points - sensor.astype(points.dtype)
        signed = jnp.where(_contained(way, count, normal, variances), -count, count)
    centroid = jnp.concatenate([mean, signed[:, None]], -1)
    plane = jnp.concatenate([normal, jnp.maximum(variances[:, :2], 0.0)], -1)
    vmap = VoxelMap(
        table_voxel,
        moments,
        cells,
        vmap.centroid.at[target].set(centroid, mode="drop"),
        vmap.plane.at[target].set(plane, mode="drop"),
    )
    return vmap, fills, homeless


def _contained(
    way: Float[Array, "m 3"],
    count: Float[Array, " m"],
    normal: Float[Array, "m 3"],
    variances: Float[Array, "m 3"],
) -> Bool[Array, " m"]:
    """Return which planes contain the way from the sensor to the mean of their points.

    A plane through n points is tilted about its longest axis by the variance l0 / ((n - 3) l1).
    """
    flat, wide = jnp.maximum(variances[:, 0], _LEAST_SPREAD**2), variances[:, 1]
    scaled = dot3(way, normal) ** 2 * jnp.maximum(count - PLANE_DOF, 1.0) * wide
    return scaled < _CLEAR**2 * flat * dot3(way, way)


def _held(vmap: VoxelMap, slot: Int32[Array, " m"], cell: Int32[Array, "m 3"]) -> Bool[Array, " m"]:
    """Return which points' cells hold a point already; ``slot`` is -1 where the map has no such voxel."""
    word, bit = _word_and_bit(cell)
    return (take(vmap.cells, (jnp.maximum(slot, 0), word)) & bit) != 0


def _word_and_bit(cell: Int32[Array, "m 3"]) -> tuple[Int32[Array, " m"], UInt32[Array, " m"]]:
    number = (cell[:, 0] * SUBDIVISION + cell[:, 1]) * SUBDIVISION + cell[:, 2]
    return number >> 5, jnp.uint32(1) << (number & 31).astype(jnp.uint32)


def _claim_slots(
    vmap: VoxelMap, voxel: Int32[Array, "m 3"], mask: Array, anchor: Array, reach: Array
) -> tuple[Int32[Array, " m"], Bool[Array, " m"], Bool[Array, " m"]]:
    """Return the slot of each voxel or -1, whether it was claimed now, and whether none was found."""
    capacity = vmap.voxel.shape[0]
    order = jnp.arange(voxel.shape[0], dtype=jnp.int32)
    first = _first_slot(vmap, voxel)
    slot = jnp.where(mask, find_slots(vmap, voxel), -1)
    homeless = mask & (slot < 0)
    fresh = jnp.zeros_like(mask)
    claims = jnp.full(capacity, -1, jnp.int32)
    for way in range(WAYS):
        candidate = first + way
        # as floats, because the integer coordinates of a free slot would overflow; they count as far away
        apart = take(vmap.voxel, candidate).astype(jnp.float32) - anchor.astype(jnp.float32)
        open_slot = dot3(apart, apart) > reach**2
        asks = homeless & open_slot & (take(claims, candidate) < 0)
        claims = claims.at[jnp.where(asks, candidate, capacity)].max(order, mode="drop")
        winner = take(claims, candidate)
        housed = homeless & (winner >= 0) & jnp.all(take(voxel, jnp.maximum(winner, 0)) == voxel, -1)
        slot = jnp.where(housed, candidate, slot)
        fresh |= housed
        homeless &= ~housed
    # another voxel may have claimed the slot of a voxel beyond reach: the latter must not write into it
    evicted = (slot >= 0) & ~fresh & (take(claims, jnp.maximum(slot, 0)) >= 0)
    return jnp.where(evicted, -1, slot), fresh, homeless | evicted


def _one_per_cell(wants: Bool[Array, " m"], cell: Int32[Array, "m 3"]) -> Bool[Array, " m"]:
    """Return one candidate per cell; of cells that share a hash only one gets a point."""
    table = 1 << (4 * wants.shape[0] - 1).bit_length()
    order = jnp.arange(wants.shape[0], dtype=jnp.int32)
    ticket = jnp.where(wants, (voxel_hash(cell) & jnp.uint32(table - 1)).astype(jnp.int32), table)
    winner = jnp.full(table, -1, jnp.int32).at[ticket].max(order, mode="drop")
    return wants & (winner.at[ticket].get(mode="fill", fill_value=-1) == order)


def _centre(local: Int32[Array, "*b 3"], voxel_size: Float[Array, ""]) -> Float[Array, "*b 3"]:
    """Return the centres, m, of voxels in the anchored frame."""
    return (local.astype(voxel_size.dtype) + 0.5) * voxel_size


def mean_and_covariance(moments: Float[Array, "*b 10"]) -> tuple[Array, Array, Array]:
    """Return the means relative to the voxels' centres (m), and the covariances (m^2).

    Of the covariances, the entries xx, yy and zz come before xy, xz and yz.
    """
    count = jnp.maximum(moments[..., :1], 1.0)
    mean = moments[..., 1:4] / count
    x, y, z = mean[..., 0], mean[..., 1], mean[..., 2]
    diagonal = jnp.maximum(moments[..., 4:7] / count - mean**2, 0.0)
    return mean, diagonal, moments[..., 7:10] / count - jnp.stack([x * y, x * z, y * z], -1)


def _first_slot(vmap: VoxelMap, voxel: Int32[Array, "*b 3"]) -> Int32[Array, "*b"]:
    buckets = vmap.voxel.shape[0] // WAYS
    return ((voxel_hash(voxel) & jnp.uint32(buckets - 1)) * WAYS).astype(jnp.int32)


def take(table: Array, index: Array | tuple[Array | int, ...]) -> Array:
    """Return entries of a table that are known to lie in it."""
    return table.at[index].get(mode="promise_in_bounds")
