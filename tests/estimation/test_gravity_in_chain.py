"""The direction of gravity as an unknown of a chain, and the covariance of a window's latest state."""

from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.types import CONVERGED
from lio_jax.estimation.chain import information_of, linearise
from lio_jax.estimation.factors import by_tilt, tilted
from lio_jax.estimation.latest_error import LatestError
from lio_jax.estimation.map_drift import taken_into_map
from lio_jax.estimation.marginal_prior import gaussian_prior
from lio_jax.estimation.sliding_window import (
    Added,
    append_and_update,
    log_evidence,
    moved_by,
    open_window,
)
from lio_jax.estimation.smoother import smooth
from tests.estimation.linear_chain import GRAVITY, PRIOR_SIGMA, linear_chain
from tests.imu.motion import quick_jit

ROWS, CAPACITY = 7, 4
TILT_SIGMA = 0.01
TRUE_TILT = jnp.array([0.002, -0.003])


def row_of(tree, row):
    return jax.tree.map(lambda rows: rows[row], tree)


@cache
def tilted_chain():
    """Return a chain whose prior leaves gravity's direction open, and a guess of its states."""
    chain, guess, _ = linear_chain(ROWS)
    start = row_of(guess, 0)
    # rotations that are known to 1e-9 rad would leave rounding errors of the size of a tilt
    sigma = np.concatenate([np.maximum(PRIOR_SIGMA, 1e-5), np.full(2, TILT_SIGMA)])
    prior = gaussian_prior(start, jnp.diag(jnp.asarray(sigma**2)))
    lidar = jnp.minimum(100 * chain.lidar.information, 1e10)
    # positions of a world that is nearly level, so that the tilt is small and the model all but linear
    noise = 2e-4 * np.random.default_rng(1).normal(size=(ROWS, 3))
    measured = guess.T_world_imu.wxyz_xyz.at[:, 4:].add(noise)
    places = lambda c: (c.prior, c.lidar.information, c.lidar.T_world_imu.wxyz_xyz)  # noqa: E731
    return eqx.tree_at(places, chain, (prior, lidar, measured)), guess


@cache
def whole():
    chain, guess = tilted_chain()
    found = quick_jit(lambda c, g: smooth(c, g, max_iterations=20, tolerance=jnp.array(1e-6)))(chain, guess)
    return found, float(log_evidence(chain, found))


@cache
def along():
    """The chain through a window, with the covariance of the latest state beside it."""
    chain, _ = tilted_chain()

    @quick_jit
    def advance(window, error, added):
        after, found = append_and_update(window, added, max_iterations=20, tolerance=jnp.array(1e-6))
        last = after.chain.count - 1
        ends = [jax.tree.map(lambda rows, row=row: rows[row], found.states) for row in (last - 1, last)]
        moved = error.propagated(added.link, chain.gravity, after.tilt, *ends)
        stated = found.joint_covariance(last)
        return after, moved.matched(stated, added.lidar.information), found, stated

    first = Added(row_of(chain.imu, 0), row_of(chain.lidar, 0))
    window = open_window(CAPACITY, chain.prior, chain.gravity, first)
    information = chain.prior.information.at[:6, :6].add(first.lidar.information)
    error, steps = LatestError.of(jnp.linalg.inv(information)), []
    for k in range(1, ROWS):
        added = Added(row_of(chain.imu, k - 1), row_of(chain.lidar, k))
        window, error, found, stated = advance(window, error, added)
        steps.append((window, error, found, stated))
    return steps


def test_the_derivative_by_the_tilt_is_the_slope():
    tilt = jnp.array([0.3, -0.2])
    slope = jax.jacfwd(lambda tilt: tilted(GRAVITY, tilt))(tilt)
    np.testing.assert_allclose(by_tilt(GRAVITY, tilt), slope, atol=1e-12)
    np.testing.assert_allclose(jnp.linalg.norm(tilted(GRAVITY, tilt)), 9.81, rtol=1e-12)


def test_the_tilt_is_found_from_samples_that_feel_it():
    """The samples of the same motion under another gravity: each force differs by the difference of both."""
    chain, guess = tilted_chain()
    before = whole()[0].tilt
    fallen = tilted(GRAVITY, TRUE_TILT) - GRAVITY
    elapsed = chain.imu.duration[:, None]
    links = eqx.tree_at(
        lambda imu: (imu.position, imu.velocity),
        chain.imu,
        (chain.imu.position - elapsed**2 / 2 * fallen, chain.imu.velocity - elapsed * fallen),
    )
    # the prior's mean is moved as well, so that it pulls as before
    moved = eqx.tree_at(lambda c: (c.imu, c.prior.tilt), chain, (links, TRUE_TILT))
    found = quick_jit(lambda c, g: smooth(c, g, max_iterations=20, tolerance=jnp.array(1e-6)))(moved, guess)
    assert found.status == CONVERGED
    np.testing.assert_allclose(found.tilt, TRUE_TILT + before, atol=1e-5)


