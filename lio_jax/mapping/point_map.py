"""A hashed map of points, one per voxel, in a cube that follows the sensor; it replaces FAST-LIO2's ikd-tree.

Voxels are stored in blocks of 3 x 3 x 3, so one look-up of a key finds 27 of them. A point's coordinates are
relative to its block's centre, and blocks have integer coordinates, so float32 is precise at any distance
from the world's origin. Points are given in an *anchored* frame: the world shifted by a whole number of
blocks, such that the vehicle is near the origin.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.xla import computed_once
from lio_jax.mapping.hash_slots import FREE, claim_slots, free_keys

EDGE = 3
"""Number of voxels along an edge of a block."""
VOXELS = EDGE**3
"""Number of voxels in a block."""


class PointMap(eqx.Module):
    """All blocks, and the cube that bounds the map."""

    block: Int32[Array, "c 3"]
    """Integer coordinates of the block in each slot; ``FREE`` in a free slot."""
    point: Float32[Array, "c 81"]
    """x of the 27 voxels' points, then y, then z, m from the block's centre; infinite in empty voxels."""
    off_centre: Float32[Array, "c 27"]
    """Distance of each point from its voxel's centre, m; infinite in empty voxels."""
    cube: Int32[Array, "3"]
    """The block at the cube's centre."""


class PointInsertion(eqx.Module):
    """The result of an insertion."""

    added: Bool[Array, " m"]
    """True for points that are now in the map."""
    dropped: Int32[Array, ""]
    """Number of points whose block found no free slot, because the table is too full."""


def empty_map(capacity: int) -> PointMap:
    """Return a map of free blocks, with its cube around the world's origin.

    Args:
        capacity: number of blocks, a power of two.
    """
    return PointMap(
        block=free_keys(capacity),
        point=jnp.full((capacity, 3 * VOXELS), jnp.inf, jnp.float32),
        off_centre=jnp.full((capacity, VOXELS), jnp.inf, jnp.float32),
        cube=jnp.zeros(3, jnp.int32),
    )


def move_cube(
    pmap: PointMap, anchor: Int32[Array, "3"], half_side: Float32[Array, ""], margin: Float32[Array, ""]
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
    half_sides: Float32[Array, "3"],
    margin: Float32[Array, ""],
    step: Float32[Array, ""],
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


def _cleared(pmap: PointMap, centre: Int32[Array, "3"], half_sides: Float32[Array, "*d"]) -> PointMap:
    """Return the map with its cube or box around another block, without the blocks outside."""

    def cleared(_: Array, pmap: PointMap) -> PointMap:
        gone = ~_inside(pmap.block, centre, half_sides)[:, None]
        return PointMap(
            jnp.where(gone, FREE, pmap.block),
            jnp.where(gone, jnp.inf, pmap.point),
            jnp.where(gone, jnp.inf, pmap.off_centre),
            centre,
        )

    # a loop of zero or one turns works in place; a conditional would copy the map each time
    return jax.lax.fori_loop(0, jnp.any(centre != pmap.cube).astype(jnp.int32), cleared, pmap)


def insert(
    pmap: PointMap,
    points: Float[Array, "m 3"],
    mask: Bool[Array, " m"],
    anchor: Int32[Array, "3"],
    voxel_size: Float32[Array, ""],
    half_side: Float32[Array, "*d"],
    nearer_by: Float32[Array, ""],
) -> tuple[PointMap, PointInsertion]:
    """Keep in each voxel the point nearest to its centre: the one that the map holds, or one of ``points``.

    Args:
        pmap: the map; donate it.
        points: m, in the frame anchored at ``anchor``.
        mask: which rows are real.
        anchor: block whose lower corner is the origin of ``points``.
        voxel_size: edge length of a voxel, m.
        half_side: half of the cube's edge, or of the box's three edges, blocks; points outside are left out.
        nearer_by: a new point replaces the old one if it is nearer to the centre by more than this, m.
    """
    capacity = pmap.block.shape[0]
    points = points.astype(jnp.float32)
    cell = jnp.floor(jnp.where(mask[:, None], points, 0.0) / voxel_size)
    local = jnp.floor(cell / EDGE)
    block = local.astype(jnp.int32) + anchor
    inside = mask & _inside(block, pmap.cube, half_side)
    keys, slot = computed_once(claim_slots(pmap.block, block, inside))
    x, y, z = jnp.moveaxis((cell - EDGE * local).astype(jnp.int32), -1, 0)
    voxel = jnp.clip((x * EDGE + y) * EDGE + z, 0, VOXELS - 1)
    x, y, z = (points[:, axis] - (cell[:, axis] + 0.5) * voxel_size for axis in range(3))
    off_centre = jnp.sqrt(x**2 + y**2 + z**2)
    target = jnp.where(slot >= 0, slot, capacity)
    held = pmap.off_centre.at[target, voxel].get(mode="fill", fill_value=-jnp.inf)
    nearer = computed_once(off_centre < held - nearer_by)
    target = jnp.where(nearer, target, capacity)
    best = pmap.off_centre.at[target, voxel].min(off_centre, mode="drop")
    added = nearer & (best.at[target, voxel].get(mode="fill", fill_value=-1.0) == off_centre)
    target = computed_once(jnp.where(added, target, capacity))
    point = pmap.point
    for axis in range(3):
        offset = points[:, axis] - (local[:, axis] + 0.5) * EDGE * voxel_size
        point = point.at[target, axis * VOXELS + voxel].set(offset, mode="drop")
    homeless = jnp.sum(inside & (slot < 0), dtype=jnp.int32)
    return PointMap(keys, point, best, pmap.cube), PointInsertion(added, homeless)


def _inside(
    block: Int32[Array, "m 3"], cube: Int32[Array, "3"], half_side: Float32[Array, "*d"]
) -> Bool[Array, " m"]:
    """Return which blocks lie in the cube, or in the box."""
    half_sides = jnp.broadcast_to(half_side, 3)
    # as floats, because the integer coordinates of a free slot would overflow; free slots count as outside
    x, y, z = (
        jnp.abs(block[:, i].astype(jnp.float32) - cube[i].astype(jnp.float32)) <= half_sides[i]
        for i in range(3)
    )
    return x & y & z
