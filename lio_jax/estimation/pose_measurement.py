"""The lidar's pose as a measurement of the navigation state."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from lio_jax.core.error_state import DOF, EXTRINSIC_ROTATION, EXTRINSIC_TRANSLATION, POSITION, ROTATION
from lio_jax.core.geometry import from_blocks, rotation_matrix, skew
from lio_jax.core.types import NavState


def lidar_pose_jacobian(nav: NavState) -> Float[Array, "6 24"]:
    """Return the derivative of T_world_lidar = T_world_imu T_imu_lidar with respect to the error at ``nav``.

    The pose's perturbation is that of the scan-to-map normal equations: in world axes at the sensor's
    position, rotation before translation, R <- Exp(turn) R, t <- t + move.

    The column of the time offset is zero. ``nav`` is the state at the instant of the lidar's stamp, because
    propagation reads the inertial samples at time ``imu.time - time_offset``. So an error of the offset is an
    error of the predicted pose already, and propagation provides their correlation. A column equal to the
    lidar's twist belongs to the other convention, with states on the IMU's clock; here it would count the
    offset twice.

    Args:
        nav: state at which to linearise.
    """
    R_world_imu = rotation_matrix(nav.T_world_imu.rotation())
    R_world_lidar = R_world_imu @ rotation_matrix(nav.T_imu_lidar.rotation())
    turn, move = slice(0, 3), slice(3, 6)
    return from_blocks(
        (6, DOF),
        (turn, ROTATION, R_world_imu),
        (move, ROTATION, -R_world_imu @ skew(nav.T_imu_lidar.translation())),
        (move, POSITION, R_world_imu),
        (turn, EXTRINSIC_ROTATION, R_world_lidar),
        (move, EXTRINSIC_TRANSLATION, R_world_imu),
    )


def imu_pose_jacobian(nav: NavState) -> Float[Array, "6 24"]:
    """Return the error of the IMU's pose that moves the lidar as the error at ``nav`` does.

    With J of :func:`lidar_pose_jacobian` and J_pose its columns of rotation and position it is J_pose^-1 J:
    an error of the extrinsic alone moves the lidar, too. The rows are a right perturbation, rotation (rad)
    before translation (m).

    Args:
        nav: state at which to linearise.
    """
    R_imu_lidar = rotation_matrix(nav.T_imu_lidar.rotation())
    identity = jnp.eye(3, dtype=R_imu_lidar.dtype)
    turn, move = slice(0, 3), slice(3, 6)
    return from_blocks(
        (6, DOF),
        (turn, ROTATION, identity),
        (move, POSITION, identity),
        (turn, EXTRINSIC_ROTATION, R_imu_lidar),
        (move, EXTRINSIC_ROTATION, skew(nav.T_imu_lidar.translation()) @ R_imu_lidar),
        (move, EXTRINSIC_TRANSLATION, identity),
    )


def keep_observed(
    information: Float[Array, "6 6"],
    gradient: Float[Array, "6"],
    arm_squared: Float[Array, ""],
    degeneracy_ratio: Float[Array, ""],
) -> tuple[Float[Array, "6 6"], Float[Array, "6"], Bool[Array, "6"]]:
    """Return a scan match without its degenerate directions, and a mask of these, weakest direction first.

    A direction is degenerate if its information is at most a share of the strongest direction's. Its apparent
    information comes from the map's roughness, so only the prediction determines it (Zhang, Kaess & Singh,
    "On degeneracy of optimization-based state estimation problems", ICRA 2016). Rotations are multiplied by
    the scan's rms lever arm, so that all six directions are in metres.

    Args:
        information: information on the pose of the sensor, rotation (rad) before translation (m).
        gradient: gradient of half the squared error by the same perturbation.
        arm_squared: mean squared distance of the points from the sensor, m^2.
        degeneracy_ratio: the share; 0 drops only directions without any information.
    """
    dtype = information.dtype
    scale = jnp.concatenate([jnp.full(3, 1.0) / jnp.sqrt(arm_squared + 1e-6), jnp.ones(3)]).astype(dtype)
    kept, along, degenerate = _observed(
        scale[:, None] * information * scale, scale * gradient, degeneracy_ratio
    )
    kept = kept / (scale[:, None] * scale)
    return (kept + kept.T) / 2, along / scale, degenerate


@eqx.filter_custom_jvp
def _observed(information: Array, gradient: Array, degeneracy_ratio: Array) -> tuple[Array, Array, Array]:
    """Return the information and the gradient in the other directions, and the mask of degenerate ones."""
    return _decomposed(information, gradient, degeneracy_ratio)[0]


@_observed.def_jvp
def _observed_jvp(primals: tuple, tangents: tuple) -> tuple[tuple, tuple]:
    """Differentiate by the divided differences of eigenvalues (Daleckii & Krein 1965).

    Only differences between a kept and a dropped direction occur, and they cannot vanish. The choice of the
    dropped directions has no derivative.
    """
    (kept, along, degenerate), values, vectors = _decomposed(*primals)
    information_dot, gradient_dot = (
        jnp.zeros_like(primal) if tangent is None else tangent
        for primal, tangent in zip(primals[:2], tangents[:2], strict=True)
    )
    turned = vectors.T @ information_dot @ vectors
    apart = degenerate[:, None] != degenerate
    gap = jnp.where(apart, values[:, None] - values, 1.0)
    strong = jnp.maximum(values[:, None], values)
    kept_dot = jnp.where(apart, strong / jnp.abs(gap), ~degenerate[:, None] & ~degenerate) * turned
    projector_dot = jnp.where(apart, 1 / jnp.abs(gap), 0.0) * turned
    own = vectors.T @ primals[1]
    along_dot = projector_dot @ own + jnp.where(degenerate, 0.0, vectors.T @ gradient_dot)
    return (kept, along, degenerate), (vectors @ kept_dot @ vectors.T, vectors @ along_dot, None)


def _decomposed(information: Array, gradient: Array, degeneracy_ratio: Array) -> tuple[tuple, Array, Array]:
    values, vectors = jnp.linalg.eigh(information)
    degenerate = values <= jnp.maximum(degeneracy_ratio * values[-1], jnp.finfo(values.dtype).tiny)
    kept = (vectors * jnp.where(degenerate, 0.0, values)) @ vectors.T
    along = vectors @ jnp.where(degenerate, 0.0, vectors.T @ gradient)
    return (kept, along, degenerate), values, vectors