def test_a_window_that_forgot_knows_as_much_as_the_whole_chain():
    found, evidence = whole()
    window, _, result, stated = along()[-1]
    assert int(window.chain.count) == CAPACITY
    assert found.status == result.status == CONVERGED
    expected = found.joint_covariance(jnp.int32(ROWS - 1))
    sigma = np.sqrt(np.diagonal(expected))
    assert (sigma[15:] < 0.9 * TILT_SIGMA).all()
    # what was forgotten stays linearised where it was: an error of second order
    np.testing.assert_allclose((result.tilt - found.tilt) / sigma[15:], 0, atol=1e-3)
    np.testing.assert_allclose(stated / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=1e-4)
    assert float(log_evidence(window.chain, result)) == pytest.approx(evidence, rel=1e-6)


def test_without_an_error_of_the_map_the_latest_error_is_the_windows_own():
    for _, error, _, stated in along():
        sigma = np.sqrt(np.diagonal(stated))
        scale = np.outer(sigma, sigma)
        np.testing.assert_allclose(error.state / scale, stated / scale, atol=2e-3)
        np.testing.assert_array_equal(error.cross, 0)


def test_another_world_turns_the_tilt():
    window = along()[-1][0]
    # away from the minimum, where no gradient is zero
    apart = window.states.retract(jnp.asarray(np.random.default_rng(0).normal(0, 0.1, (CAPACITY, 15))))
    window = eqx.tree_at(lambda w: (w.tilt, w.states), window, (jnp.array([0.05, -0.02]), apart))
    T_new_old = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_z_radians(jnp.asarray(2.0)), jnp.array([30.0, -20.0, 5.0])
    )

    @quick_jit
    def normal(window):
        return linearise(window.chain, information_of(window.chain), window.states, window.tilt)

    moved = moved_by(window, T_new_old)
    np.testing.assert_allclose(moved.gravity(), T_new_old.rotation() @ window.gravity(), atol=1e-12)
    before, after = normal(window), normal(moved)
    np.testing.assert_allclose(after.cost, before.cost, rtol=1e-9)
    np.testing.assert_allclose(after.gradient, before.gradient, rtol=1e-6, atol=1e-6 * before.cost)
    np.testing.assert_allclose(np.linalg.norm(after.by_tilt), np.linalg.norm(before.by_tilt), rtol=1e-9)


@pytest.mark.parametrize(("scans", "taken", "renewed"), [(0, 0.0, 0.0), (1, 0.3, 1.0), (7, 0.3, 0.3)])
def test_map_and_state_follow_their_recursion(scans, taken, renewed):
    """The joint covariance by plain matrices: match, then insertion of a scan of which 0.3 is new."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(23, 23))
    joint, information = root @ root.T, np.diag(rng.uniform(1, 2, 6))
    window = np.linalg.inv(np.linalg.inv(joint[:17, :17]) + np.pad(information, (0, 11)))
    planes = np.eye(6)
    error = LatestError(*map(jnp.asarray, (joint[:17, :17], joint[:17, 17:], joint[17:, 17:])))
    gain = window[:, :6] @ information
    T = np.eye(23)
    T[:17, :6] -= gain
    T[:17, 17:] = gain
    after = T @ joint @ T.T
    after[:17, :17] += gain @ np.linalg.inv(information) @ gain.T
    J = np.eye(23)
    J[17:, :6] = taken * np.eye(6)
    J[17:, 17:] *= 1 - taken
    after = J @ after @ J.T
    after[17:, 17:] += renewed * (2 - renewed) * planes
    found = error.matched(jnp.asarray(window), jnp.asarray(information))
    found = found.added(*taken_into_map(jnp.asarray(0.3), jnp.asarray(planes), jnp.int32(scans)))
    np.testing.assert_allclose(found.state, after[:17, :17], atol=1e-9)
    np.testing.assert_allclose(found.cross, after[:17, 17:], atol=1e-9)
    np.testing.assert_allclose(found.map, after[17:, 17:], atol=1e-9)
