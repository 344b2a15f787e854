"""Simulated chains: inertial samples and measurements with known noise along a random motion."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from noise_shares import NoiseShares, noise_shares

from lio_jax.estimation.chain import Chain
from lio_jax.estimation.factors import PoseMeasurement, PositionMeasurement, RelativePose, predicted
from lio_jax.estimation.marginal_prior import gaussian_prior
from lio_jax.estimation.motion_state import MotionState
from lio_jax.imu.params import ImuParams
from lio_jax.imu.preintegration import Preintegrated, preintegrate_parallel
from lio_jax.imu.sampling import Intervals

STEP = 1 / 200
"""Time between inertial samples, s."""
PER_LINK = 20
GRAVITY = jnp.array([0.0, 0.0, -9.81])
IMU = ImuParams(
    gyro_noise=jnp.array(2e-3),
    accel_noise=jnp.array(2e-2),
    gyro_bias_walk=jnp.array(2e-4),
    accel_bias_walk=jnp.array(2e-3),
    gravity=jnp.array(9.81),
)
POSE_SIGMA = jnp.array([0.005, 0.005, 0.005, 0.02, 0.02, 0.02])
"""Standard deviations of a pose, rad then m."""
PRIOR_SIGMA = jnp.repeat(jnp.array([0.01, 0.05, 0.1, 0.005, 0.05]), 3)
LEVER_ARM = jnp.array([0.3, -0.2, 0.5])
GPS_SIGMA = jnp.array([0.5, 0.5, 1.0])


class Recording(eqx.Module):
    """A chain, its true states, and the raw samples of each link."""

    chain: Chain
    truth: MotionState
    guess: MotionState
    """Initial guess: dead reckoning from the prior's mean."""
    intervals: Intervals
    shares: NoiseShares


def rows(tree, which):
    return jax.tree.map(lambda leaf: leaf[which], tree)


def along(first: MotionState, links: Preintegrated) -> MotionState:
    """Return the states along a chain of links."""

    def follow(state, link):
        return (predicted(link, GRAVITY, state),) * 2

    rest = jax.lax.scan(follow, first, links)[1]
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), first, rest)


def once_more(tree):
    """Repeat the last row, because arrays of links have one more row than there are links."""
    return jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf[-1:]]), tree)


def links_of(intervals, gyro_bias, accel_bias, params: ImuParams) -> Preintegrated:
    single = lambda i, g, a: preintegrate_parallel(i, g, a, params)  # noqa: E731
    return jax.vmap(single)(intervals, gyro_bias, accel_bias)


@jax.jit
def preintegrated_anew(recording: Recording, states: MotionState, params: ImuParams = IMU) -> Recording:
    """Return the recording with its samples preintegrated at the states' biases instead of zero."""
    links = links_of(recording.intervals, states.gyro_bias[:-1], states.accel_bias[:-1], params)
    return eqx.tree_at(lambda r: r.chain.imu, recording, once_more(links))


