"""Keyframes with their clouds, and which of them the map should hold (LIO-SAM's surrounding keyframes).

Source: Shan et al., "LIO-SAM: Tightly-coupled lidar inertial odometry via smoothing and mapping", IROS 2020,
section III.C, with the choice of its program: the near keyframes, thinned to a spacing, and the latest ones.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Float32, Int, Int32

from lio_jax.core.xla import computed_once
from lio_jax.mapping.params import SubmapParams


class KeyframeCloud(eqx.Module):
    """A scan's corners and surface points, in the lidar frame at the instant of its pose."""

    corner: Float32[Array, "c 3"]
    """Corners, m."""
    corner_mask: Bool[Array, " c"]
    """True where a corner is real."""
    surface: Float32[Array, "s 3"]
    """Surface points, m."""
    surface_mask: Bool[Array, " s"]
    """True where a surface point is real."""


class Keyframes(eqx.Module):
    """Up to k keyframes with their poses; each cloud is in the lidar frame of its keyframe."""

    T_world_lidar: jaxlie.SE3
    """Poses of the k keyframes, m."""
    time: Float[Array, " k"]
    """Time of each keyframe, s, on the caller's clock; -inf in a free row."""
    sparse: Bool[Array, " k"]
    """True for keyframes that were the first within the spacing. The others are used only while they are
    recent."""
    entered: Bool[Array, " k"]
    """True where the map holds the keyframe's points."""
    corner: Float32[Array, "k c 3"]
    """Corners of each keyframe, m, the real ones first."""
    surface: Float32[Array, "k s 3"]
    """Surface points of each keyframe, m, the real ones first."""
    corners: Int32[Array, " k"]
    """Number of real corners of each keyframe."""
    surfaces: Int32[Array, " k"]
    """Number of real surface points of each keyframe."""
    number: Int32[Array, " k"]
    """Running number of each keyframe, from 0; -1 in a free row."""
    last: Int32[Array, ""]
    """Row of the latest keyframe; -1 before the first one."""
    count: Int32[Array, ""]
    """Number of keyframes so far, those without a row included."""


class Page(eqx.Module):
    """A keyframe that has lost its row and comes back."""

    number: Int32[Array, ""]
    """Its running number."""
    T_world_lidar: jaxlie.SE3
    """Its pose, m."""
    time: Float[Array, ""]
    """Its time, s, on the keyframes' clock."""
    cloud: KeyframeCloud
    """Its points."""


def no_keyframes(capacity: int, corners: int, surfaces: int, dtype: jnp.dtype) -> Keyframes:
    """Return a table without keyframes.

    Args:
        capacity: largest number of keyframes.
        corners: capacity for each keyframe's corners.
        surfaces: capacity for each keyframe's surface points.
        dtype: dtype of poses and times.
    """
    identity = jnp.tile(jnp.array([1, 0, 0, 0, 0, 0, 0], dtype), (capacity, 1))
    none = jnp.zeros(capacity, jnp.int32)
    return Keyframes(
        T_world_lidar=jaxlie.SE3(identity),
        time=jnp.full(capacity, -jnp.inf, dtype),
        sparse=jnp.zeros(capacity, bool),
        entered=jnp.zeros(capacity, bool),
        corner=jnp.zeros((capacity, corners, 3), jnp.float32),
        surface=jnp.zeros((capacity, surfaces, 3), jnp.float32),
        corners=none,
        surfaces=none,
        number=none - 1,
        last=jnp.int32(-1),
        count=jnp.int32(0),
    )


def is_due(keyframes: Keyframes, T_world_lidar: jaxlie.SE3, params: SubmapParams) -> Bool[Array, ""]:
    """Return whether a pose is far enough from the last keyframe to become a keyframe.

    Args:
        keyframes: all so far.
        T_world_lidar: the pose.
        params: ``keyframe_distance`` (m) and ``keyframe_angle`` (rad).
    """
    latest = jaxlie.SE3(keyframes.T_world_lidar.wxyz_xyz[keyframes.last])
    between = latest.inverse() @ T_world_lidar
    moved = jnp.linalg.norm(between.translation()) >= params.keyframe_distance
    turned = jnp.linalg.norm(between.rotation().log()) >= params.keyframe_angle
    return (keyframes.last < 0) | moved | turned


