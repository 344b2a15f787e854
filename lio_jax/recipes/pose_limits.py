"""What LIO-SAM does to a matched pose: draw its tilt to the inertial one, and keep it within limits."""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.types import ImuBatch
from lio_jax.estimation.params import SmootherParams


def drawn_to_tilt(T_world_imu: jaxlie.SE3, R_world_imu: jaxlie.SO3, weight: Float[Array, ""]) -> jaxlie.SE3:
    """Return a pose with roll and pitch turned towards those of another attitude by a share of the way.

    Args:
        T_world_imu: the pose.
        R_world_imu: the other attitude, whose heading does not count.
        weight: the share.
    """
    up = rotation_matrix(T_world_imu.rotation())[2]
    other = rotation_matrix(R_world_imu)[2]
    # the shortest turn in the body's frame that takes the other's vertical to the pose's own
    axis, cosine = jnp.cross(other, up), jnp.dot(other, up)
    sine_squared = jnp.sum(axis**2)
    some = sine_squared > 1e-20
    sine = jnp.sqrt(jnp.where(some, sine_squared, 1.0))
    turn = jnp.where(some, axis * jnp.arctan2(sine, cosine) / sine, axis)
    rotation = (T_world_imu.rotation() @ jaxlie.SO3.exp(weight * turn)).normalize()
    return jaxlie.SE3.from_rotation_and_translation(rotation, T_world_imu.translation())


def within_limits(T_world_lidar: jaxlie.SE3, params: SmootherParams) -> jaxlie.SE3:
    """Return a pose with roll, pitch and height cut off at their limits: the lidar's, as in LIO-SAM."""
    angles = T_world_lidar.rotation().as_rpy_radians()
    roll, pitch = (
        jnp.clip(angle, -params.tilt_limit, params.tilt_limit) for angle in (angles.roll, angles.pitch)
    )
    position = T_world_lidar.translation()
    height = jnp.clip(position[2], -params.height_limit, params.height_limit)
    level = jaxlie.SO3.from_rpy_radians(roll, pitch, angles.yaw).wxyz
    # untouched to the last bit where nothing is cut off, and where straight up leaves no angles
    cut = (jnp.abs(angles.roll) > params.tilt_limit) | (jnp.abs(angles.pitch) > params.tilt_limit)
    rotation = jaxlie.SO3(jnp.where(cut, level, T_world_lidar.rotation().wxyz))
    return jaxlie.SE3.from_rotation_and_translation(rotation, position.at[2].set(height))


def measured_attitude(
    imu: ImuBatch, time: Float[Array, ""], predicted: jaxlie.SO3
) -> tuple[jaxlie.SO3, Bool[Array, ""]]:
    """Return the attitude that the IMU itself reports nearest an instant, and whether it reports any.

    Args:
        imu: samples, with or without orientations.
        time: s from the scan's start, on the IMU's clock.
        predicted: taken where there is none.
    """
    if imu.orientation is None:
        return predicted, jnp.array(False)
    usable = imu.mask & (jnp.abs(jnp.sum(imu.orientation**2, axis=1) - 1) < 1e-2)
    nearest = jnp.argmin(jnp.where(usable, jnp.abs(imu.time - time), jnp.inf))
    there = usable[nearest]
    x, y, z, w = imu.orientation[nearest]
    wxyz = jnp.where(there, jnp.stack([w, x, y, z]), predicted.wxyz)
    return jaxlie.SO3(wxyz).normalize(), there
