"""A closed-form motion with inertial samples and lidar poses of known noise, many runs at once."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie

from lio_jax.core.error_state import DOF, NavEstimate, SweptState, local, retract
from lio_jax.core.types import ImuBatch, NavState
from lio_jax.estimation.iterated_filter import Update
from lio_jax.estimation.nav_update import update_nav
from lio_jax.imu.params import ImuParams
from lio_jax.imu.strapdown import propagate
from tests.estimation.measured_pose import measured_pose

STEP = 1 / 200
"""Between inertial samples, s."""
PER_SCAN = 20
MARGIN = 8
"""Samples before and after a scan that its batch holds too: room for the time offset."""
POSE_SIGMA = jnp.array([0.005, 0.005, 0.005, 0.02, 0.02, 0.02])
"""Standard deviations of the lidar's pose, rad then m."""
IMU = ImuParams(
    gyro_noise=jnp.array(2e-3),
    accel_noise=jnp.array(2e-2),
    gyro_bias_walk=jnp.array(1e-3),
    accel_bias_walk=jnp.array(1e-2),
    gravity=jnp.array(9.81),
)


def rotation(t: jax.Array) -> jax.Array:
    roll, pitch = 0.4 * jnp.sin(1.7 * t + 1), 0.5 * jnp.sin(1.3 * t)
    return jaxlie.SO3.from_rpy_radians(roll, pitch, 0.8 * jnp.sin(2.1 * t) + 0.3 * t).as_matrix()


def position(t: jax.Array) -> jax.Array:
    return jnp.array([3 * jnp.sin(0.9 * t), 2 * jnp.cos(1.3 * t), 0.8 * jnp.sin(1.9 * t + 0.3)])


def inertial(t: jax.Array, gravity: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the angular rate and the specific force in the IMU frame."""
    R, dR = jax.jvp(rotation, (t,), (jnp.ones_like(t),))
    spin = R.T @ dR
    acceleration = jax.jacfwd(jax.jacfwd(position))(t)
    return jnp.array([spin[2, 1], spin[0, 2], spin[1, 0]]), R.T @ (acceleration - gravity)


class Truth(eqx.Module):
    """The motion without biases, at the samples and at the scans' ends."""

    gyro: jax.Array
    accel: jax.Array
    nav: NavState
    """At the start and at each scan's end."""


@partial(jax.jit, static_argnums=0)
def truth(scans: int) -> Truth:
    """Return the truth of a run of so many scans, one every 0.1 s."""
    fixed = NavState(
        T_world_imu=jaxlie.SE3.identity(),
        velocity=jnp.zeros(3),
        gyro_bias=jnp.zeros(3),
        accel_bias=jnp.zeros(3),
        gravity=jnp.array([0, 0, -9.81]),
        T_imu_lidar=jaxlie.SE3.exp(jnp.array([0.1, -0.2, 0.3, 0.2, -0.1, 0.4])),
        time_offset=jnp.array(0.004),
    )

    def at(t: jax.Array) -> NavState:
        place, velocity = jax.jvp(position, (t,), (jnp.ones_like(t),))
        pose = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.from_matrix(rotation(t)), place)
        return dataclasses.replace(fixed, T_world_imu=pose, velocity=velocity)

    stamps = STEP * (jnp.arange(scans * PER_SCAN + 2 * MARGIN + 1) - MARGIN)
    gyro, accel = jax.vmap(lambda t: inertial(t, fixed.gravity))(stamps - fixed.time_offset)
    return Truth(gyro, accel, jax.vmap(at)(STEP * PER_SCAN * jnp.arange(scans + 1)))


def run(key: jax.Array, sigma: jax.Array, true: Truth) -> tuple[jax.Array, Update]:
    """Simulate one run; return the error that truth has from the estimate after each scan, and the updates.

    Args:
        key: of all that is random.
        sigma: of the first state, in the error state's order; zero freezes.
        true: the motion.
    """
    keys = jax.random.split(key, 4)
    samples, scans = len(true.gyro), len(true.nav.velocity) - 1
    walk = STEP**0.5 * jnp.concatenate([jnp.full(3, IMU.gyro_bias_walk), jnp.full(3, IMU.accel_bias_walk)])
    bias = jnp.cumsum(walk * jax.random.normal(keys[0], (samples, 6)), 0)
    bias -= bias[MARGIN]
    density = jnp.concatenate([jnp.full(3, IMU.gyro_noise), jnp.full(3, IMU.accel_noise)])
    noise = density / STEP**0.5 * jax.random.normal(keys[1], (samples, 6))
    signal = jnp.concatenate([true.gyro, true.accel], 1) + bias + noise
    pose_noise = POSE_SIGMA * jax.random.normal(keys[2], (scans, 6))
    information = jnp.diag(1 / POSE_SIGMA**2)

    # the truth is the estimate plus its error: to second order the estimate is the truth minus it
    first = jax.tree.map(lambda leaf: leaf[0], true.nav)
    guess = retract(first, -sigma * jax.random.normal(keys[3], (DOF,)))
    time = STEP * (jnp.arange(PER_SCAN + 2 * MARGIN + 1) - MARGIN)
    end = jnp.array(PER_SCAN * STEP)

    def step(state: NavEstimate, scan: jax.Array) -> tuple:
        chosen = jax.lax.dynamic_slice_in_dim(signal, scan * PER_SCAN, len(time))
        batch = ImuBatch(time, chosen[:, :3], chosen[:, 3:], jnp.ones(len(time), bool))
        predicted, _ = propagate(state, batch, IMU, jnp.zeros(()), end)
        nav = jax.tree.map(lambda leaf: leaf[scan + 1], true.nav)
        b = bias[(scan + 1) * PER_SCAN + MARGIN]
        nav = dataclasses.replace(nav, gyro_bias=b[:3], accel_bias=b[3:])
        T = nav.T_world_imu @ nav.T_imu_lidar
        turned = T.rotation() @ jaxlie.SO3.exp(-pose_noise[scan, :3])
        measured = jaxlie.SE3.from_rotation_and_translation(
            turned, T.translation() - turned @ pose_noise[scan, 3:]
        )
        update, _ = update_nav(
            SweptState.at_once(predicted),
            lambda trial: measured_pose(trial, measured, information),
            max_iterations=10,
            rotation_tolerance=jnp.array(1e-6),
            translation_tolerance=jnp.array(1e-6),
        )
        return update.state, (local(update.state.nav, nav), update)

    _, (errors, updates) = jax.lax.scan(step, NavEstimate(guess, jnp.diag(sigma**2)), jnp.arange(scans))
    return errors, updates
