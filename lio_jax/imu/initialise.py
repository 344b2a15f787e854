"""The first navigation state of a vehicle at rest: attitude, biases and their joint covariance."""

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
    ROTATION,
    TIME_OFFSET,
    VELOCITY,
    NavEstimate,
    sphere_basis,
)
from lio_jax.core.geometry import from_blocks, rotation_matrix, skew
from lio_jax.core.prefix_sum import running_count
from lio_jax.core.types import ImuBatch, NavState, initial_nav_state
from lio_jax.imu.params import ImuParams, InitialParams

MIN_SAMPLES = 5
"""Least number of samples that can show that the vehicle is at rest."""

STILL_GYRO = 0.02
"""Standard deviation of the angular rate that a running engine adds to the sensor's noise at rest, rad/s."""
STILL_ACCEL = 0.2
"""Standard deviation of the specific force that a running engine adds to the noise at rest, m/s^2."""
STILL_RATE = 0.1
"""Largest mean angular rate at rest, rad/s: a larger one is a turn and not a bias."""
STILL_MISFIT = 0.05
"""Largest relative difference between the mean specific force and gravity at rest."""
MOVING_ACCEL = 1.0
"""Standard deviation of a moving vehicle's mean acceleration over about a second, m/s^2."""
MOVING_SPEED = 10.0
"""Standard deviation of a moving vehicle's first velocity per axis where it is unknown, m/s."""
_UNKNOWN_TILT = 1.0
"""Prior standard deviation of roll and pitch, before the specific force is used, rad."""


class RestStart(eqx.Module):
    """A first navigation state from samples that should be of a vehicle at rest."""

    start: NavEstimate
    """The state and its covariance. At rest it is level, with the estimated biases. In motion the level is
    rough, the biases are zero and the velocity is that of ``initial``."""
    is_still: Bool[Array, ""]
    """Whether the samples are those of a vehicle at rest."""
    accel_scale: Float[Array, ""]
    """Magnitude of the mean specific force over that of gravity: 1 for an ideal accelerometer at rest, 0
    without samples and where all are zero."""
    gyro_scatter: Float[Array, ""]
    """Standard deviation of the angular rate over all axes, rad/s."""
    accel_scatter: Float[Array, ""]
    """Standard deviation of the specific force over all axes, m/s^2."""


