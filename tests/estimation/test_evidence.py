"""The marginal likelihood, and what marginalising the past keeps, on a linear Gaussian model."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.types import CONVERGED
from lio_jax.estimation.chain import information_of, linearise
from lio_jax.estimation.sliding_window import Added, append_and_update, moved_by, open_window
from tests.estimation.linear_chain import GRAVITY, linear_chain, log_likelihood, row_of
from tests.estimation.smoothing import ROWS, evidence_of, smoothed
from tests.imu.motion import quick_jit

CAPACITY = 4


@pytest.fixture(scope="module")
def linear():
    chain, guess, positions = linear_chain(ROWS)
    return chain, positions, smoothed(chain, guess)


@pytest.fixture(scope="module")
def along(linear):
    """The chain's measurements one after the other through a window of four states."""
    chain = linear[0]
    advance = quick_jit(lambda w, a: append_and_update(w, a, max_iterations=9, tolerance=jnp.array(1e-9)))
    first = Added(row_of(chain.imu, 0), row_of(chain.lidar, 0))
    window, steps = open_window(CAPACITY, chain.prior, GRAVITY, first), []
    for k in range(1, ROWS):
        window, result = advance(window, Added(row_of(chain.imu, k - 1), row_of(chain.lidar, k)))
        steps.append((window, result))
    return steps


def test_it_is_the_density_of_the_measurements(linear):
    chain, positions, result = linear
    assert result.status == CONVERGED
    expected = log_likelihood(chain, positions)
    assert float(evidence_of(chain, result)) == pytest.approx(expected, rel=1e-8)


def test_a_window_that_forgot_knows_as_much_as_the_whole_chain(linear, along):
    _, _, whole = linear
    window, result = along[-1]
    assert int(window.chain.count) == CAPACITY
    assert result.status == CONVERGED
    expected = jax.tree.map(lambda rows: rows[-CAPACITY:], whole.states)
    covariances = np.asarray(whole.covariances()[-CAPACITY:])
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    np.testing.assert_allclose(expected.local(result.states) / sigma, 0, atol=1e-9)
    scale = sigma[:, :, None] * sigma[:, None]
    np.testing.assert_allclose(result.covariances() / scale, covariances / scale, atol=1e-9)


def test_the_evidence_of_what_was_forgotten_is_kept(linear, along):
    chain, positions, _ = linear
    for count, (window, result) in enumerate(along, start=2):
        part = eqx.tree_at(lambda c: c.count, chain, jnp.int32(count))
        expected = log_likelihood(part, positions[:count])
        assert float(evidence_of(window.chain, result)) == pytest.approx(expected, rel=1e-8)


def test_the_window_fills_before_it_forgets(along):
    assert [int(window.chain.count) for window, _ in along[:5]] == [2, 3, 4, 4, 4]


def test_another_world_frame_changes_no_cost(along):
    window = along[-1][0]
    T_new_old = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_z_radians(jnp.asarray(2.0)), jnp.array([30.0, -20.0, 5.0])
    )
    # away from the minimum, where no gradient is zero
    apart = window.states.retract(jnp.asarray(np.random.default_rng(0).normal(0, 0.1, (CAPACITY, 15))))
    window = eqx.tree_at(lambda window: window.states, window, apart)
    normal = quick_jit(
        lambda window: linearise(window.chain, information_of(window.chain), window.states, window.tilt)
    )
    before, after = normal(window), normal(moved_by(window, T_new_old))
    np.testing.assert_allclose(after.cost, before.cost, rtol=1e-9)
    np.testing.assert_allclose(after.gradient, before.gradient, rtol=1e-6, atol=1e-6 * before.cost)
    np.testing.assert_allclose(
        after.matrix.chain.diagonal, before.matrix.chain.diagonal, rtol=1e-6, atol=1e-6
    )
