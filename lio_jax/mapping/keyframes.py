"""Keyframes with their clouds, and which of them the map should hold (LIO-SAM's surrounding keyframes).

Shan et al., "LIO-SAM: Tightly-coupled lidar inertial odometry via smoothing and mapping", IROS 2020, section
III.C, as its program selects them: near ones, one per so many metres, and the latest.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.xla import computed_once
from lio_jax.mapping.params import SubmapParams


class KeyframeCloud(eqx.Module):
    """A scan's corners and surface points, m, lidar frame of the instant its pose refers to."""

    corner: Float32[Array, "c 3"]
    corner_mask: Bool[Array, " c"]
    surface: Float32[Array, "s 3"]
    surface_mask: Bool[Array, " s"]


class Keyframes(eqx.Module):
    """Up to k keyframes; poses are theirs, clouds stay in their own frames."""

    T_world_lidar: jaxlie.SE3
    """k."""
    time: Float[Array, " k"]
    """s, on the clock of those who add them; -inf in a free row."""
    sparse: Bool[Array, " k"]
    """Which were the first of their surroundings: the others are used as long as they are recent."""
    entered: Bool[Array, " k"]
    """Which have their points in the map."""
    corner: Float32[Array, "k c 3"]
    surface: Float32[Array, "k s 3"]
    corners: Int32[Array, " k"]
    """How many of a row's corners are real: they come first."""
    surfaces: Int32[Array, " k"]
    last: Int32[Array, ""]
    """Row of the latest, -1 before the first."""


def no_keyframes(capacity: int, corners: int, surfaces: int, dtype: jnp.dtype) -> Keyframes:
    """Return room for so many keyframes with so many points each."""
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
        last=jnp.int32(-1),
    )


def is_due(keyframes: Keyframes, T_world_lidar: jaxlie.SE3, params: SubmapParams) -> Bool[Array, ""]:
    """Return whether a pose is far enough from the last keyframe's to become one."""
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
    """Return the keyframes with one more, whose points the map is about to get.

    It takes a free row, else that of the oldest one that is neither sparse nor recent, else the oldest's.

    Args:
        keyframes: donate them.
        keep: whether there is one to add.
        T_world_lidar: its pose.
        time: s, not before that of the last.
        cloud: its points.
        params: spacing, and what is recent.
    """
    capacity = len(keyframes.time)
    free = jnp.isinf(keyframes.time)
    alone = ~jnp.any(keyframes.sparse & ~free & (_distance(keyframes, T_world_lidar) < params.spacing))
    spent = ~keyframes.sparse & (keyframes.time < time - params.recent)
    since = jnp.where(free, -jnp.inf, keyframes.time - jnp.where(spent, 2 * (jnp.abs(time) + 1), 0.0))
    row = jnp.where(keep, jnp.argmin(since), capacity).astype(jnp.int32)
    corner, corners = _compacted(cloud.corner, cloud.corner_mask)
    surface, surfaces = _compacted(cloud.surface, cloud.surface_mask)

    def put(rows: Array, value: Array | bool) -> Array:
        return rows.at[row].set(value, mode="drop")

    return Keyframes(
        T_world_lidar=jaxlie.SE3(put(keyframes.T_world_lidar.wxyz_xyz, T_world_lidar.wxyz_xyz)),
        time=put(keyframes.time, time),
        sparse=put(keyframes.sparse, alone),
        entered=put(keyframes.entered, True),
        corner=put(keyframes.corner, corner),
        surface=put(keyframes.surface, surface),
        corners=put(keyframes.corners, corners),
        surfaces=put(keyframes.surfaces, surfaces),
        last=jnp.where(keep, row, keyframes.last),
    )


def next_to_enter(
    keyframes: Keyframes, T_world_lidar: jaxlie.SE3, time: Float[Array, ""], params: SubmapParams
) -> tuple[Keyframes, jaxlie.SE3, KeyframeCloud]:
    """Return a keyframe that the map should hold but does not: one that the vehicle comes back to.

    Args:
        keyframes: donate them.
        T_world_lidar: where the vehicle is.
        time: now, s.
        params: radius, and what is recent.

    Returns:
        The keyframes with that one marked as entered, its pose and its points, masked where there is none.
    """
    capacity = len(keyframes.time)
    distance = _distance(keyframes, T_world_lidar)
    near = (distance <= params.radius) & ~jnp.isinf(keyframes.time)
    # what falls behind may be cleared from the map: it has to enter anew
    entered = keyframes.entered & (near | (keyframes.time >= time - params.recent))
    wanted = near & keyframes.sparse & ~entered
    row = jnp.argmin(jnp.where(wanted, distance, jnp.inf))
    there = wanted[row]
    entered = entered.at[jnp.where(there, row, capacity)].set(True, mode="drop")
    corner, surface = keyframes.corner[row], keyframes.surface[row]
    cloud = KeyframeCloud(
        corner=corner,
        corner_mask=there & (jnp.arange(len(corner)) < keyframes.corners[row]),
        surface=surface,
        surface_mask=there & (jnp.arange(len(surface)) < keyframes.surfaces[row]),
    )
    pose = jaxlie.SE3(keyframes.T_world_lidar.wxyz_xyz[row])
    return eqx.tree_at(lambda k: k.entered, keyframes, entered), pose, cloud


def _distance(keyframes: Keyframes, T_world_lidar: jaxlie.SE3) -> Float[Array, " k"]:
    away = keyframes.T_world_lidar.translation() - T_world_lidar.translation()
    return jnp.linalg.norm(away, axis=1)


def _compacted(
    points: Float32[Array, "n 3"], mask: Bool[Array, " n"]
) -> tuple[Float32[Array, "n 3"], Int32[Array, ""]]:
    """Return the real points first, and their number."""
    count = jnp.cumsum(mask, dtype=jnp.int32)
    place = computed_once(jnp.where(mask, count - 1, len(mask)))
    return jnp.zeros_like(points).at[place].set(points, mode="drop"), count[-1]
