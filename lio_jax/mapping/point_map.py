"""A hashed map of points, one per voxel, in a cube that follows the sensor; it replaces FAST-LIO2's ikd-tree.

The point of a voxel is the one nearest to its centre (FAST-LIO2), or the mean of all points that were put
into it, as PCL's VoxelGrid leaves it (LIO-SAM).

Voxels are stored in blocks of 3 x 3 x 3, so one look-up of a key finds 27 of them. A point's coordinates are
relative to its block's centre, and blocks have integer coordinates, so float32 is precise at any distance
from the world's origin. Points are given in an *anchored* frame: the world shifted by a whole number of
blocks, such that the vehicle is near the origin.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.implicit import with_derivative_of
from lio_jax.core.xla import computed_once
from lio_jax.mapping.hash_slots import FREE, claim_slots, find_slots, free_keys

EDGE = 3
"""Number of voxels along an edge of a block."""
VOXELS = EDGE**3
"""Number of voxels in a block."""


class PointMap(eqx.Module):
    """All blocks, and the cube that bounds the map."""

    block: Int32[Array, "c 3"]
    """Integer coordinates of the block in each slot; ``FREE`` in a free slot."""
    point: Float[Array, "c 81"]
    """x of the 27 voxels' points, then y, then z, m from the block's centre; infinite in empty voxels."""
    off_centre: Float[Array, "c 27"] | None
    """Distance of each point from its voxel's centre, m; infinite in empty voxels. None in a map of means."""
    cube: Int32[Array, "3"]
    """The block at the cube's centre."""
    count: Float[Array, "c 27"] | None = None
    """Number of points whose mean each voxel holds; None in a map of the points nearest to the centres."""

    def varying(self) -> "PointMap":
        """Return a tree of booleans: the points have a derivative."""
        fixed = jax.tree.map(lambda _: False, self)
        return eqx.tree_at(lambda one: one.point, fixed, True)


class PointInsertion(eqx.Module):
    """The result of an insertion."""

    added: Bool[Array, " m"]
    """True for points that are now in the map; in a map of means, for points in voxels that were empty."""
    moved: Bool[Array, " m"]
    """True for points that a point of the map moves with: those of ``added``, or all that entered a mean."""
    dropped: Int32[Array, ""]
    """Number of points whose block found no free slot, because the table is too full."""


def empty_map(capacity: int, dtype: DTypeLike = jnp.float32, of_means: bool = False) -> PointMap:
    """Return a map of free blocks, with its cube around the world's origin.

    Args:
        capacity: number of blocks, a power of two.
        dtype: of the coordinates.
        of_means: whether a voxel holds the mean of its points, in place of the one nearest to its centre.
    """
    return PointMap(
        block=free_keys(capacity),
        point=jnp.full((capacity, 3 * VOXELS), jnp.inf, dtype),
        off_centre=None if of_means else jnp.full((capacity, VOXELS), jnp.inf, dtype),
        cube=jnp.zeros(3, jnp.int32),
        count=jnp.zeros((capacity, VOXELS), dtype) if of_means else None,
    )


def move_cube(
    pmap: PointMap, anchor: Int32[Array, "3"], half_side: Float[Array, ""], margin: Float[Array, ""]
) -> PointMap:
    """Move the cube to the sensor along each axis on which a face is near, and delete the points outside.

    Args:
        pmap: the map; donate it.
        anchor: the block that the sensor is in.
        half_side: half of the cube's edge, blocks.
        margin: least distance of the sensor from a face, blocks.
    """
    near = jnp.abs(anchor - pmap.cube) > half_side - margin
    return _cleared(pmap, jnp.where(near, anchor, pmap.cube), half_side)


def shift_box(
    pmap: PointMap,
    anchor: Int32[Array, "3"],
    half_sides: Float[Array, "3"],
    margin: Float[Array, ""],
    step: Float[Array, ""],
) -> PointMap:
    """Shift a box in place of the cube, in whole steps, until no face is too near to the sensor.

    Args:
        pmap: the map; donate it.
        anchor: the block that the sensor is in.
        half_sides: half of the box's edges along x, y and z, blocks.
        margin: least distance of the sensor from a face, blocks.
        step: blocks; the box's centre is a multiple of it, rounded to a block.
    """
    number = jnp.round(pmap.cube / step)
    away = anchor - number * step
    steps = jnp.ceil(jnp.maximum(jnp.abs(away) - (half_sides - margin), 0.0) / step)
    centre = jnp.round((number + jnp.sign(away) * steps) * step)
    return _cleared(pmap, centre.astype(jnp.int32), half_sides)


def _cleared(pmap: PointMap, centre: Int32[Array, "3"], half_sides: Float[Array, "*d"]) -> PointMap:
    """Return the map with its cube or box around another block, without the blocks outside."""

    def cleared(_: Array, pmap: PointMap) -> PointMap:
        gone = ~_inside(pmap.block, centre, half_sides)[:, None]
        return PointMap(
            jnp.where(gone, FREE, pmap.block),
            jnp.where(gone, jnp.inf, pmap.point),
            None if pmap.off_centre is None else jnp.where(gone, jnp.inf, pmap.off_centre),
            centre,
            None if pmap.count is None else jnp.where(gone, 0.0, pmap.count),
        )

    # a loop of zero or one turns works in place; a conditional would copy the map each time
    return jax.lax.fori_loop(0, jnp.any(centre != pmap.cube).astype(jnp.int32), cleared, pmap)


