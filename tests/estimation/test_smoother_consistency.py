"""Covariances are consistent with the errors, and a window agrees with gtsam's fixed-lag smoother."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chi2

from lio_jax.core.types import CONVERGED
from lio_jax.estimation.sliding_window import Added, append_and_update, open_window
from tests.estimation.smoothing import ROWS, smoothed
from tests.imu.motion import quick_jit

from simulated_chain import GRAVITY, rows, simulate  # isort: skip

RUNS = 200


@pytest.mark.long
def test_the_average_error_is_that_of_the_covariances():
    recordings = [simulate(seed, ROWS) for seed in range(1000, 1000 + RUNS)]
    for name, k in (("middle", ROWS // 2), ("end", ROWS - 1)):
        squares = {"pose": [], "velocity": [], "biases": []}
        for recording in recordings:
            result = smoothed(recording.chain, recording.guess)
            assert result.status == CONVERGED
            error = np.asarray(result.states.local(recording.truth))[k]
            covariance = np.asarray(result.covariances())[k]
            for part, which in (("pose", slice(0, 6)), ("velocity", slice(6, 9)), ("biases", slice(9, 15))):
                e = error[which]
                squares[part].append(e @ np.linalg.solve(covariance[which, which], e))
        for part, values in squares.items():
            dof = RUNS * (3 if part == "velocity" else 6)
            low, high = chi2.ppf([0.025, 0.975], dof)
            assert low < sum(values) < high, (name, part, sum(values) / dof)


@pytest.mark.long
def test_a_window_that_forgets_stays_consistent():
    """The latest of the states, when most of the run has been marginalised."""
    capacity, runs = 4, 100

    def squares(recording):
        chain = recording.chain
        window = open_window(capacity, chain.prior, GRAVITY, Added(rows(chain.imu, 0), rows(chain.lidar, 0)))

        def step(window, k):
            added = Added(rows(chain.imu, k - 1), rows(chain.lidar, k))
            return append_and_update(window, added, max_iterations=10, tolerance=jnp.array(1e-6))

        window, results = jax.lax.scan(step, window, jnp.arange(1, ROWS))
        covariance = rows(results, -1).covariances()[capacity - 1]
        error = window.latest().local(rows(recording.truth, ROWS - 1))
        parts = (slice(0, 6), slice(6, 9), slice(9, 15))
        return jnp.stack([error[p] @ jnp.linalg.solve(covariance[p, p], error[p]) for p in parts])

    program = quick_jit(squares)
    sums = sum(np.asarray(program(simulate(seed, ROWS))) for seed in range(3000, 3000 + runs))
    for name, dof, total in zip(("pose", "velocity", "biases"), (6, 3, 6), sums, strict=True):
        low, high = chi2.ppf([0.025, 0.975], runs * dof)
        assert low < total < high, (name, total / (runs * dof))


def batch_smoother(gtsam, lag: float):
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-12)
    return gtsam.BatchFixedLagSmoother(lag, settings)


def incremental_smoother(gtsam, lag: float):
    """ISAM2, relinearised at each update."""
    settings = gtsam.ISAM2Params()
    settings.relinearizeSkip = 1
    settings.setRelinearizeThreshold(1e-9)
    return gtsam.IncrementalFixedLagSmoother(lag, settings)


@pytest.mark.parametrize("made", [batch_smoother, incremental_smoother])
def test_a_window_follows_gtsams_fixed_lag_smoothers(made):
    """The end state within 1 % of sigma: all marginalise the same states, each in its own coordinates."""
    gtsam = pytest.importorskip("gtsam")
    from gtsam.symbol_shorthand import B, V, X
    from gtsam_chain import GtsamChain

    recording, capacity = simulate(2, ROWS), 4
    chain = recording.chain
    advance = quick_jit(lambda w, a: append_and_update(w, a, max_iterations=20, tolerance=jnp.array(1e-9)))
    window = open_window(capacity, chain.prior, GRAVITY, Added(rows(chain.imu, 0), rows(chain.lidar, 0)))
    theirs = GtsamChain(recording)
    fixed_lag = made(gtsam, capacity - 0.5)
    for k in range(ROWS):
        values, graph, stamps = gtsam.Values(), gtsam.NonlinearFactorGraph(), {}
        theirs.insert(values, k)
        for factor in theirs.factors(k):
            graph.add(factor)
        for key in (X(k), V(k), B(k)):
            stamps[key] = float(k)
        fixed_lag.update(graph, values, stamps)
        for _ in range(3):
            # one of ISAM2's updates is one step
            fixed_lag.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {})
        if k == 0:
            continue
        window, result = advance(window, Added(rows(chain.imu, k - 1), rows(chain.lidar, k)))
        assert result.status == CONVERGED
        estimate = fixed_lag.calculateEstimate()
        mine = window.latest()
        turn = mine.T_world_imu.rotation().as_matrix()
        pose, bias = estimate.atPose3(X(k)), estimate.atConstantBias(B(k))
        error = np.concatenate(
            [
                gtsam.Rot3.Logmap(gtsam.Rot3(np.asarray(turn)).between(pose.rotation())),
                turn.T @ (pose.translation() - mine.T_world_imu.translation()),
                turn.T @ (estimate.atVector(V(k)) - mine.velocity),
                bias.gyroscope() - mine.gyro_bias,
                bias.accelerometer() - mine.accel_bias,
            ]
        )
        covariance = np.asarray(result.covariances())[int(window.chain.count) - 1]
        assert np.abs(error / np.sqrt(np.diag(covariance))).max() < 0.01
