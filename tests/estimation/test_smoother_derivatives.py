"""Derivatives of the smoothed states and of their evidence against central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.types import CONVERGED
from lio_jax.estimation.sliding_window import log_evidence
from lio_jax.estimation.smoother import smooth
from lio_jax.imu.params import ImuParams
from tests.experiments import bench_path  # noqa: F401
from tests.imu.motion import quick_jit

from simulated_chain import GRAVITY, simulate  # isort: skip

COUNT = 5
INPUTS = (
    "gyro noise",
    "accel noise",
    "gyro walk",
    "accel walk",
    "lidar",
    "gps",
    "x",
    "yaw",
    "gps x",
    "gravity",
    "kernel",
)


@pytest.fixture(scope="module")
def recording():
    found = simulate(1, COUNT, extras=True)
    # relative poses are left out: they would only make the program longer
    return eqx.tree_at(lambda r: r.chain.relative, found, None)


def results(x, recording):
    """Return evidence, a position, a velocity and a bias as functions of log-noise and measurements."""
    chain = recording.chain
    densities = jnp.exp(x[:4]) * jnp.array([2e-3, 2e-2, 2e-2, 0.2])
    pose = chain.lidar.T_world_imu
    turn = jaxlie.SO3.exp(jnp.zeros(3).at[2].set(x[7])).wxyz
    moved = jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3(
            pose.wxyz_xyz[:, :4].at[2].set((jaxlie.SO3(turn) @ jaxlie.SO3(pose.wxyz_xyz[2, :4])).wxyz)
        ),
        pose.translation().at[2, 0].add(x[6]),
    )
    chain = eqx.tree_at(
        lambda c: (
            c.imu.covariance,
            c.lidar.information,
            c.gps.sigma,
            c.lidar.T_world_imu,
            c.gps.position,
            c.gravity,
            c.lidar.kernel,
        ),
        chain,
        (
            recording.shares.covariance(ImuParams(*densities, gravity=jnp.array(9.81))),
            chain.lidar.information * jnp.exp(-2 * x[4]),
            chain.gps.sigma * jnp.exp(x[5]),
            moved,
            chain.gps.position.at[1, 0].add(x[8]),
            GRAVITY.at[2].add(x[9]),
            jnp.full(COUNT, 6.0) * jnp.exp(x[10]),
        ),
    )
    found = smooth(chain, recording.guess, max_iterations=50, tolerance=jnp.array(1e-10))
    states = found.states
    values = (
        log_evidence(chain, found),
        states.T_world_imu.translation()[-1, 0],
        states.velocity[1, 1],
        1e3 * states.gyro_bias[2, 1],
    )
    return jnp.stack(values), found.status


@pytest.mark.long
def test_they_are_central_differences(recording):
    value = quick_jit(results)
    origin = jnp.zeros(len(INPUTS))
    assert value(origin, recording)[1] == CONVERGED
    slopes = quick_jit(jax.jacrev(lambda x: results(x, recording)[0]))(origin)
    # of fourth order; a fraction of a sigma where the kernel bends the cost
    steps = np.full(len(INPUTS), 5e-3)
    steps[[6, 7]] = 5e-4, 1e-4

    def difference(axis, step):
        at = lambda share: value(share * step * axis, recording)[0]  # noqa: E731
        return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)

    expected = np.stack([difference(*pair) for pair in zip(jnp.eye(len(INPUTS)), steps, strict=True)], axis=1)
    scale = np.maximum(np.abs(expected), 1e-4 * np.abs(expected).max(axis=1, keepdims=True))
    error = np.abs(slopes - expected) / scale
    assert error.max() < 1e-4, dict(zip(INPUTS, error.T, strict=True))
    assert np.all(np.abs(expected[:, [0, 1, 4, 6, 7, 9]]) > 0)
