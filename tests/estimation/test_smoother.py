"""The smoother against gtsam on the same factors, and what it makes of bad input."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, NOT_FINITE
from lio_jax.estimation.factors import fixed_information
from lio_jax.imu.preintegration import preintegrate_parallel
from tests.estimation.smoothing import ROWS, smoothed

from simulated_chain import GRAVITY, IMU, preintegrated_anew, rows, simulate  # isort: skip


@pytest.fixture(scope="module")
def recording():
    return simulate(0, ROWS)


@pytest.fixture(scope="module")
def solution(recording):
    return smoothed(recording.chain, recording.guess)


def in_sigmas(result, others) -> float:
    error = np.asarray(result.states.local(others))
    return np.abs(error / np.sqrt(np.diagonal(result.covariances(), axis1=1, axis2=2))).max()


def test_the_same_factors_give_gtsams_states_and_covariances():
    """The biases equal those of the preintegration, where gtsam's first-order correction equals ours."""
    gtsam = pytest.importorskip("gtsam")
    from gtsam.symbol_shorthand import X
    from gtsam_chain import GtsamChain, covariance_of, states_of

    recording = simulate(3, ROWS, extras=True)
    for _ in range(3):
        result = smoothed(recording.chain, recording.guess)
        recording = preintegrated_anew(recording, result.states)
    result = smoothed(recording.chain, recording.guess)
    assert result.status == CONVERGED
    theirs = GtsamChain(recording)
    settings = gtsam.LevenbergMarquardtParams()
    settings.setRelativeErrorTol(1e-15)
    settings.setAbsoluteErrorTol(1e-15)
    graph = theirs.graph()
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, theirs.values(), settings)
    values = optimiser.optimize()
    assert float(result.normal.cost) == pytest.approx(optimiser.error(), rel=1e-9)
    states = result.states
    ours = (states.T_world_imu.as_matrix(), states.velocity, states.gyro_bias, states.accel_bias)
    for mine, other in zip(ours, states_of(values, range(ROWS)), strict=True):
        np.testing.assert_allclose(mine, other, atol=1e-8)
    marginals, covariances = gtsam.Marginals(graph, values), np.asarray(result.covariances())
    for k in (0, 5, ROWS - 1):
        expected = covariance_of(marginals, values.atPose3(X(k)), k)
        sigma = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            covariances[k] / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-8
        )


def test_it_is_at_rest_where_it_ends_and_forgets_where_it_began(recording, solution):
    assert solution.status == CONVERGED
    assert solution.iterations < 10
    again = smoothed(recording.chain, solution.states)
    assert again.iterations <= 2
    other = smoothed(recording.chain, recording.truth.retract(0.02 * jnp.ones((ROWS, 15))))
    assert in_sigmas(other, solution.states) < 1e-6


def test_a_far_guess_is_damped_home(recording, solution):
    far = 1.0 * jax.random.normal(jax.random.key(1), (ROWS, 15)) * jnp.repeat(jnp.array([0.5, 3, 3, 0, 0]), 3)
    result = smoothed(recording.chain, recording.guess.retract(far))
    assert result.status == CONVERGED
    assert in_sigmas(result, solution.states) < 1e-6


def test_large_residuals_cost_few_steps(recording):
    """Full Gauss-Newton steps come nearer by a constant factor each: they need 26."""
    sigma = jnp.array([0.02, 0.02, 0.02, 0.005, 0.005, 0.005])
    off = 150 * sigma * jax.random.normal(jax.random.key(2), (ROWS, 6))
    chain = eqx.tree_at(
        lambda c: c.lidar.T_world_imu,
        recording.chain,
        recording.chain.lidar.T_world_imu @ jaxlie.SE3.exp(off),
    )
    result = smoothed(chain, recording.guess)
    assert result.status == CONVERGED
    assert result.iterations <= 20


def test_the_bound_on_iterations_is_reported(recording):
    assert smoothed(recording.chain, recording.guess, 1e-9, 2).status == ITERATION_LIMIT


