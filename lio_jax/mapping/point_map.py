"""A hashed map of points, one per voxel, inside a cube that follows the sensor (FAST-LIO2's ikd-tree).

Voxels are stored in blocks of 3 x 3 x 3, so that one look-up of a key brings 27 of them. Coordinates inside a
block are kept relative to its centre and blocks as integers, so float32 stays precise however far the vehicle
drives. Points are given in an *anchored* frame: the world shifted by a whole number of blocks, such that the
vehicle is near its origin.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.xla import computed_once
from lio_jax.mapping.hash_slots import FREE, claim_slots, free_keys

EDGE = 3
"""Voxels per edge of a block."""
VOXELS = EDGE**3
"""Voxels per block."""


class PointMap(eqx.Module):
    """All blocks, and the cube outside of which nothing is kept."""

    block: Int32[Array, "c 3"]
    """Which block a slot holds; ``FREE`` in a free slot."""
    point: Float32[Array, "c 81"]
    """x of the 27 voxels' points, then y, then z, m from the block's centre; infinite in empty voxels."""
    off_centre: Float32[Array, "c 27"]
    """Distance of each point from its voxel's centre, m; infinite in empty voxels."""
    cube: Int32[Array, "3"]
    """The block at the cube's centre."""


class Insertion(eqx.Module):
    """What an insertion did."""

    added: Bool[Array, " m"]
    """Which points are now in the map."""
    dropped: Int32[Array, ""]
    """Points whose block found no free slot: the table is too full."""


def empty_map(capacity: int) -> PointMap:
    """Return a map of ``capacity`` free blocks (a power of two), its cube around the world's origin."""
    return PointMap(
        block=free_keys(capacity),
        point=jnp.full((capacity, 3 * VOXELS), jnp.inf, jnp.float32),
        off_centre=jnp.full((capacity, VOXELS), jnp.inf, jnp.float32),
        cube=jnp.zeros(3, jnp.int32),
    )


def move_cube(
    pmap: PointMap, anchor: Int32[Array, "3"], half_side: Float32[Array, ""], margin: Float32[Array, ""]
) -> PointMap:
    """Move the cube to the sensor along each axis on which a face is near, and delete what falls out.

    Args:
        pmap: donate it.
        anchor: the block that the sensor is in.
        half_side: half the cube's edge, in blocks.
        margin: the sensor's least distance from a face, in blocks.
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
    """Shift a box, which takes the cube's place, by as many steps as keep its faces away from the sensor.

    Args:
        pmap: donate it.
        anchor: the block that the sensor is in.
        half_sides: half the box's edges along x, y and z, in blocks.
        margin: the sensor's least distance from a face, in blocks.
        step: in blocks; the box's centre is a multiple of it, rounded to a block.
    """
    number = jnp.round(pmap.cube / step)
    away = anchor - number * step
    steps = jnp.ceil(jnp.maximum(jnp.abs(away) - (half_sides - margin), 0.0) / step)
    centre = jnp.round((number + jnp.sign(away) * steps) * step)
    return _cleared(pmap, centre.astype(jnp.int32), half_sides)


def _cleared(pmap: PointMap, centre: Int32[Array, "3"], half_sides: Float32[Array, "*d"]) -> PointMap:
    """Return the map around another block, without what lies outside."""

    def cleared(_: Array, pmap: PointMap) -> PointMap:
        gone = ~_inside(pmap.block, centre, half_sides)[:, None]
        return PointMap(
            jnp.where(gone, FREE, pmap.block),
            jnp.where(gone, jnp.inf, pmap.point),
            jnp.where(gone, jnp.inf, pmap.off_centre),
            centre,
        )

    # a loop of no or one turn works in place, where a conditional would copy the map each time
    return jax.lax.fori_loop(0, jnp.any(centre != pmap.cube).astype(jnp.int32), cleared, pmap)


def insert(
    pmap: PointMap,
    points: Float[Array, "m 3"],
    mask: Bool[Array, " m"],
    anchor: Int32[Array, "3"],
    voxel_size: Float32[Array, ""],
    half_side: Float32[Array, "*d"],
    nearer_by: Float32[Array, ""],
) -> tuple[PointMap, Insertion]:
    """Keep, of each voxel, the point nearest its centre: the one held or one of ``points``.

    Args:
        pmap: donate it.
        points: m, in the frame anchored at ``anchor``.
        mask: which rows are real.
        anchor: block whose lower corner is the origin of ``points``.
        voxel_size: edge length of a voxel, m.
        half_side: half the cube's edge, in blocks: points outside are left out. Of a box, three of them.
        nearer_by: a point held is replaced by one that is nearer by more than this, m.
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
    return PointMap(keys, point, best, pmap.cube), Insertion(added, homeless)


def _inside(
    block: Int32[Array, "m 3"], cube: Int32[Array, "3"], half_side: Float32[Array, "*d"]
) -> Bool[Array, " m"]:
    """Return which blocks lie in the cube, or in the box."""
    half_sides = jnp.broadcast_to(half_side, 3)
    # in floats, because a free slot's coordinates would overflow; they count as outside
    x, y, z = (
        jnp.abs(block[:, i].astype(jnp.float32) - cube[i].astype(jnp.float32)) <= half_sides[i]
        for i in range(3)
    )
    return x & y & z