def insert(
    pmap: PointMap,
    points: Float[Array, "m 3"],
    mask: Bool[Array, " m"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
    half_side: Float[Array, "*d"],
    nearer_by: Float[Array, ""],
) -> tuple[PointMap, PointInsertion]:
    """Keep in each voxel the point nearest to its centre: the one that the map holds, or one of ``points``.

    A map of means takes all of them: each voxel's point becomes the mean of those that were ever put there.

    Args:
        pmap: the map; donate it.
        points: m, in the frame anchored at ``anchor``.
        mask: which rows are real.
        anchor: block whose lower corner is the origin of ``points``.
        voxel_size: edge length of a voxel, m.
        half_side: half of the cube's edge, or of the box's three edges, blocks; points outside are left out.
        nearer_by: a new point replaces the old one if it is nearer to the centre by more than this, m. It has
            no effect on a map of means.
    """
    capacity = pmap.block.shape[0]
    pmap, points = jax.lax.stop_gradient((pmap, points.astype(pmap.point.dtype)))
    cell, local, block = _places(points, mask, anchor, voxel_size)
    inside = mask & _inside(block, pmap.cube, half_side)
    keys, slot = computed_once(claim_slots(pmap.block, block, inside))
    voxel = _voxel_in_block(cell, local)
    target = jnp.where(slot >= 0, slot, capacity)
    offset = [points[:, axis] - (local[:, axis] + 0.5) * EDGE * voxel_size for axis in range(3)]
    if pmap.off_centre is None:
        after, added = _averaged(pmap, keys, target, voxel, offset)
        moved = slot >= 0
    else:
        x, y, z = (points[:, axis] - (cell[:, axis] + 0.5) * voxel_size for axis in range(3))
        after, added = _nearest(pmap, keys, target, voxel, offset, jnp.sqrt(x**2 + y**2 + z**2), nearer_by)
        moved = added
    return after, PointInsertion(added, moved, jnp.sum(inside & (slot < 0), dtype=jnp.int32))


def _nearest(
    pmap: PointMap,
    keys: Int32[Array, "c 3"],
    target: Int32[Array, " m"],
    voxel: Int32[Array, " m"],
    offset: list[Float[Array, " m"]],
    off_centre: Float[Array, " m"],
    nearer_by: Float[Array, ""],
) -> tuple[PointMap, Bool[Array, " m"]]:
    """Return a map in which the point nearest to each voxel's centre is kept, and which of the points are.

    Args:
        pmap: the map before.
        keys: its blocks after new ones were claimed.
        target: slot of each point's block; the capacity where it has none.
        voxel: number of each point's voxel in its block.
        offset: x, y and z of each point from its block's centre, m.
        off_centre: distance of each point from its voxel's centre, m.
        nearer_by: least difference of the distances, m.
    """
    assert pmap.off_centre is not None
    capacity = pmap.block.shape[0]
    held = pmap.off_centre.at[target, voxel].get(mode="fill", fill_value=-jnp.inf)
    nearer = computed_once(off_centre < held - nearer_by)
    target = jnp.where(nearer, target, capacity)
    best = pmap.off_centre.at[target, voxel].min(off_centre, mode="drop")
    added = nearer & (best.at[target, voxel].get(mode="fill", fill_value=-1.0) == off_centre)
    target = computed_once(jnp.where(added, target, capacity))
    point = pmap.point
    for axis in range(3):
        point = point.at[target, axis * VOXELS + voxel].set(offset[axis], mode="drop")
    return PointMap(keys, point, best, pmap.cube), added


def _averaged(
    pmap: PointMap,
    keys: Int32[Array, "c 3"],
    target: Int32[Array, " m"],
    voxel: Int32[Array, " m"],
    offset: list[Float[Array, " m"]],
) -> tuple[PointMap, Bool[Array, " m"]]:
    """Return a map of means with points in it, and which of these are in voxels that were empty.

    Args:
        pmap: the map before.
        keys: its blocks after new ones were claimed.
        target: slot of each point's block; the capacity where it has none.
        voxel: number of each point's voxel in its block.
        offset: x, y and z of each point from its block's centre, m.
    """
    assert pmap.count is not None
    columns = [axis * VOXELS + voxel for axis in range(3)]
    before = pmap.count.at[target, voxel].get(mode="fill", fill_value=1.0)
    held = [pmap.point.at[target, column].get(mode="fill", fill_value=0.0) for column in columns]
    empty = before == 0
    # all is read before anything is written: otherwise XLA copies the tables
    target, empty, held = computed_once((target, empty, [jnp.where(empty, 0.0, one) for one in held]))
    count = pmap.count.at[target, voxel].add(1.0, mode="drop")
    share = computed_once(1 / count.at[target, voxel].get(mode="fill", fill_value=1.0))
    point = pmap.point
    for axis, column in enumerate(columns):
        point = point.at[target, column].set(held[axis], mode="drop")
        point = point.at[target, column].add(share * (offset[axis] - held[axis]), mode="drop")
    return PointMap(keys, point, None, pmap.cube, count), empty


def following(
    pmap: PointMap,
    before: PointMap,
    inserted: PointMap,
    moved: Bool[Array, " m"],
    points: Float[Array, "m 3"],
    anchor: Int32[Array, "3"],
    voxel_size: Float[Array, ""],
) -> PointMap:
    """Return a map after an insertion with the derivative of its points.

    Which voxel keeps which point is a choice, which the derivative holds. A mean is smooth in its points.

    Args:
        pmap: the map after :func:`insert`, and after its cube was moved.
        before: the map before the insertion; its points may have a derivative.
        inserted: the map between the insertion and the move.
        moved: which of the m points are in the map, or entered a mean of it.
        points: as they were inserted, m, in the anchored frame; they may have a derivative.
        anchor: block whose lower corner is the origin of ``points``.
        voxel_size: edge length of a voxel, m.
    """
    still = jax.lax.stop_gradient(pmap)
    choices = jax.lax.stop_gradient((inserted.block, moved, points, anchor, voxel_size))
    if inserted.count is None:
        point = with_derivative_of(still.point, _points_after, before.point, points, choices)
    else:
        counts = jax.lax.stop_gradient((before.count, inserted.count))
        point = with_derivative_of(still.point, _means_after, before.point, points, choices, counts)
    return eqx.tree_at(lambda one: one.point, still, point)


def _points_after(before: Float[Array, "c 81"], points: Float[Array, "m 3"], choices: tuple) -> Array:
    """Return the points after an insertion whose choices are known, those outside of the cube included."""
    block, added, known, anchor, voxel_size = choices
    cell, local, key = _places(known, added, anchor, voxel_size)
    order = jnp.arange(len(added), dtype=jnp.int32)
    # rows of their own for what is left out: only then the derivative is written where the table lies
    slot = jnp.where(added, find_slots(block, key), len(before) + order)
    voxel = _voxel_in_block(cell, local)
    offset = (points - (local + 0.5) * EDGE * voxel_size).astype(before.dtype)
    columns = jnp.arange(3, dtype=jnp.int32)[:, None] * VOXELS + voxel
    return before.at[slot[None], columns].set(offset.T, mode="drop", unique_indices=True)


def _means_after(
    before: Float[Array, "c 81"], points: Float[Array, "m 3"], choices: tuple, counts: tuple
) -> Array:
    """Return the means after an insertion whose choices are known.

    Only the slope is of use: the mean of a voxel that was empty is added to the infinity that stood there.
    """
    block, moved, known, anchor, voxel_size = choices
    cell, local, key = _places(known, moved, anchor, voxel_size)
    slot = jnp.where(moved, find_slots(block, key), len(before))
    voxel = _voxel_in_block(cell, local)
    count, after = (table.at[slot, voxel].get(mode="fill", fill_value=1.0) for table in counts)
    offset = (points - (local + 0.5) * EDGE * voxel_size).astype(before.dtype)
    columns = jnp.arange(3, dtype=jnp.int32)[:, None] * VOXELS + voxel
    held = before.at[slot[None], columns].get(mode="fill", fill_value=0.0)
    change = (offset.T - jnp.where(count == 0, 0.0, held)) / after
    return before.at[slot[None], columns].add(change, mode="drop")


def _places(
    points: Float[Array, "m 3"], mask: Bool[Array, " m"], anchor: Int32[Array, "3"], voxel_size: Array
) -> tuple[Array, Array, Int32[Array, "m 3"]]:
    """Return each point's voxel and block, counted from the anchor, and the block's coordinates."""
    cell = jnp.floor(jnp.where(mask[:, None], points, 0.0) / voxel_size)
    local = jnp.floor(cell / EDGE)
    return cell, local, local.astype(jnp.int32) + anchor


def _voxel_in_block(cell: Float[Array, "m 3"], local: Float[Array, "m 3"]) -> Int32[Array, " m"]:
    x, y, z = jnp.moveaxis((cell - EDGE * local).astype(jnp.int32), -1, 0)
    return jnp.clip((x * EDGE + y) * EDGE + z, 0, VOXELS - 1)


def _inside(
    block: Int32[Array, "m 3"], cube: Int32[Array, "3"], half_side: Float[Array, "*d"]
) -> Bool[Array, " m"]:
    """Return which blocks lie in the cube, or in the box."""
    half_sides = jnp.broadcast_to(half_side, 3)
    # as floats, because the integer coordinates of a free slot would overflow; free slots count as outside
    x, y, z = (
        jnp.abs(block[:, i].astype(jnp.float32) - cube[i].astype(jnp.float32)) <= half_sides[i]
        for i in range(3)
    )
    return x & y & z