def test_a_recording_shorter_than_the_rows(recording):
    """Padding changes nothing for any content."""
    short = simulate(0, ROWS)
    count = 7
    chain = eqx.tree_at(lambda c: c.count, short.chain, jnp.int32(count))
    wild = eqx.tree_at(lambda c: c.lidar.information, chain, chain.lidar.information.at[count:].mul(7))
    a, b = smoothed(chain, short.guess), smoothed(wild, short.guess)
    assert a.status == b.status == CONVERGED
    np.testing.assert_array_equal(a.states.velocity[:count], b.states.velocity[:count])
    np.testing.assert_array_equal(
        a.covariances()[count:], np.broadcast_to(np.eye(15), (ROWS - count, 15, 15))
    )
    np.testing.assert_array_equal(a.normal.weights.lidar[count:], 0)
    unmasked = eqx.tree_at(lambda c: c.lidar.mask, short.chain, short.chain.lidar.mask.at[count:].set(False))
    longer = smoothed(unmasked, short.guess)
    # states without a lidar pose behind the last one tell nothing about those before
    np.testing.assert_allclose(longer.states.velocity[:count], a.states.velocity[:count], atol=1e-9)


def test_an_outlier_is_weighed_down_and_reported(recording, solution):
    kernel = jnp.full(ROWS, 8.0)
    chain = eqx.tree_at(lambda c: c.lidar.kernel, recording.chain, kernel)
    off = jaxlie.SE3.exp(jnp.array([1.5, -1.0, 0.5, 0.1, 0.2, -0.3]))
    pose = chain.lidar.T_world_imu.wxyz_xyz
    pose = pose.at[5].set((jaxlie.SE3(pose[5]) @ off).wxyz_xyz)
    chain = eqx.tree_at(lambda c: c.lidar.T_world_imu, chain, jaxlie.SE3(pose))
    result = smoothed(chain, recording.guess)
    assert result.status == CONVERGED
    weights = np.asarray(result.normal.weights.lidar)
    assert weights[5] < 1e-3
    assert np.delete(weights, 5).min() > 0.5
    assert in_sigmas(result, solution.states) < 1.5
    trusting = smoothed(
        eqx.tree_at(lambda c: c.lidar.kernel, chain, jnp.full(ROWS, jnp.inf)), recording.guess
    )
    assert in_sigmas(trusting, solution.states) > 10


def test_a_link_without_samples_is_wide_and_reported(recording):
    nothing = dataclasses.replace(
        rows(recording.intervals, 4), known=jnp.zeros(20, bool), measured=jnp.array(False)
    )
    link = preintegrate_parallel(nothing, jnp.zeros(3), jnp.zeros(3), IMU)
    imu = jax.tree.map(lambda leaf, one: leaf.at[4].set(one), recording.chain.imu, link)
    chain = eqx.tree_at(lambda c: c.imu, recording.chain, imu)
    result = smoothed(chain, recording.guess)
    assert result.status == CONVERGED
    assert result.unmeasured == 1
    error = np.asarray(result.states.local(recording.truth))
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(result.covariances()), error)
    # chi-square of 15: above 44.3 once in 10,000
    assert nees.max() < 44.3
    wider = np.trace(result.covariances()[4, 6:9, 6:9])
    assert wider > 1.2 * np.trace(smoothed(recording.chain, recording.guess).covariances()[4, 6:9, 6:9])


