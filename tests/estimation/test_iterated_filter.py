"""The iterated update against a Kalman filter, dense Gauss-Newton, and batch least squares."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares

from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, LOST, NOT_FINITE
from lio_jax.estimation.iterated_filter import Measurement, Update, iterated_update


def plus(state, error):
    return state + error


def minus(state, other):
    return other - state


@partial(jax.jit, static_argnums=5)
def linear_update(mean, covariance, H, R, z, max_iterations=3) -> Update:
    """Update with z = H x + noise, measured as the k-dimensional quantity H x itself."""
    information = jnp.linalg.inv(R)

    def measure(x):
        return Measurement(information, information @ (H @ x - z), jnp.array(False))

    tolerance = jnp.full(mean.shape, 1e-9)
    return iterated_update(
        mean,
        covariance,
        measure,
        lambda x: H,
        plus,
        minus,
        max_iterations=max_iterations,
        tolerance=tolerance,
    )


def random_covariance(rng, size, rank=None):
    root = rng.normal(size=(size, rank or size)) * 10.0 ** rng.uniform(-2, 1, (size, 1))
    return root @ root.T


def kalman_update(mean, covariance, H, R, z):
    S = H @ covariance @ H.T + R
    gain = np.linalg.solve(S, H @ covariance).T
    kept = np.eye(len(mean)) - gain @ H
    nu = z - H @ mean
    nis = nu @ np.linalg.solve(S, nu)
    return mean + gain @ nu, kept @ covariance @ kept.T + gain @ R @ gain.T, nis, np.linalg.slogdet(S)[1]


@pytest.mark.parametrize("frozen", [(), (1, 4)], ids=["all free", "two frozen"])
def test_on_a_linear_problem_it_is_a_kalman_filter(frozen) -> None:
    rng = np.random.default_rng(0)
    size, k = 7, 3
    mean, covariance = rng.normal(size=size), random_covariance(rng, size)
    for index in frozen:
        covariance[index] = 0
        covariance[:, index] = 0
    transition = 0.95 * np.linalg.qr(rng.normal(size=(size, size)))[0]
    transition[list(frozen)] = np.eye(size)[list(frozen)]
    noise = 0.01 * np.eye(size)
    for index in frozen:
        noise[index] = 0
    start = mean[list(frozen)]
    ours_mean, ours_covariance = jnp.asarray(mean), jnp.asarray(covariance)
    for _ in range(100):
        H, R = rng.normal(size=(k, size)), random_covariance(rng, k) + 1e-3 * np.eye(k)
        z = H @ mean + rng.multivariate_normal(np.zeros(k), R)
        mean, covariance = transition @ mean, transition @ covariance @ transition.T + noise
        ours_mean = transition @ ours_mean
        ours_covariance = transition @ ours_covariance @ transition.T + noise
        mean, covariance, nis, log_det = kalman_update(mean, covariance, H, R, z)
        result = linear_update(ours_mean, ours_covariance, H, R, z)
        ours_mean, ours_covariance = result.state, result.covariance
        np.testing.assert_allclose(ours_mean, mean, atol=1e-10)
        np.testing.assert_allclose(ours_covariance, covariance, atol=1e-10)
        np.testing.assert_allclose(result.innovation.nis, nis, rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(result.innovation.log_det, log_det, rtol=1e-9, atol=1e-9)
        assert int(result.innovation.dof) == k
        assert int(result.status) == CONVERGED
        assert int(result.iterations) == 2
    np.testing.assert_array_equal(np.asarray(ours_mean)[list(frozen)], start)


def bearing_residual(x, beacons):
    away = x[:2] - beacons
    return jnp.concatenate([jnp.linalg.norm(away, axis=1), jnp.arctan2(away[:, 1], away[:, 0]) - x[2]])


def range_bearing(seed):
    """Return a strongly nonlinear planar problem: prior, beacons, observations, weights."""
    rng = np.random.default_rng(seed)
    beacons = rng.uniform(-6, 6, (5, 2))
    truth = np.array([0.5, -0.4, 0.3])
    mean = truth + np.array([0.5, 0.4, -0.3])
    weights = np.repeat([1 / 0.3**2, 1 / 0.1**2], 5)
    z = np.asarray(bearing_residual(truth, beacons)) + rng.normal(size=10) / np.sqrt(weights)
    return tuple(map(jnp.asarray, (mean, random_covariance(rng, 3) + 0.05 * np.eye(3), beacons, z, weights)))


def measured_bearings(beacons, z, weights, x) -> Measurement:
    H = jax.jacfwd(bearing_residual)(x, beacons)
    r = bearing_residual(x, beacons) - z
    return Measurement(H.T @ (weights[:, None] * H), H.T @ (weights * r), jnp.array(False), r @ (weights * r))


@partial(jax.jit, static_argnums=5)
def range_bearing_update(mean, covariance, beacons, z, weights, max_iterations) -> Update:
    return iterated_update(
        mean,
        covariance,
        jax.tree_util.Partial(measured_bearings, beacons, z, weights),
        lambda x: jnp.eye(3),
        plus,
        minus,
        max_iterations=max_iterations,
        tolerance=jnp.full(3, 1e-12),
    )


@pytest.mark.parametrize("seed", range(5))
def test_on_a_nonlinear_problem_it_finds_the_maximum_a_posteriori(seed) -> None:
    mean, covariance, beacons, z, weights = range_bearing(seed)
    result = range_bearing_update(mean, covariance, beacons, z, weights, 100)
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))

    def stacked(x):
        return jnp.concatenate([whiten @ (x - mean), jnp.sqrt(weights) * (bearing_residual(x, beacons) - z)])

    jacobian = jax.jit(jax.jacfwd(stacked))
    best = least_squares(
        lambda x: np.asarray(stacked(x)),
        mean,
        lambda x: np.asarray(jacobian(x)),
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
    )
    assert int(result.status) == CONVERGED
    np.testing.assert_allclose(result.state, best.x, atol=1e-8)
    np.testing.assert_allclose(result.covariance, np.linalg.inv(best.jac.T @ best.jac), rtol=1e-6, atol=1e-9)


def test_the_bound_on_iterations_holds_and_is_reported() -> None:
    result = range_bearing_update(*range_bearing(0), 2)
    assert int(result.status) == ITERATION_LIMIT
    assert int(result.iterations) == 2


@jax.jit
def useless_update(mean, covariance, lost, value) -> Update:
    def measure(x):
        filled = jnp.full((2, 2), value)
        return Measurement(filled, filled[0], lost, jnp.array(7))

    return iterated_update(
        mean,
        covariance,
        measure,
        lambda x: jnp.ones((2, 4)),
        plus,
        minus,
        max_iterations=5,
        tolerance=jnp.full(4, 1e-9),
    )


@pytest.mark.parametrize(
    ("lost", "value", "status"),
    [(False, 0.0, CONVERGED), (True, 1.0, LOST), (False, jnp.nan, NOT_FINITE), (True, jnp.nan, LOST)],
    ids=["no information", "lost", "not a number", "lost and not a number"],
)
def test_what_cannot_be_used_leaves_the_prior_untouched(lost, value, status) -> None:
    rng = np.random.default_rng(3)
    mean, covariance = jnp.asarray(rng.normal(size=4)), jnp.asarray(random_covariance(rng, 4))
    covariance = (covariance + covariance.T) / 2
    result = useless_update(mean, covariance, jnp.array(lost), jnp.array(value))
    assert int(result.status) == status
    np.testing.assert_array_equal(result.state, mean)
    np.testing.assert_array_equal(result.covariance, covariance)
    assert int(result.measurement.aux) == 7
    assert int(result.innovation.dof) == 0
    assert float(result.innovation.nis) == 0


@pytest.mark.parametrize("seed", range(20))
def test_the_posterior_is_symmetric_and_positive_semidefinite(seed) -> None:
    """Priors that are nearly singular, measurements from useless to far sharper than the prior."""
    rng = np.random.default_rng(seed)
    size, k = 12, 6
    sigma = 10.0 ** rng.uniform(-6, 3, size)
    root = sigma[:, None] * rng.normal(size=(size, rng.integers(1, size + 1)))
    covariance = root @ root.T + np.diag(sigma**2 * 1e-14)
    J = jnp.asarray(rng.normal(size=(k, size)) / sigma)
    noise = 10.0 ** rng.uniform(-7, 2, k)
    rotation = np.linalg.qr(rng.normal(size=(k, k)))[0]
    R = rotation @ np.diag(noise**2) @ rotation.T
    posterior = np.asarray(
        linear_update(jnp.zeros(size), jnp.asarray(covariance), J, R, jnp.zeros(k)).covariance
    )
    np.testing.assert_array_equal(posterior, posterior.T)
    # in units of the prior's sigmas, because the components' units differ
    scaled = posterior / np.outer(sigma, sigma)
    assert np.linalg.eigvalsh(scaled).min() > -1e-14
    assert (np.diag(posterior) >= 0).all()


def test_directions_without_information_keep_their_prior() -> None:
    mean, covariance = jnp.zeros(3), jnp.diag(jnp.array([1.0, 2.0, 3.0]))
    along = np.array([0.6, 0.8, 0.0])

    def measure(x):
        residual = along @ x - 1.0
        return Measurement(jnp.asarray(25 * np.outer(along, along)), 25 * residual * along, jnp.array(False))

    result = iterated_update(
        mean,
        covariance,
        measure,
        lambda x: jnp.eye(3),
        plus,
        minus,
        max_iterations=4,
        tolerance=jnp.full(3, 1e-9),
    )
    expected_mean, expected, nis, log_det = kalman_update(
        np.zeros(3), np.asarray(covariance), along[None], np.array([[0.04]]), np.ones(1)
    )
    np.testing.assert_allclose(result.state, expected_mean, atol=1e-12)
    np.testing.assert_allclose(result.covariance, expected, atol=1e-12)
    np.testing.assert_allclose(result.innovation.nis, nis, rtol=1e-12)
    np.testing.assert_allclose(result.innovation.log_det, log_det, rtol=1e-12)
    assert int(result.innovation.dof) == 1


def test_a_linearisation_gets_what_the_last_one_left() -> None:
    mean, covariance, beacons, z, weights = range_bearing(2)

    def measure(x, calls):
        H = jax.jacfwd(bearing_residual)(x, beacons)
        gradient = H.T @ (weights * (bearing_residual(x, beacons) - z))
        return Measurement(H.T @ (weights[:, None] * H), gradient, jnp.array(False), 2 * calls)

    result = iterated_update(
        mean,
        covariance,
        measure,
        lambda x: jnp.eye(3),
        plus,
        minus,
        max_iterations=4,
        tolerance=jnp.zeros(3),
        first_aux=jnp.int32(3),
    )
    assert int(result.measurement.aux) == 3 * 2**4


def test_updates_batch_and_have_forward_derivatives() -> None:
    mean, covariance, beacons, z, weights = range_bearing(1)

    def place(scale):
        return range_bearing_update(mean, scale * covariance, beacons, z, weights, 100).state

    step = 1e-5
    scales = jnp.array([1 - step, 1 + step, 1.0])
    places, tangents = jax.jit(lambda s: jax.jvp(jax.vmap(place), (s,), (jnp.ones(3),)))(scales)
    np.testing.assert_allclose(tangents[2], (places[1] - places[0]) / (2 * step), atol=1e-8)
    np.testing.assert_allclose(places[2], place(1.0), atol=1e-12)