def with_keyframe(
    keyframes: Keyframes,
    keep: Bool[Array, ""],
    T_world_lidar: jaxlie.SE3,
    time: Float[Array, ""],
    cloud: KeyframeCloud,
    params: SubmapParams,
) -> Keyframes:
    """Return the keyframes with one more, which counts as entered into the map.

    The new keyframe takes a free row. If there is none, it replaces the oldest keyframe that is neither
    sparse nor recent, and if there is none of these, the keyframe that is farthest away.

    Args:
        keyframes: all so far; donate them.
        keep: whether there is a keyframe to add.
        T_world_lidar: its pose.
        time: its time, s, not before that of the last keyframe.
        cloud: its points.
        params: ``spacing`` (m) of sparse keyframes, and the age ``recent`` (s).
    """
    capacity = len(keyframes.time)
    distance = _distance(keyframes, T_world_lidar)
    alone = ~jnp.any(keyframes.sparse & ~_is_free(keyframes) & (distance < params.spacing))
    row = jnp.argmax(_dispensable(keyframes, time - keyframes.time, distance, time, params))
    row = jnp.where(keep, row, capacity).astype(jnp.int32)
    added = _with_row(keyframes, row, T_world_lidar, time, alone, True, cloud, keyframes.count)
    return dataclasses.replace(
        added,
        last=jnp.where(keep, row, keyframes.last),
        count=keyframes.count + keep.astype(jnp.int32),
    )


def with_page(keyframes: Keyframes, page: Page, T_world_lidar: jaxlie.SE3, params: SubmapParams) -> Keyframes:
    """Return the keyframes with one that comes back, which the map does not hold yet.

    It takes a free row, or that of a keyframe that is neither sparse nor recent, or of one that is farther
    away than itself. Nothing changes where there is no such row, or where the keyframe has a row already.

    Args:
        keyframes: all that have a row; donate them.
        page: the keyframe; it counts as sparse.
        T_world_lidar: current pose.
        params: ``recent`` (s).
    """
    now = keyframes.time[keyframes.last]
    distance = _distance(keyframes, T_world_lidar)
    is_recent = keyframes.time >= now - params.recent
    order = _dispensable(keyframes, distance, jnp.where(is_recent, -jnp.inf, distance), now, params)
    there = jnp.linalg.norm(page.T_world_lidar.translation() - T_world_lidar.translation())
    row = jnp.argmax(order)
    fits = (order[row] > there) & ~jnp.any(keyframes.number == page.number)
    row = jnp.where(fits, row, len(keyframes.time)).astype(jnp.int32)
    return _with_row(keyframes, row, page.T_world_lidar, page.time, True, False, page.cloud, page.number)


def _with_row(
    keyframes: Keyframes,
    row: Int32[Array, ""],
    T_world_lidar: jaxlie.SE3,
    time: Float[Array, ""],
    sparse: Bool[Array, ""] | bool,
    entered: bool,
    cloud: KeyframeCloud,
    number: Int32[Array, ""],
) -> Keyframes:
    """Return the keyframes with another one in a row; a row beyond the capacity changes nothing."""
    corner, corners = _compacted(cloud.corner, cloud.corner_mask)
    surface, surfaces = _compacted(cloud.surface, cloud.surface_mask)

    def put(rows: Array, value: Array | bool) -> Array:
        return rows.at[row].set(value, mode="drop")

    return Keyframes(
        T_world_lidar=jaxlie.SE3(put(keyframes.T_world_lidar.wxyz_xyz, T_world_lidar.wxyz_xyz)),
        time=put(keyframes.time, time),
        sparse=put(keyframes.sparse, sparse),
        entered=put(keyframes.entered, entered),
        corner=put(keyframes.corner, corner),
        surface=put(keyframes.surface, surface),
        corners=put(keyframes.corners, corners),
        surfaces=put(keyframes.surfaces, surfaces),
        number=put(keyframes.number, number),
        last=keyframes.last,
        count=keyframes.count,
    )