def initialise_at_rest(
    imu: ImuBatch,
    params: ImuParams,
    initial: InitialParams,
    T_imu_lidar: jaxlie.SE3,
    time_offset: Float[Array, ""],
) -> RestStart:
    """Return the state of a vehicle that stood still while the samples were taken.

    The mean angular rate is the gyroscope's bias. The mean specific force points up, and yaw is zero. The
    difference between its magnitude and gravity is the accelerometer's bias along it. The prior keeps both
    biases near zero. A bias normal to gravity is not observable apart from tilt, so the covariance couples
    the two. A zero sigma in ``initial`` leaves that part of the state as it is, without uncertainty. If the
    vehicle moves, the state is levelled as well, with an uncertainty that allows for its acceleration.

    Args:
        imu: about one second of samples before the first pose.
        params: the magnitude of gravity, and the noise densities, which bound the scatter at rest.
        initial: first velocity and prior standard deviations.
        T_imu_lidar: extrinsic pose of the lidar in the IMU frame.
        time_offset: lag of the lidar's clock, s.
    """
    present = jnp.any(imu.mask)
    count = jnp.maximum(jnp.sum(imu.mask), 1)
    signal = jnp.stack([imu.gyro, imu.accel])
    (gyro, accel), scatter = _mean_and_variance(signal, imu.mask)
    gyro_scatter, accel_scatter = jnp.mean(scatter, axis=1)
    # at a constant speed in a bend the body's acceleration is the cross product of rate and velocity
    accel = accel - jnp.cross(gyro, initial.velocity)
    # an accelerometer that is switched off states zero, which has no direction
    felt = present & jnp.any(accel != 0)
    accel = jnp.where(felt, accel, jnp.array([0.0, 0.0, 1.0]) * params.gravity)
    strength = jnp.linalg.norm(accel)
    rate = _sample_rate(imu)
    gyro_noise = params.gyro_noise**2 * rate
    accel_noise = params.accel_noise**2 * rate
    is_still = (
        _is_steady(signal, imu.mask, jnp.mean(scatter, axis=1), jnp.stack([gyro_noise, accel_noise]))
        & (count >= MIN_SAMPLES)
        & (jnp.linalg.norm(gyro) < STILL_RATE)
        & (jnp.abs(strength / params.gravity - 1) < STILL_MISFIT)
        # a vehicle that brakes steadily looks as if it stood on a slope
        & jnp.all(initial.velocity == 0)
    )

    level = levelled(accel / strength)
    nav = eqx.tree_at(
        lambda n: (n.T_world_imu, n.velocity, n.gravity, n.time_offset),
        initial_nav_state(T_imu_lidar),
        (
            jaxlie.SE3.from_rotation(level),
            level @ initial.velocity,
            jnp.array([0.0, 0.0, -1.0]) * params.gravity,
            time_offset,
        ),
    )
    prior = _prior(nav, initial, is_still)
    # the scatter of few samples may be small by chance
    gyro_error = jnp.maximum(gyro_scatter, gyro_noise / 4) / count
    accel_error = jnp.maximum(accel_scatter, accel_noise / 4) / count
    accel_error = jnp.where(is_still, accel_error, accel_scatter + MOVING_ACCEL**2)
    correction, covariance = _seen_at_rest(nav, prior, gyro, gyro_error, accel, accel_error, is_still)
    nav = eqx.tree_at(
        lambda n: (n.gyro_bias, n.accel_bias),
        nav,
        (
            jnp.where(is_still, correction[GYRO_BIAS], 0.0),
            jnp.where(is_still, correction[ACCEL_BIAS], 0.0),
        ),
    )
    return RestStart(
        start=NavEstimate(nav=nav, covariance=covariance),
        is_still=is_still,
        accel_scale=jnp.where(felt, strength / params.gravity, 0.0),
        gyro_scatter=jnp.sqrt(gyro_scatter),
        accel_scatter=jnp.sqrt(accel_scatter),
    )


def levelled(up: Float[Array, "3"]) -> jaxlie.SO3:
    """Return the rotation from the IMU frame to world that has zero yaw and maps ``up`` to world z.

    Args:
        up: a vector of any length in the IMU frame.
    """
    roll = jnp.arctan2(up[1], up[2])
    pitch = jnp.arctan2(-up[0], jnp.hypot(up[1], up[2]))
    half = jnp.stack([roll, pitch]) / 2
    (c_roll, c_pitch), (s_roll, s_pitch) = jnp.cos(half), jnp.sin(half)
    return jaxlie.SO3(jnp.stack([c_pitch * c_roll, c_pitch * s_roll, s_pitch * c_roll, -s_pitch * s_roll]))


def _prior(nav: NavState, initial: InitialParams, is_still: Bool[Array, ""]) -> Float[Array, "24 24"]:
    """Return the prior covariance of the error state: tilt unknown, heading fixed."""
    is_known = is_still | jnp.any(initial.velocity != 0)
    velocity = jnp.where(is_known, initial.velocity_sigma, jnp.hypot(initial.velocity_sigma, MOVING_SPEED))
    parts = (
        (VELOCITY, velocity),
        (GYRO_BIAS, initial.gyro_bias_sigma),
        (ACCEL_BIAS, initial.accel_bias_sigma),
        (GRAVITY, initial.gravity_sigma),
        (EXTRINSIC_ROTATION, initial.extrinsic_rotation_sigma),
        (EXTRINSIC_TRANSLATION, initial.extrinsic_translation_sigma),
        (TIME_OFFSET, initial.time_offset_sigma),
    )
    dtype = nav.velocity.dtype
    up = rotation_matrix(nav.T_world_imu.rotation())[2]
    tilt = jnp.where(initial.rotation_sigma > 0, _UNKNOWN_TILT**2, 0.0)
    level = tilt * (jnp.eye(3, dtype=dtype) - jnp.outer(up, up))
    own = [(part, part, sigma**2 * jnp.eye(part.stop - part.start, dtype=dtype)) for part, sigma in parts]
    return from_blocks((DOF, DOF), (ROTATION, ROTATION, level), *own)


