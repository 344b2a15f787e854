"""The first navigation state of a vehicle that is already moving, from scan matching and inertial samples.

After Qin et al., "VINS-Mono" (T-RO 2018), section V-B: first the gyro bias that makes the integrated
rotations agree with the matched ones, then velocities, gravity and, weakly, the accelerometer bias.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.error_state import (
    ACCEL_BIAS,
    DOF,
    EXTRINSIC_ROTATION,
    EXTRINSIC_TRANSLATION,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    TIME_OFFSET,
    VELOCITY,
    Uncertain,
)
from lio_jax.core.params import ImuParams, InitialParams
from lio_jax.core.rotation import rotation_matrix, skew
from lio_jax.core.types import ImuBatch, initial_nav_state
from lio_jax.imu.gravity_alignment import Aligned, Scale, align, axes_across, gyro_bias_share
from lio_jax.imu.initialise import levelled
from lio_jax.imu.preintegration import Preintegrated, preintegrate_parallel
from lio_jax.imu.sampling import sample_intervals

GYRO_ROUNDS = 3
MAX_RESIDUAL = 3.0
"""Largest misfit, in standard deviations, with which poses and samples are taken to agree."""
MAX_TILT_SIGMA = 0.1
"""Largest uncertainty of gravity's direction of a useful start, rad."""


class MovingStart(eqx.Module):
    """A first navigation state at the last of the matched poses."""

    start: Uncertain
    """In a world with z up, origin and heading at the first IMU pose."""
    T_level_world: jaxlie.SE3
    """From the world of the matched poses to the level one: moves a map along."""
    velocity: Float[Array, "k 3"]
    """At each pose, in the level world, m/s."""
    residual: Float[Array, ""]
    """Misfit of poses and samples in standard deviations; about 1 where noise is as stated."""
    tilt_sigma: Float[Array, ""]
    """Standard deviation of gravity's direction, rad."""
    is_good: Bool[Array, ""]
    """Whether the start is to be relied on."""


def initialise_moving(
    imu: ImuBatch,
    start: Float[Array, " n"],
    end: Float[Array, " n"],
    T_world_lidar: jaxlie.SE3,
    params: ImuParams,
    initial: InitialParams,
    T_imu_lidar: jaxlie.SE3,
    time_offset: Float[Array, ""],
    rotation_sigma: Float[Array, ""],
    translation_sigma: Float[Array, ""],
) -> MovingStart:
    """Return the state at the last of n + 1 poses that agrees with the samples of the n spans between them.

    The accelerometer bias follows weakly, as far as the vehicle turns; it is held near zero by its prior. Ten
    poses over a second level a drive to the accelerometer bias over gravity.

    Args:
        imu: n batches (leading axis), each with the samples of its span.
        start: of each span in its batch's time, s; the instant of pose i.
        end: of each span, s; the instant of pose i + 1.
        T_world_lidar: n + 1 poses of scan matching, any world.
        params: noise densities and gravity.
        initial: prior sigmas of the biases; zero keeps a bias at zero.
        T_imu_lidar: extrinsic.
        time_offset: of the lidar's clock, s.
        rotation_sigma: of each pose, rad, per axis.
        translation_sigma: of each pose, m, per axis.
    """
    dtype = time_offset.dtype
    duration = jnp.maximum(end - start, 1e-4)
    last = T_world_lidar.translation()[-1]
    # near the last pose, for single precision
    near = jaxlie.SE3(T_world_lidar.wxyz_xyz.at[:, 4:].add(-last).astype(dtype))
    T_near_imu = jax.vmap(lambda pose: pose @ T_imu_lidar.inverse())(near)
    matrices = rotation_matrix(T_near_imu.rotation())

    def integrated(gyro_bias: Float[Array, "3"]) -> Preintegrated:
        def one(samples: ImuBatch, begin: Array, finish: Array) -> Preintegrated:
            pieces = sample_intervals(samples, time_offset, begin, finish)
            return preintegrate_parallel(pieces, gyro_bias, jnp.zeros(3, dtype), params)

        return jax.vmap(one)(imu, start, end)

    def round_of(share: Float[Array, "3"], _: None) -> tuple[Float[Array, "3"], tuple]:
        gain = integrated(initial.gyro_bias_sigma * share)
        share, covariance, cost = gyro_bias_share(
            gain, T_near_imu.rotation(), duration, share, params, initial, rotation_sigma
        )
        return share, (gain, covariance, cost)

    # loops of the compiled program: written out they compile for a minute
    share, rounds = jax.lax.scan(round_of, jnp.zeros(3, dtype), None, GYRO_ROUNDS)
    gain, gyro_covariance, gyro_cost = jax.tree.map(lambda leaf: leaf[-1], rounds)
    scale = Scale(
        pose=translation_sigma,
        speed=jnp.hypot(
            params.accel_noise * jnp.sqrt(duration), rotation_sigma * jnp.linalg.norm(gain.velocity, axis=1)
        ),
        way=params.accel_noise * jnp.sqrt(duration**3 / 12),
        accel_bias=initial.accel_bias_sigma,
    )
    solved, covariance, cost = align(gain, T_near_imu, matrices, duration, params.gravity, scale)

    up = -solved.gravity / params.gravity
    first = T_near_imu.wxyz_xyz[0]
    T_level_near = jaxlie.SE3.from_rotation(levelled(matrices[0].T @ up)) @ jaxlie.SE3(first).inverse()
    spans = duration.shape[0]
    freedom = 6 * spans - 8
    residual = jnp.sqrt((gyro_cost + cost) / max(freedom, 1))
    tilt_sigma = jnp.sqrt(jnp.max(jnp.diagonal(covariance)[-2:]))
    rotation = T_level_near.rotation() @ jaxlie.SO3(T_near_imu.rotation().wxyz[-1])
    nav = eqx.tree_at(
        lambda n: (n.T_world_imu, n.velocity, n.gyro_bias, n.accel_bias, n.gravity, n.time_offset),
        initial_nav_state(T_imu_lidar),
        (
            jaxlie.SE3.from_rotation_and_translation(
                rotation.normalize(), T_level_near @ solved.position[-1]
            ),
            T_level_near.rotation() @ solved.velocity[-1],
            initial.gyro_bias_sigma * share,
            initial.accel_bias_sigma * solved.accel_share,
            jnp.array([0.0, 0.0, -1.0]) * params.gravity,
            time_offset,
        ),
    )
    error = _error_covariance(covariance, matrices, solved, initial, gyro_covariance, rotation_sigma)
    finite = jnp.isfinite(residual) & jnp.all(jnp.isfinite(error))
    is_good = finite & (residual < MAX_RESIDUAL) & (tilt_sigma < MAX_TILT_SIGMA) & jnp.all(gain.measured)
    return MovingStart(
        start=Uncertain(nav=nav, covariance=error),
        T_level_world=T_level_near @ jaxlie.SE3.from_translation(-last.astype(dtype)),
        velocity=jax.vmap(lambda v: T_level_near.rotation() @ v)(solved.velocity),
        residual=residual,
        tilt_sigma=tilt_sigma,
        is_good=is_good & (freedom > 0),
    )