def next_to_enter(
    keyframes: Keyframes, T_world_lidar: jaxlie.SE3, time: Float[Array, ""], params: SubmapParams
) -> tuple[Keyframes, jaxlie.SE3, KeyframeCloud]:
    """Return the nearest keyframe that the map should hold but does not hold any more.

    Args:
        keyframes: all so far; donate them.
        T_world_lidar: current pose.
        time: current time, s.
        params: ``radius`` (m) of the keyframes that the map holds, and the age ``recent`` (s).

    Returns:
        The keyframes with that one marked as entered, its pose, and its points. All points are masked if
        there is no such keyframe.
    """
    capacity = len(keyframes.time)
    distance = _distance(keyframes, T_world_lidar)
    near = (distance <= params.radius) & ~jnp.isinf(keyframes.time)
    # the map may have cleared the points of keyframes that are far away: these have to enter again
    entered = keyframes.entered & (near | (keyframes.time >= time - params.recent))
    wanted = near & keyframes.sparse & ~entered
    row = jnp.argmin(jnp.where(wanted, distance, jnp.inf))
    there = wanted[row]
    entered = entered.at[jnp.where(there, row, capacity)].set(True, mode="drop")
    pose, cloud = keyframe_at(keyframes, row, there)
    return eqx.tree_at(lambda k: k.entered, keyframes, entered), pose, cloud


def keyframe_at(
    keyframes: Keyframes, row: Int[Array, ""], there: Bool[Array, ""] | bool = True
) -> tuple[jaxlie.SE3, KeyframeCloud]:
    """Return the pose and the points of the keyframe in a row.

    Args:
        keyframes: all that have a row.
        row: of the keyframe.
        there: False: all points are masked.
    """
    corner, surface = keyframes.corner[row], keyframes.surface[row]
    cloud = KeyframeCloud(
        corner=corner,
        corner_mask=there & (jnp.arange(len(corner)) < keyframes.corners[row]),
        surface=surface,
        surface_mask=there & (jnp.arange(len(surface)) < keyframes.surfaces[row]),
    )
    return jaxlie.SE3(keyframes.T_world_lidar.wxyz_xyz[row]), cloud


def with_poses(
    keyframes: Keyframes,
    T_world_lidar: jaxlie.SE3,
    here: jaxlie.SE3,
    time: Float[Array, ""],
    params: SubmapParams,
) -> Keyframes:
    """Return the keyframes at other poses; those that a new map should hold count as entered.

    These are the sparse ones within the radius, and the recent ones.

    Args:
        keyframes: all that have a row; donate them.
        T_world_lidar: new poses of the k rows, m.
        here: current pose, in the same frame.
        time: current time, s.
        params: ``radius`` (m) and the age ``recent`` (s).
    """
    moved = dataclasses.replace(keyframes, T_world_lidar=T_world_lidar)
    near = moved.sparse & (_distance(moved, here) <= params.radius)
    entered = ~_is_free(moved) & (near | (moved.time >= time - params.recent))
    return dataclasses.replace(moved, entered=entered)


_SPENT = 1e9
"""Added to the order of a keyframe that the map no longer needs: more than any distance or age."""


def _dispensable(
    keyframes: Keyframes,
    of_spent: Float[Array, " k"],
    of_others: Float[Array, " k"],
    time: Float[Array, ""],
    params: SubmapParams,
) -> Float[Array, " k"]:
    """Return an order in which rows are given away, the largest first: free rows, spent keyframes, others.

    Args:
        keyframes: all that have a row.
        of_spent: order among the keyframes that are neither sparse nor recent.
        of_others: order among the others.
        time: current time, s.
        params: ``recent`` (s).
    """
    spent = ~keyframes.sparse & (keyframes.time < time - params.recent)
    return jnp.where(_is_free(keyframes), jnp.inf, jnp.where(spent, _SPENT + of_spent, of_others))


def _is_free(keyframes: Keyframes) -> Bool[Array, " k"]:
    return jnp.isinf(keyframes.time)


def _distance(keyframes: Keyframes, T_world_lidar: jaxlie.SE3) -> Float[Array, " k"]:
    away = keyframes.T_world_lidar.translation() - T_world_lidar.translation()
    return jnp.linalg.norm(away, axis=1)


def _compacted(
    points: Float32[Array, "n 3"], mask: Bool[Array, " n"]
) -> tuple[Float32[Array, "n 3"], Int32[Array, ""]]:
    """Return the points with the real ones first, and the number of real ones."""
    count = jnp.cumsum(mask, dtype=jnp.int32)
    place = computed_once(jnp.where(mask, count - 1, len(mask)))
    return jnp.zeros_like(points).at[place].set(points, mode="drop"), count[-1]
