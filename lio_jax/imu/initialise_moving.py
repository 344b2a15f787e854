"""Start a filter on a moving vehicle: align poses of scan matching with preintegrated inertial samples.

A first least-squares problem finds the gyroscope's bias from the rotations between the poses. A second one
finds the velocities, gravity and the accelerometer's bias from their positions. The result is a navigation
state with its covariance in a level world.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import optimistix as optx
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
    NavEstimate,
)
from lio_jax.core.geometry import rotation_matrix, skew
from lio_jax.core.types import ImuBatch, initial_nav_state
from lio_jax.imu.initialise import levelled
from lio_jax.imu.params import ImuParams, InitialParams
from lio_jax.imu.preintegration import Preintegrated, preintegrate_parallel
from lio_jax.imu.sampling import sample_intervals

MAX_STEPS = 16
"""Largest number of Levenberg-Marquardt steps of :func:`align`."""
PRECISION = 1e-5
"""Change of the unknowns and of the cost, relative and absolute, below which :func:`align` stops."""


class Scale(eqx.Module):
    """Standard deviations that whiten the equations of :func:`align`, for n spans."""

    pose: Float[Array, ""]
    """Standard deviation of each pose's position, m, per axis."""
    speed: Float[Array, " n"]
    """Standard deviation of the velocity gained over each span, m/s, per axis."""
    way: Float[Array, " n"]
    """Standard deviation of the way gained over each span less that of the mean velocity, m, per axis. This
    part is independent of the velocity's error."""
    accel_bias: Float[Array, ""]
    """Prior standard deviation of the accelerometer's bias, m/s^2, per axis."""


class Aligned(eqx.Module):
    """The unknowns of :func:`align`, in the order of the least-squares problem's columns."""

    position: Float[Array, "k 3"]
    """Position of the IMU at each of the k poses, m, in the world of the matched poses."""
    velocity: Float[Array, "k 3"]
    """Velocity of the IMU at each of the k poses, m/s, in the world of the matched poses."""
    accel_share: Float[Array, "3"]
    """Accelerometer's bias over its prior sigma, no unit, IMU frame: a zero sigma keeps the bias at zero."""
    gravity: Float[Array, "3"]
    """Acceleration of gravity, m/s^2, in the world of the matched poses."""


def gyro_bias_share(
    gain: Preintegrated,
    rotation: jaxlie.SO3,
    duration: Float[Array, " n"],
    share: Float[Array, "3"],
    params: ImuParams,
    initial: InitialParams,
    rotation_sigma: Float[Array, ""],
) -> tuple[Float[Array, "3"], Float[Array, "3 3"], Float[Array, ""]]:
    """Return the gyroscope's bias that makes n preintegrated rotations agree with n + 1 matched ones.

    Args:
        gain: preintegrated samples of the n spans, with the bias ``share`` times its prior sigma.
        rotation: (k,) rotations R_world_imu of the k = n + 1 poses.
        duration: length of each span, s.
        share: gyroscope's bias over its prior sigma, as ``gain`` has it.
        params: noise density of the gyroscope.
        initial: prior sigma of the gyroscope's bias.
        rotation_sigma: standard deviation of each pose's rotation, rad, per axis.

    Returns:
        The bias over its prior sigma, the bias's covariance ((rad/s)^2), and the whitened squared misfit.
    """
    wxyz = rotation.wxyz
    turned = jax.vmap(lambda gained, a, b: (gained.inverse() @ a.inverse() @ b).log())(
        gain.rotation, jaxlie.SO3(wxyz[:-1]), jaxlie.SO3(wxyz[1:])
    )
    # the errors of neighbouring spans are correlated: both contain the error of the pose between them
    spans = duration.shape[0]
    shared = 2 * jnp.eye(spans) - jnp.eye(spans, k=1) - jnp.eye(spans, k=-1)
    noise = jnp.diag(params.gyro_noise**2 * duration) + rotation_sigma**2 * shared
    root = jnp.linalg.cholesky(noise.astype(duration.dtype))

    def whitened(rows: Array) -> Array:
        flat = rows.reshape(spans, -1)
        return jax.scipy.linalg.solve_triangular(root, flat, lower=True).reshape(-1, *rows.shape[2:])

    sigma = initial.gyro_bias_sigma
    A = whitened(gain.bias_jacobian[:, ROTATION, :3]) * sigma
    target = whitened(turned) + A @ share
    information = A.T @ A + jnp.eye(3)
    share = jnp.linalg.solve(information, A.T @ target)
    return share, sigma**2 * jnp.linalg.inv(information), jnp.sum((target - A @ share) ** 2)