def test_two_states_of_one_instant_are_the_same(recording):
    zero = dataclasses.replace(rows(recording.intervals, 4), duration=jnp.zeros(20))
    link = preintegrate_parallel(zero, jnp.zeros(3), jnp.zeros(3), IMU)
    imu = jax.tree.map(lambda leaf, one: leaf.at[4].set(one), recording.chain.imu, link)
    pose = recording.chain.lidar.T_world_imu.wxyz_xyz
    chain = eqx.tree_at(lambda c: c.imu, recording.chain, imu)
    # the second one's own measurement repeats the first's; what follows is not looked at
    chain = eqx.tree_at(lambda c: c.lidar.T_world_imu, chain, jaxlie.SE3(pose.at[5].set(pose[4])))
    chain = eqx.tree_at(lambda c: c.count, chain, jnp.int32(6))
    result = smoothed(chain, recording.guess)
    assert result.status == CONVERGED
    same = rows(result.states, 4).local(rows(result.states, 5))
    assert np.abs(same).max() < 1e-4
    assert np.all(np.isfinite(result.covariances()))


def test_a_degenerate_frame_is_carried_by_the_others(recording, solution):
    """Directions without information, and the loose sigmas of LIO-SAM, in place of one frame's."""
    loose = fixed_information(jnp.array(1.0), jnp.array(1.0))
    np.testing.assert_allclose(loose, np.eye(6))
    along_x = jnp.diag(jnp.array([1.0, 1, 1, 0, 1, 1])) * recording.chain.lidar.information[5]
    for information in (loose, along_x):
        changed = recording.chain.lidar.information.at[5].set(information)
        result = smoothed(
            eqx.tree_at(lambda c: c.lidar.information, recording.chain, changed), recording.guess
        )
        assert result.status == CONVERGED
        before, after = (s.covariances()[5, 3, 3] for s in (solution, result))
        assert before < after < 9 * before
        assert in_sigmas(result, recording.truth) < 5


def test_what_is_not_a_number_is_reported_and_not_returned(recording):
    chain = eqx.tree_at(lambda c: c.gravity, recording.chain, jnp.full_like(GRAVITY, jnp.nan))
    result = smoothed(chain, recording.guess)
    assert result.status == NOT_FINITE
    np.testing.assert_array_equal(result.states.velocity, recording.guess.velocity)


def test_optimistix_finds_the_same(recording, solution):
    """Its Levenberg-Marquardt on our whitened residuals, differentiated automatically."""
    optimistix = pytest.importorskip("optimistix")
    import lineax

    from lio_jax.estimation.chain import information_of
    from lio_jax.estimation.factors import imu_residual

    size = 4
    chain = recording.chain.map_rows(lambda leaf: leaf[:size])
    information = information_of(chain)
    start = rows(recording.guess, slice(size))

    def residuals(flat, _):
        states = start.retract(flat.reshape(size, 15))
        pairs = [rows(states, slice(None, -1)), rows(states, slice(1, None))]
        links = rows(chain.imu, slice(None, -1))
        moved = jax.vmap(lambda m, a, b: imu_residual(m, GRAVITY, a, b)[0])(links, *pairs)
        missed = (chain.lidar.T_world_imu.inverse() @ states.T_world_imu).log()[:, [3, 4, 5, 0, 1, 2]]
        first = chain.prior.origin.local(rows(states, 0))
        root = lambda A: jnp.swapaxes(jnp.linalg.cholesky(A), -1, -2)  # noqa: E731
        return (
            jnp.einsum("nij,nj->ni", root(information), moved),
            jnp.einsum("nij,nj->ni", root(chain.lidar.information), missed),
            root(chain.prior.information) @ first,
        )

    solver = optimistix.LevenbergMarquardt(
        rtol=1e-12, atol=1e-12, linear_solver=lineax.Normal(lineax.Cholesky())
    )
    found = optimistix.least_squares(residuals, solver, jnp.zeros(15 * size), max_steps=100)
    chain = eqx.tree_at(lambda c: c.count, recording.chain, jnp.int32(size))
    mine = smoothed(chain, recording.guess)
    theirs = start.retract(found.value.reshape(size, 15))
    sigma = np.sqrt(np.diagonal(mine.covariances()[:size], axis1=1, axis2=2))
    assert np.abs(rows(mine.states, slice(size)).local(theirs) / sigma).max() < 1e-5