def _seen_at_rest(
    nav: NavState,
    prior: Float[Array, "24 24"],
    gyro: Float[Array, "3"],
    gyro_variance: Float[Array, ""],
    accel: Float[Array, "3"],
    accel_variance: Float[Array, ""],
    use_gyro: Bool[Array, ""],
) -> tuple[Float[Array, "24"], Float[Array, "24 24"]]:
    """Return mean and covariance of the error state given the mean samples, by a Kalman update."""
    back = rotation_matrix(nav.T_world_imu.rotation()).T
    force = -back @ nav.gravity
    identity = jnp.eye(3, dtype=prior.dtype)
    gyro_rows, accel_rows = slice(0, 3), slice(3, 6)
    H = from_blocks(
        (6, DOF),
        (gyro_rows, GYRO_BIAS, jnp.where(use_gyro, identity, 0.0)),
        (accel_rows, ACCEL_BIAS, identity),
        (accel_rows, ROTATION, skew(force)),
        (accel_rows, GRAVITY, back @ skew(nav.gravity) @ sphere_basis(nav.gravity)),
    )
    # the rows of an unused gyroscope are zero: without a variance the system would be singular
    gyro_variance = jnp.where(use_gyro, gyro_variance, 1.0)
    R = from_blocks(
        (6, 6),
        (gyro_rows, gyro_rows, gyro_variance * identity),
        (accel_rows, accel_rows, accel_variance * identity),
    )
    HP = H @ prior
    factor = jnp.linalg.cholesky(HP @ H.T + R, symmetrize_input=False)
    gain = jax.scipy.linalg.cho_solve((factor, True), HP).T
    kept = jnp.eye(DOF, dtype=prior.dtype) - gain @ H
    covariance = kept @ prior @ kept.T + gain @ R @ gain.T
    return gain @ jnp.concatenate([gyro, accel - force]), (covariance + covariance.T) / 2


def _mean_and_variance(
    samples: Float[Array, "s m 3"], mask: Bool[Array, " m"]
) -> tuple[Float[Array, "s 3"], Float[Array, "s 3"]]:
    """Return mean and variance per sensor and axis over the real samples; zeros where there are none."""
    count = jnp.sum(mask)
    mean = jnp.sum(jnp.where(mask[:, None], samples, 0.0), axis=1) / jnp.maximum(count, 1)
    square = jnp.sum(jnp.where(mask[:, None], (samples - mean[:, None]) ** 2, 0.0), axis=1)
    return mean, square / jnp.maximum(count - 1, 1)


def _is_steady(
    samples: Float[Array, "s m 3"],
    mask: Bool[Array, " m"],
    variance: Float[Array, " s"],
    noise_variance: Float[Array, " s"],
) -> Bool[Array, ""]:
    """Return whether variance and drift are those of a gyroscope and an accelerometer at rest."""
    tolerance = jnp.array([STILL_GYRO, STILL_ACCEL], variance.dtype)
    rank = running_count(mask)
    early, _ = _mean_and_variance(samples, mask & (rank * 2 <= rank[-1]))
    late, _ = _mean_and_variance(samples, mask & (rank * 2 > rank[-1]))
    half = jnp.maximum(rank[-1] / 2, 1.0)
    # a slow start is below the noise of single samples, but not below that of their mean
    drift = jnp.linalg.norm(late - early, axis=1)
    calm = variance < tolerance**2 + 4 * noise_variance
    return jnp.all(calm & (drift < tolerance + 4 * jnp.sqrt(2 * variance / half)))


def _sample_rate(imu: ImuBatch) -> Float[Array, ""]:
    """Return the rate of the samples, Hz; 0 for fewer than two samples."""
    first = jnp.min(jnp.where(imu.mask, imu.time, jnp.inf))
    last = jnp.max(jnp.where(imu.mask, imu.time, -jnp.inf))
    intervals = jnp.sum(imu.mask) - 1
    spread = jnp.where(intervals > 0, last - first, 1.0)
    return jnp.maximum(intervals, 0) / jnp.maximum(spread, 1e-9)