@partial(jax.jit, static_argnames=("count", "extras"))
def simulate(seed, count: int, params: ImuParams = IMU, extras: bool = False) -> Recording:
    """Return a recording of ``count`` states; with ``extras`` also GPS and relative poses."""
    keys = iter(jax.random.split(jax.random.key(seed), 20))
    links = count - 1
    time = STEP * jnp.arange(links * PER_LINK)[:, None]
    phase, pace = jax.random.uniform(next(keys), (2, 6), minval=0.5, maxval=2.5)
    wave = jnp.sin(pace * time + 3 * phase)
    rate, acceleration = wave[:, :3] * jnp.array([0.5, 0.5, 1.0]), 2 * wave[:, 3:]

    def turn(rotation, row):
        rate, acceleration = row
        return rotation @ jaxlie.SO3.exp(rate * STEP), rotation.inverse() @ (acceleration - GRAVITY)

    first = MotionState(
        jaxlie.SE3.exp(jnp.array([1.0, 2, 3, 0.1, -0.2, 0.8])), jnp.array([1.0, 0.5, 0]), *jnp.zeros((2, 3))
    )
    force = jax.lax.scan(turn, first.T_world_imu.rotation(), (rate, acceleration))[1]

    def intervals_of(gyro, accel) -> Intervals:
        shape = (links, PER_LINK, 3)
        every = jnp.full(PER_LINK, STEP)

        def intervals(gyro, accel) -> Intervals:
            known = jnp.ones(PER_LINK, bool)
            return Intervals(every, gyro, accel, jnp.zeros_like(every), known, jnp.array(True))

        return jax.vmap(intervals)(gyro.reshape(shape), accel.reshape(shape))

    zero = jnp.zeros((links, 3))
    truth = along(first, links_of(intervals_of(rate, force), zero, zero, params))
    walk = jnp.concatenate([params.gyro_bias_walk * jnp.ones(3), params.accel_bias_walk * jnp.ones(3)])
    steps = walk * STEP**0.5 * jax.random.normal(next(keys), (len(time), 6))
    start_error = PRIOR_SIGMA * jax.random.normal(next(keys), (15,))
    # a bias steps at the end of its interval
    biases = start_error[9:] + jnp.concatenate([jnp.zeros((1, 6)), jnp.cumsum(steps, axis=0)])
    white = jnp.concatenate([params.gyro_noise * jnp.ones(3), params.accel_noise * jnp.ones(3)]) / STEP**0.5
    samples = jnp.concatenate([rate, force], 1) + biases[:-1]
    samples = samples + white * jax.random.normal(next(keys), samples.shape)
    at_states = biases[::PER_LINK]
    truth = dataclasses.replace(truth, gyro_bias=at_states[:, :3], accel_bias=at_states[:, 3:])
    mean = rows(truth, 0).retract(jnp.zeros(15).at[:9].set(start_error[:9]))
    mean = dataclasses.replace(mean, gyro_bias=jnp.zeros(3), accel_bias=jnp.zeros(3))

    intervals = intervals_of(samples[:, :3], samples[:, 3:])
    imu = links_of(intervals, zero, zero, params)
    shares = jax.vmap(noise_shares)(intervals, zero, zero)

    def noisy(pose, key, sigma):
        error = sigma * jax.random.normal(key, (len(pose.wxyz_xyz), 6))
        # jaxlie stores the translation before the rotation
        return pose @ jaxlie.SE3.exp(error[:, [3, 4, 5, 0, 1, 2]])

    def poses(size):
        information = jnp.broadcast_to(jnp.diag(POSE_SIGMA**-2), (size, 6, 6))
        return information, jnp.full(size, jnp.inf), jnp.ones(size, bool)

    T = truth.T_world_imu
    relative = gps = None
    if extras:
        between = jaxlie.SE3(T.wxyz_xyz[:-1]).inverse() @ jaxlie.SE3(T.wxyz_xyz[1:])
        relative = RelativePose(once_more(noisy(between, next(keys), POSE_SIGMA)), *poses(count))
        antenna = T.apply(jnp.broadcast_to(LEVER_ARM, (count, 3)))
        gps = PositionMeasurement(
            antenna + GPS_SIGMA * jax.random.normal(next(keys), (count, 3)),
            jnp.broadcast_to(GPS_SIGMA, (count, 3)),
            jnp.broadcast_to(LEVER_ARM, (count, 3)),
            jnp.full(count, jnp.inf),
            jnp.arange(count) % 3 == 1,
        )
    chain = Chain(
        count=jnp.int32(count),
        gravity=GRAVITY,
        prior=gaussian_prior(mean, jnp.diag(PRIOR_SIGMA**2)),
        imu=once_more(imu),
        lidar=PoseMeasurement(noisy(T, next(keys), POSE_SIGMA), *poses(count)),
        relative=relative,
        gps=gps,
    )
    return Recording(chain, truth, along(mean, imu), intervals, once_more(shares))
