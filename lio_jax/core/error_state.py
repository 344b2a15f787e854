"""The 24-dimensional error state of the navigation state: its order, retraction and inverse.

The error is a right perturbation: R Exp(dtheta), p + R dp, v + R dv (gtsam's NavState). The errors of the
biases, of the extrinsic translation and of the time offset are added. Gravity turns on its sphere:
g <- Exp(B du) g, where the columns of B are a basis of the plane normal to g.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.types import NavState

DOF = 24
ROTATION = slice(0, 3)
"""Rotation of T_world_imu, rad, IMU frame."""
POSITION = slice(3, 6)
"""Position of T_world_imu, m, IMU frame."""
VELOCITY = slice(6, 9)
"""Velocity of the IMU's origin, m/s, IMU frame."""
GYRO_BIAS = slice(9, 12)
"""Bias of the gyroscope, rad/s, IMU frame."""
ACCEL_BIAS = slice(12, 15)
"""Bias of the accelerometer, m/s^2, IMU frame."""
BIASES = slice(9, 15)
"""Bias of the gyroscope (rad/s), then of the accelerometer (m/s^2), IMU frame."""
GRAVITY = slice(15, 17)
"""Direction of gravity, rad, about the two axes of :func:`sphere_basis`."""
EXTRINSIC_ROTATION = slice(17, 20)
"""Rotation of T_imu_lidar, rad, lidar frame."""
EXTRINSIC_TRANSLATION = slice(20, 23)
"""Translation of T_imu_lidar, m, IMU frame."""
TIME_OFFSET = slice(23, 24)
"""Lag of the lidar's clock, s."""
LAG = slice(24, 30)
"""Error of the pose at a sweep's end less the mean of that error over the sweep, the last six entries of
:class:`SweptState`'s error: rotation (rad), then position (m), IMU frame."""


def retract(nav: NavState, error: Float[Array, "24"]) -> NavState:
    """Return the state ``nav [+] error``.

    Args:
        nav: the state to perturb.
        error: in the order, units and frames of this module's slices.
    """
    rotation, extrinsic = nav.T_world_imu.rotation(), nav.T_imu_lidar.rotation()
    fall = sphere_basis(nav.gravity) @ error[GRAVITY]
    # in batches, because each operation on its own compiles a kernel
    turns = jaxlie.SO3.exp(jnp.stack([error[ROTATION], error[EXTRINSIC_ROTATION], fall])).wxyz
    turned = _unit(jaxlie.SO3(jnp.stack([rotation.wxyz, extrinsic.wxyz])) @ jaxlie.SO3(turns[:2])).wxyz
    moved, sped = jnp.stack([error[POSITION], error[VELOCITY]]) @ rotation_matrix(rotation).T
    return NavState(
        T_world_imu=jaxlie.SE3(jnp.concatenate([turned[0], nav.T_world_imu.translation() + moved])),
        velocity=nav.velocity + sped,
        gyro_bias=nav.gyro_bias + error[GYRO_BIAS],
        accel_bias=nav.accel_bias + error[ACCEL_BIAS],
        gravity=rotation_matrix(jaxlie.SO3(turns[2])) @ nav.gravity,
        T_imu_lidar=jaxlie.SE3(
            jnp.concatenate([turned[1], nav.T_imu_lidar.translation() + error[EXTRINSIC_TRANSLATION]])
        ),
        time_offset=nav.time_offset + error[TIME_OFFSET][0],
    )


def local(origin: NavState, nav: NavState) -> Float[Array, "24"]:
    """Return the error ``nav [-] origin``, for which ``retract(origin, error) == nav``.

    Args:
        origin: the state to which the error refers.
        nav: the other state; its gravity is of the same magnitude as that of ``origin``.

    Returns:
        The error in the order, units and frames of this module's slices.
    """
    rotation = origin.T_world_imu.rotation()
    back = rotation.inverse()
    extrinsic = origin.T_imu_lidar.rotation().inverse() @ nav.T_imu_lidar.rotation()
    return jnp.concatenate(
        [
            (back @ nav.T_world_imu.rotation()).log(),
            back @ (nav.T_world_imu.translation() - origin.T_world_imu.translation()),
            back @ (nav.velocity - origin.velocity),
            nav.gyro_bias - origin.gyro_bias,
            nav.accel_bias - origin.accel_bias,
            sphere_basis(origin.gravity).T @ _turn_between(origin.gravity, nav.gravity),
            extrinsic.log(),
            nav.T_imu_lidar.translation() - origin.T_imu_lidar.translation(),
            (nav.time_offset - origin.time_offset)[None],
        ]
    )


def sphere_basis(gravity: Float[Array, "3"]) -> Float[Array, "3 2"]:
    """Return two unit axes normal to ``gravity`` and to each other, which vary smoothly near the vertical.

    Args:
        gravity: m/s^2, in world; it must not point straight up, where the axes are singular.
    """
    up = -gravity / jnp.linalg.norm(gravity)
    # the rotation that takes +z to up, applied to x and y; singular only for gravity that points up
    axes = np.eye(3, dtype=up.dtype)
    between = up + axes[2]
    return jnp.outer(-between / between[2], up[:2]) + axes[:, :2]


def _unit(rotation: jaxlie.SO3) -> jaxlie.SO3:
    """Return the rotations at unit length; where the length is one up to rounding, no bit changes."""
    square = jnp.sum(rotation.wxyz**2, axis=-1, keepdims=True)
    # dividing by a norm that is one but for rounding would let a frozen rotation's last bits wander
    as_it_is = jnp.abs(square - 1) < 8 * jnp.finfo(square.dtype).eps
    return jaxlie.SO3(rotation.wxyz / jnp.where(as_it_is, 1.0, jnp.sqrt(square)))


def _turn_between(start: Float[Array, "3"], end: Float[Array, "3"]) -> Float[Array, "3"]:
    """Return the rotation vector that takes the direction of ``start`` to that of ``end``."""
    normal = jnp.cross(start, end)
    square = jnp.sum(normal**2)
    # the ratio of angle and sine tends to 1 where the directions agree; two selections keep gradients finite
    tiny = square < jnp.finfo(square.dtype).tiny ** 0.5
    sine = jnp.sqrt(jnp.where(tiny, 1.0, square))
    angle = jnp.arctan2(sine, jnp.dot(start, end))
    return jnp.where(tiny, normal / jnp.sum(start**2), normal * angle / sine)


class NavEstimate(eqx.Module):
    """A navigation state and the covariance of its error."""

    nav: NavState
    """The estimated state."""
    covariance: Float[Array, "24 24"]
    """Covariance of the error state, in the order, units and frames of this module's slices."""


class SweptState(eqx.Module):
    """A navigation state at a sweep's end, with the joint covariance of its error and of ``LAG``."""

    nav: NavState
    """The estimated state at the sweep's end."""
    covariance: Float[Array, "30 30"]
    """Covariance of the 24 entries of the error state, then of the six of ``LAG``."""
    transition: Float[Array, "30 24"]
    """Derivative of these entries by the error state from which the state was propagated."""

    @staticmethod
    def at_once(state: NavEstimate) -> "SweptState":
        """Return ``state`` for a sweep without duration: its ``LAG`` is zero without uncertainty."""
        covariance = jnp.pad(state.covariance, (0, LAG.stop - LAG.start))
        return SweptState(state.nav, covariance, jnp.eye(LAG.stop, DOF, dtype=covariance.dtype))

    def at_end(self) -> NavEstimate:
        """Return the state at the sweep's end, without ``LAG``."""
        return NavEstimate(self.nav, self.covariance[:DOF, :DOF])