def align(
    gain: Preintegrated,
    T_near_imu: jaxlie.SE3,
    matrices: Float[Array, "k 3 3"],
    duration: Float[Array, " n"],
    gravity_strength: Float[Array, ""],
    scale: Scale,
) -> tuple[Aligned, Float[Array, "c c"], Float[Array, ""]]:
    """Return the positions, velocities, gravity and accelerometer's bias that agree with matched poses.

    Args:
        gain: preintegrated samples of the n spans between k = n + 1 poses.
        T_near_imu: (k,) matched poses of the IMU.
        matrices: rotation matrices of these poses.
        duration: length of each span, s.
        gravity_strength: magnitude of gravity, m/s^2.
        scale: standard deviations of the equations.

    Returns:
        The solution in the world of the poses, its covariance, and the whitened squared misfit. The
        covariance has c = 6 k + 5 columns, in the order of :class:`Aligned`; the last two are rotations of
        gravity about :func:`axes_across`, rad.
    """
    dt = duration[:, None]
    turn = matrices[:-1]
    matched = T_near_imu.translation()

    gained_frame = rotation_matrix(gain.rotation)
    speed_by_bias = gained_frame @ gain.bias_jacobian[:, VELOCITY, 3:]
    way_by_bias = gained_frame @ gain.bias_jacobian[:, POSITION, 3:]

    def misfit(x: Aligned) -> Float[Array, " r"]:
        bias = scale.accel_bias * x.accel_share
        gained = gain.velocity + speed_by_bias @ bias
        moved = gain.position + way_by_bias @ bias
        speed = x.velocity[1:] - x.velocity[:-1] - x.gravity * dt - jnp.einsum("nij,nj->ni", turn, gained)
        way = x.position[1:] - x.position[:-1] - x.velocity[:-1] * dt - x.gravity * dt**2 / 2
        way = way - jnp.einsum("nij,nj->ni", turn, moved) - speed * dt / 2
        return jnp.concatenate(
            [
                ((x.position - matched) / scale.pose).ravel(),
                (speed / scale.speed[:, None]).ravel(),
                (way / scale.way[:, None]).ravel(),
                x.accel_share,
            ]
        )

    mean_velocity = jnp.diff(matched, axis=0) / dt
    elapsed = jnp.sum(duration) - (duration[0] + duration[-1]) / 2
    acceleration = (mean_velocity[-1] - mean_velocity[0]) / jnp.maximum(elapsed, duration[0])
    gravity = acceleration - jnp.mean(jnp.einsum("nij,nj->ni", turn, gain.velocity) / dt, axis=0)
    strength = jnp.maximum(jnp.linalg.norm(gravity), jnp.finfo(dt.dtype).tiny)
    start = Aligned(
        matched,
        jnp.concatenate([mean_velocity, mean_velocity[-1:]]),
        jnp.zeros(3, dt.dtype),
        gravity * (gravity_strength / strength),
    )
    zero = jnp.zeros(2 * matched.size + 5, dt.dtype)
    # its steps are solved by QR: the normal equations would square a condition number that is high already
    step = optx.least_squares(
        lambda step, _: misfit(_moved(start, step)),
        optx.LevenbergMarquardt(PRECISION, PRECISION),
        zero,
        max_steps=MAX_STEPS,
        throw=False,
    ).value
    solved = _moved(start, step)
    root = jnp.linalg.qr(jax.jacfwd(lambda step: misfit(_moved(solved, step)))(zero), mode="r")
    inverse = jax.scipy.linalg.solve_triangular(root, jnp.eye(zero.size, dtype=dt.dtype))
    return solved, inverse @ inverse.T, jnp.sum(misfit(solved)[:-3] ** 2)


