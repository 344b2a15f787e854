"""The whole recording's likelihood is the smoother's evidence where all it adds is left out."""

import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.error_state import BIASES, POSITION, ROTATION, VELOCITY, NavEstimate
from lio_jax.core.types import ImuBatch, NavState
from lio_jax.estimation.motion_state import MotionState
from lio_jax.estimation.sliding_window import log_evidence as evidence_of_chain
from lio_jax.estimation.smoother import smooth
from lio_jax.imu.params import ImuParams
from lio_jax.imu.sampling import sample_intervals
from lio_jax.imu.strapdown import propagate_sweep
from tests.estimation.smoothing import ROWS
from tests.imu.motion import quick_jit

sys.path.append(str(Path(__file__).parents[2] / "experiments"))

from batch_evidence import STILL, Noise, Sweep, lag_terms, linearised, log_evidence  # isort: skip
from simulated_chain import IMU, POSE_SIGMA, preintegrated_anew, rows, simulate  # isort: skip


pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def solved():
    """A chain whose first state's pose is not measured, at its solution."""
    recording = simulate(0, ROWS)
    recording = preintegrated_anew(recording, recording.truth)
    chain = eqx.tree_at(lambda c: c.lidar.mask, recording.chain, recording.chain.lidar.mask.at[0].set(False))
    result = quick_jit(lambda c, g: smooth(c, g, max_iterations=30, tolerance=jnp.array(1e-9)))(
        chain, recording.guess
    )
    before = rows(recording.truth, slice(None, -1))
    span = jnp.stack([jnp.zeros(ROWS - 1), chain.imu.duration[:-1]], axis=1)
    return chain, result, Sweep(recording.intervals, before, span)


def test_with_white_noise_alone_it_is_the_smoothers_evidence(solved):
    chain, result, sweeps = solved
    terms = linearised(chain, result.states, sweeps)
    value = quick_jit(lambda noise: log_evidence(terms, noise, False))
    expected = float(evidence_of_chain(chain, result))
    assert float(value(Noise(IMU, POSE_SIGMA, None))) == pytest.approx(expected, rel=1e-7)


@pytest.mark.parametrize("lag", [False, True])
def test_its_derivative_is_a_central_difference(solved, lag):
    chain, result, sweeps = solved
    terms = linearised(chain, result.states, sweeps)

    def value(x):
        imu = ImuParams(*(jnp.exp(x[:4]) * jnp.array([2e-3, 2e-2, 2e-2, 0.2])), gravity=jnp.array(9.81))
        return log_evidence(terms, Noise(imu, POSE_SIGMA * jnp.exp(x[4]), jnp.exp(x[5]) * 1e3 * STILL), lag)

    # by another sum than Laplace's
    compiled = quick_jit(value)
    slope = quick_jit(jax.grad(value))(jnp.zeros(6))
    for axis, found in zip(np.eye(6), slope, strict=True):
        difference = (compiled(1e-4 * axis) - compiled(-1e-4 * axis)) / 2e-4
        assert float(found) == pytest.approx(float(difference), rel=1e-4, abs=1e-4)


def test_the_lag_is_the_filters():
    """The lag's derivative and noise agree with those by which the filter propagates a sweep's covariance."""
    recording = simulate(0, ROWS)
    whole, states = recording.intervals, recording.truth
    start = rows(states, 3)
    link = rows(whole, 3)
    time = jnp.concatenate([jnp.zeros(1), jnp.cumsum(link.duration)]) - 0.02
    # samples at the intervals' ends; their means are what the intervals hold
    imu = ImuBatch(
        time,
        jnp.concatenate([link.gyro[:1], link.gyro]),
        jnp.concatenate([link.accel[:1], link.accel]),
        jnp.ones(len(time), bool),
    )
    nothing = jnp.zeros(())
    span = jnp.stack([time[0], time[-1]])
    intervals = sample_intervals(imu, nothing, span[0], span[1])
    by_start, per_variance = lag_terms(Sweep(intervals, start, span))
    rng = np.random.default_rng(2)
    root = np.zeros((24, 24))
    root[:15, :15] = rng.normal(size=(15, 15))
    nav = nav_of(start)
    swept, _ = propagate_sweep(NavEstimate(nav, jnp.asarray(root @ root.T)), imu, IMU, *span, jnp.zeros(()))
    still, _ = propagate_sweep(NavEstimate(nav, jnp.zeros((24, 24))), imu, IMU, *span, jnp.zeros(()))
    lag = slice(24, 30)
    expected = np.asarray(swept.covariance - still.covariance)[lag, lag]
    np.testing.assert_allclose(by_start @ (root @ root.T)[:15, :15] @ by_start.T, expected, atol=1e-9)
    assert np.abs(expected).max() > 1e-4
    densities = jnp.stack([IMU.gyro_noise, IMU.accel_noise, IMU.gyro_bias_walk, IMU.accel_bias_walk])
    noise = np.einsum("k,kij->ij", densities**2, per_variance)
    order = [*range(9), *range(24, 30), *range(9, 15)]
    np.testing.assert_allclose(
        noise, np.asarray(still.covariance)[np.ix_(order, order)], rtol=1e-9, atol=1e-18
    )
    assert (np.abs(np.asarray(by_start)[:, [ROTATION.start, POSITION.start, VELOCITY.start]]) < 1).all()
    assert np.abs(by_start[:, BIASES]).max() > 1e-3


def nav_of(state: MotionState) -> NavState:
    import jaxlie

    return NavState(
        T_world_imu=state.T_world_imu,
        velocity=state.velocity,
        gyro_bias=state.gyro_bias,
        accel_bias=state.accel_bias,
        gravity=jnp.array([0.0, 0.0, -9.81]),
        T_imu_lidar=jaxlie.SE3.identity(),
        time_offset=jnp.zeros(()),
    )
