"""A chain that is linear and Gaussian, and the same model in plain matrices.

The IMU does not turn and its rotation is known, so that motion and measurements are linear.
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from lio_jax.estimation.chain import Chain
from lio_jax.estimation.factors import FLOOR, PoseMeasurement, predicted
from lio_jax.estimation.marginal_prior import gaussian_prior
from lio_jax.estimation.motion_state import MotionState
from lio_jax.imu.params import ImuParams
from lio_jax.imu.preintegration import preintegrate_parallel
from lio_jax.imu.sampling import Intervals
from tests.imu.motion import quick_jit

GRAVITY = jnp.array([0.0, 0.0, -9.81])
PARAMS = ImuParams(*map(jnp.asarray, (1e-4, 2e-2, 1e-5, 2e-3, 9.81)))
PRIOR_SIGMA = np.repeat([1e-9, 0.5, 1.0, 1e-9, 0.05], 3)
POSE_SIGMA = np.repeat([1e-9, 0.02], 3)
PER_LINK = 10


@quick_jit
def links_of(accel):
    """Return a link for each row of samples, m/s^2, 10 ms apart."""

    def link(accel):
        h, still = jnp.full(PER_LINK, 0.01), jnp.zeros(3)
        intervals = Intervals(h, jnp.zeros((PER_LINK, 3)), accel, 0 * h, h > 0, jnp.array(True))
        return preintegrate_parallel(intervals, still, still, PARAMS)

    return jax.vmap(link)(accel)


def linear_chain(count: int) -> tuple[Chain, MotionState, np.ndarray]:
    """Return a chain, a guess and the measured positions (n, 3)."""
    rng = np.random.default_rng(4)
    accel = rng.normal(size=(count, PER_LINK, 3)) - GRAVITY
    links = links_of(accel)
    positions = 0.3 * rng.normal(size=(count, 3))
    identity = jaxlie.SO3(jnp.broadcast_to(jnp.array([1.0, 0, 0, 0]), (count, 4)))
    lidar = PoseMeasurement(
        T_world_imu=jaxlie.SE3.from_rotation_and_translation(identity, jnp.asarray(positions)),
        information=jnp.broadcast_to(jnp.diag(jnp.asarray(POSE_SIGMA**-2.0)), (count, 6, 6)),
        kernel=jnp.full(count, jnp.inf),
        mask=jnp.ones(count, bool),
    )
    start = MotionState(jaxlie.SE3(jnp.eye(7)[0]), *jnp.zeros((3, 3)))
    prior = gaussian_prior(start, jnp.diag(jnp.asarray(PRIOR_SIGMA**2)))
    chain = Chain(jnp.int32(count), GRAVITY, prior, links, lidar)

    def follow(state, link):
        return (predicted(link, GRAVITY, state),) * 2

    rest = jax.lax.scan(follow, start, jax.tree.map(lambda rows: rows[:-1], links))[1]
    guess = jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, rest)
    return chain, guess, positions


def log_likelihood(chain: Chain, positions: np.ndarray) -> float:
    """Return the log-density of all measured poses as one normal vector: no smoother, no linearisation."""
    count = len(positions)
    means, blocks = [np.zeros(15)], [[np.diag(PRIOR_SIGMA**2.0)]]
    for k in range(count - 1):
        link = jax.tree.map(lambda rows, k=k: np.asarray(rows[k]), chain.imu)
        T = float(link.duration)
        F = np.eye(15)
        F[3:6, 6:9] = T * np.eye(3)
        for rows, gained in ((slice(3, 6), link.position), (slice(6, 9), link.velocity)):
            x, y, z = gained
            F[rows, 0:3] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        F[:9, 9:] = link.bias_jacobian
        fall = np.concatenate([np.zeros(3), T**2 / 2 * GRAVITY + link.position, T * GRAVITY + link.velocity])
        means.append(F @ means[-1] + np.concatenate([fall, np.zeros(6)]))
        row = [F @ block for block in blocks[-1]]
        noise = link.covariance + np.diag(np.square(FLOOR))
        row.append(row[-1] @ F.T + noise)
        blocks.append(row)
    covariance = np.zeros((6 * count, 6 * count))
    for i, row in enumerate(blocks):
        for j, block in enumerate(row):
            part = block[:6, :6]
            covariance[6 * i : 6 * i + 6, 6 * j : 6 * j + 6] = part
            covariance[6 * j : 6 * j + 6, 6 * i : 6 * i + 6] = part.T
    sigma = np.tile(POSE_SIGMA, count)
    covariance += np.diag(sigma**2)
    error = np.concatenate([np.zeros((count, 3)), positions], axis=1) - np.stack([m[:6] for m in means])
    # in units of the sigmas: their squares differ by 1e14
    scaled, error = covariance / np.outer(sigma, sigma), error.ravel() / sigma
    log_det = np.linalg.slogdet(2 * np.pi * scaled)[1] + 2 * np.log(sigma).sum()
    return -0.5 * (log_det + error @ np.linalg.solve(scaled, error))


def row_of(tree, k):
    return jax.tree.map(lambda rows: rows[k], tree)