def axes_across(gravity: Float[Array, "3"]) -> Float[Array, "3 2"]:
    """Return two unit axes normal to ``gravity`` and to each other, for any direction of gravity."""
    up = gravity / jnp.linalg.norm(gravity)
    slanted = jnp.eye(3, dtype=up.dtype)[jnp.argmin(jnp.abs(up))]
    a = jnp.cross(up, slanted)
    a = a / jnp.linalg.norm(a)
    return jnp.stack([a, jnp.cross(up, a)], axis=1)


def _moved(x: Aligned, step: Float[Array, " c"]) -> Aligned:
    """Return the unknowns after a step, whose last two entries rotate gravity about axes normal to it."""
    poses = x.position.size
    return Aligned(
        x.position + step[:poses].reshape(-1, 3),
        x.velocity + step[poses : 2 * poses].reshape(-1, 3),
        x.accel_share + step[2 * poses : 2 * poses + 3],
        jaxlie.SO3.exp(axes_across(x.gravity) @ step[2 * poses + 3 :]) @ x.gravity,
    )


GYRO_ROUNDS = 3
"""Iterations of the gyroscope's bias; each preintegrates the samples anew."""
MAX_RESIDUAL = 3.0
"""Largest misfit of a good start, in standard deviations."""
MAX_TILT_SIGMA = 0.1
"""Largest standard deviation of gravity's direction of a good start, rad."""


class MovingStart(eqx.Module):
    """A first navigation state at the last of the matched poses."""

    start: NavEstimate
    """State and covariance at the last pose, in the level world: z is up, and the origin and the heading are
    those of the first IMU pose."""
    T_level_world: jaxlie.SE3
    """Pose of the matched poses' world in the level world, m: it maps a map into the level world."""
    velocity: Float[Array, "k 3"]
    """Velocity of the IMU at each pose, m/s, in the level world."""
    residual: Float[Array, ""]
    """Root mean square of the whitened misfit of poses and samples: about 1 where the noise is as stated."""
    tilt_sigma: Float[Array, ""]
    """Standard deviation of gravity's direction, rad."""
    is_good: Bool[Array, ""]
    """Whether the misfit and the uncertainty of gravity's direction are small enough to use the start."""


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

    It is for a recording that starts in motion, where a mean of the accelerometer does not show gravity. The
    recipes do not use it. Match ten scans without the samples, stack one batch of samples for each span
    between two scans, and call, for scans 0.1 s apart whose ends are the batches' time 0::

        found = lio_jax.initialise_moving(
            imu, -0.1 * jnp.ones(9), jnp.zeros(9), T_world_lidar, params.imu, params.initial, T_imu_lidar,
            time_offset=jnp.array(0.0), rotation_sigma=jnp.array(1e-3), translation_sigma=jnp.array(0.01),
        )
        if found.is_good:
            nav = found.start.nav

    The accelerometer's bias is weakly observable, and only as far as the vehicle turns; its prior keeps it
    near zero. With ten poses over one second the error of the level is about the accelerometer's bias over
    gravity.

    Args:
        imu: n batches (leading axis), each with the samples of its span.
        start: start of each span in its batch's time, s: the instant of pose i.
        end: end of each span in its batch's time, s: the instant of pose i + 1.
        T_world_lidar: n + 1 poses of scan matching, in any world.
        params: noise densities and the magnitude of gravity.
        initial: prior sigmas; a zero sigma keeps a bias at zero.
        T_imu_lidar: extrinsic pose of the lidar in the IMU frame.
        time_offset: lag of the lidar's clock, s.
        rotation_sigma: standard deviation of each pose's rotation, rad, per axis.
        translation_sigma: standard deviation of each pose's position, m, per axis.
    """
    dtype = time_offset.dtype
    duration = jnp.maximum(end - start, 1e-4)
    last = T_world_lidar.translation()[-1]
    # relative to the last pose's position: float32 is precise there
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

    # loops inside the compiled program: unrolled they would take a minute to compile
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
        start=NavEstimate(nav=nav, covariance=error),
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

    An error of gravity's direction turns the level world, so attitude, position and velocity in it are wrong
    by the same rotation.
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
