"""Residuals and Jacobians of a chain's factors, one by one."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.estimation.factors import (
    PoseMeasurement,
    PositionMeasurement,
    RelativePose,
    imu_residual,
    predicted,
)
from lio_jax.estimation.marginal_prior import gaussian_prior, robust_quadratic
from lio_jax.estimation.motion_state import MotionState
from lio_jax.estimation.pose_logarithm import log_and_jacobian
from lio_jax.imu.params import ImuParams
from tests.estimation.smoothing import ROWS
from tests.imu.motion import quick_jit

from simulated_chain import GRAVITY, IMU, rows, simulate  # isort: skip

PERMUTED = jnp.array([3, 4, 5, 0, 1, 2])
"""jaxlie has the translation before the rotation."""


def random_state(seed: int) -> MotionState:
    keys = jax.random.split(jax.random.key(seed), 4)
    vectors = [jax.random.normal(key, (3,)) for key in keys[1:]]
    return MotionState(jaxlie.SE3.sample_uniform(keys[0]), *vectors)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-3, 0.1, 1.0, 3.0])
def test_the_logarithm_and_its_derivative(angle: float) -> None:
    axis = jnp.array([0.36, -0.48, 0.8])
    T = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.exp(angle * axis), jnp.array([1.0, 2.0, -0.5]))
    logarithm, jacobian = log_and_jacobian(T)
    np.testing.assert_allclose(logarithm, T.log()[PERMUTED], atol=1e-9)
    slope = jax.jacfwd(lambda d: log_and_jacobian(T @ jaxlie.SE3.exp(d[PERMUTED]))[0])(jnp.zeros(6))
    np.testing.assert_allclose(jacobian, slope, atol=1e-9)


def test_retraction_and_difference_are_inverse() -> None:
    state, error = random_state(0), 0.3 * jax.random.normal(jax.random.key(5), (15,))
    np.testing.assert_allclose(state.local(state.retract(error)), error, atol=1e-12)


def factors():
    """Return each factor's cost over the errors of two states, and the dimensions it speaks of."""
    a, b = random_state(1), random_state(2)
    recording = simulate(0, ROWS)
    root = np.random.default_rng(0).normal(size=(6, 6))
    information = jnp.asarray(root @ root.T)
    kernel, there = jnp.array(3.0), jnp.array(True)
    link = rows(recording.chain.imu, 0)
    metric = jnp.eye(15)

    def motion(start, end):
        return robust_quadratic(*imu_residual(link, GRAVITY, start, end), metric, kernel, there)

    prior = gaussian_prior(a, jnp.diag(jnp.arange(1.0, 16.0)))
    near = jaxlie.SE3.exp(0.3 * jnp.ones(6))
    pose = PoseMeasurement(b.T_world_imu @ near, information, kernel, there)
    relative = RelativePose(a.T_world_imu.inverse() @ b.T_world_imu @ near, information, kernel, there)
    position = PositionMeasurement(jnp.ones(3), jnp.array([0.5, 0.6, 0.7]), jnp.ones(3), kernel, there)
    return {
        "imu": (motion, (a, b), 15),
        "prior": (lambda state: prior.quadratic(state, jnp.zeros(0)), (b,), 15),
        "pose": (pose.quadratic, (b,), 6),
        "relative": (relative.quadratic, (a, b), 6),
        "position": (position.quadratic, (a,), 6),
    }


@pytest.mark.parametrize("name", ["imu", "prior", "pose", "relative", "position"])
def test_the_gradient_is_the_costs(name: str) -> None:
    quadratic, states, dof = factors()[name]

    def cost(error):
        padded = jnp.pad(error.reshape(len(states), dof), ((0, 0), (0, 15 - dof)))
        moved = [state.retract(part) for state, part in zip(states, padded, strict=True)]
        return quadratic(*moved).cost

    found = quadratic(*states)
    slope = quick_jit(jax.grad(cost))(jnp.zeros(dof * len(states)))
    assert np.abs(slope).max() > 1e-3
    np.testing.assert_allclose(found.gradient, slope, rtol=1e-9, atol=1e-11)
    assert np.linalg.eigvalsh(found.hessian).min() > -1e-9


def test_a_prediction_has_no_residual_and_its_errors_have_the_covariance() -> None:
    """For 2,000 links with biases that walk fast, so that the drift and its effect are visible."""
    fast = ImuParams(IMU.gyro_noise, IMU.accel_noise, jnp.array(0.2), jnp.array(2.0), IMU.gravity)
    recording = simulate(0, 2001, params=fast)
    truth, links = recording.truth, rows(recording.chain.imu, slice(None, -1))
    link, start = rows(links, 7), rows(truth, 7)
    np.testing.assert_allclose(
        imu_residual(link, GRAVITY, start, predicted(link, GRAVITY, start))[0], 0, atol=1e-12
    )

    @quick_jit
    def whitened(links, start, end):
        residual = jax.vmap(lambda m, a, b: imu_residual(m, GRAVITY, a, b)[0])(links, start, end)
        lower = jnp.linalg.cholesky(links.covariance)
        return jax.scipy.linalg.solve_triangular(lower, residual[..., None], lower=True)[..., 0]

    # at the biases there are: the first-order correction is not what is tested here
    from simulated_chain import preintegrated_anew

    links = rows(preintegrated_anew(recording, truth, fast).chain.imu, slice(None, -1))
    found = np.asarray(whitened(links, rows(truth, slice(None, -1)), rows(truth, slice(1, None))))
    np.testing.assert_allclose(np.cov(found.T), np.eye(15), atol=5 * 2000**-0.5)


def test_shares_of_the_noise_add_up() -> None:
    recording = simulate(0, ROWS)
    covariance = recording.chain.imu.covariance
    np.testing.assert_allclose(recording.shares.covariance(IMU), covariance, rtol=1e-9, atol=1e-16)
    apart = recording.shares.with_walk_apart().covariance(IMU)
    np.testing.assert_array_equal(apart[:, :9, 9:], 0)
    np.testing.assert_allclose(apart[:, 9:, 9:], covariance[:, 9:, 9:], rtol=1e-9)
    # slightly less without the walk's part in the motion
    assert np.all(
        np.diagonal(apart, axis1=1, axis2=2)[:, :9] < np.diagonal(covariance, axis1=1, axis2=2)[:, :9]
    )