def _error_covariance(
    covariance: Float[Array, "c c"],
    matrices: Float[Array, "k 3 3"],
    solved: Aligned,
    initial: InitialParams,
    gyro_covariance: Float[Array, "3 3"],
    rotation_sigma: Float[Array, ""],
) -> Float[Array, "24 24"]:
    """Return the covariance of the error state in the level world, at the last pose.

    A wrong gravity turns the level world: attitude, way and velocity in it are wrong by the same turn.
    """
    poses = solved.position.size
    axes = axes_across(solved.gravity)

    def level(tilt: Float[Array, "2"]) -> jaxlie.SO3:
        up = -(jaxlie.SO3.exp(axes @ tilt) @ solved.gravity)
        return levelled(matrices[0].T @ up / jnp.linalg.norm(up)) @ jaxlie.SO3.from_matrix(matrices[0].T)

    flat = jnp.zeros(2, covariance.dtype)
    turn = rotation_matrix(level(flat).inverse()) @ jax.jacfwd(
        lambda tilt: (level(tilt) @ level(flat).inverse()).log()
    )(flat)
    way = solved.position[-1] - solved.position[0]
    back = matrices[-1].T
    M = jnp.zeros((DOF, covariance.shape[0]), covariance.dtype)
    M = M.at[ROTATION, -2:].set(back @ turn)
    M = M.at[POSITION, poses - 3 : poses].set(back).at[POSITION, -2:].set(-back @ skew(way) @ turn)
    M = M.at[VELOCITY, 2 * poses - 3 : 2 * poses].set(back)
    M = M.at[VELOCITY, -2:].set(-back @ skew(solved.velocity[-1]) @ turn)
    M = M.at[ACCEL_BIAS, 2 * poses : 2 * poses + 3].set(initial.accel_bias_sigma * jnp.eye(3))
    own = jnp.zeros(DOF, covariance.dtype)
    for part, sigma in (
        (ROTATION, rotation_sigma),
        (GRAVITY, initial.gravity_sigma),
        (EXTRINSIC_ROTATION, initial.extrinsic_rotation_sigma),
        (EXTRINSIC_TRANSLATION, initial.extrinsic_translation_sigma),
        (TIME_OFFSET, initial.time_offset_sigma),
    ):
        own = own.at[part].set(sigma**2)
    error = M @ covariance @ M.T + jnp.diag(own)
    error = error.at[GYRO_BIAS, GYRO_BIAS].set(gyro_covariance)
    return (error + error.T) / 2
