"""Associations of a scan with the map, kept as long as the scan stays where they were found."""

from collections.abc import Callable
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.geometry import rotation_matrix

_Found = TypeVar("_Found")
"""What the points were associated with, as a pytree of arrays."""


class Association(eqx.Module, Generic[_Found]):
    """What a scan was associated with and the pose at which that was found."""

    found: _Found
    T_world_lidar: jaxlie.SE3
    """Pose of the lidar at which the association was found, m."""
    arm: Float[Array, ""]
    """Root mean square distance of the points from the sensor, m: what a turn moves them by."""


def no_association(nothing: _Found, T_world_lidar: jaxlie.SE3) -> Association[_Found]:
    """Return an association that every pose is too far from."""
    nowhere = jaxlie.SE3.from_rotation_and_translation(
        T_world_lidar.rotation(), jnp.full_like(T_world_lidar.translation(), jnp.inf)
    )
    return Association(nothing, nowhere, jnp.zeros((), nowhere.wxyz_xyz.dtype))


def associated(
    last: Association[_Found],
    find: Callable[[], _Found],
    points: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    T_world_lidar: jaxlie.SE3,
    distance: Float[Array, ""],
) -> Association[_Found]:
    """Return the last association as long as the scan stays near it, else a new one.

    Args:
        last: the association so far.
        find: associates the points at ``T_world_lidar``.
        points: m, lidar frame.
        mask: which points are real.
        T_world_lidar: where the scan is now.
        distance: how far its points may have moved since ``last``, m.
    """
    turn = rotation_matrix(T_world_lidar.rotation()) - rotation_matrix(last.T_world_lidar.rotation())
    move = T_world_lidar.translation() - last.T_world_lidar.translation()
    # |R - R'| = sqrt(2) |angle| for small angles, in Frobenius' norm
    moved = jnp.linalg.norm(move) + last.arm * jnp.linalg.norm(turn) / jnp.sqrt(2.0)

    def anew() -> Association[_Found]:
        squared = jnp.where(mask, jnp.sum(points**2, -1), 0.0)
        arm = jnp.sqrt(jnp.sum(squared) / jnp.maximum(jnp.sum(mask), 1)).astype(last.arm.dtype)
        return Association(find(), T_world_lidar, arm)

    return jax.lax.cond(moved > distance, anew, lambda: last)
