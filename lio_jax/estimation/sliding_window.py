"""A window of states that is smoothed together, the marginal prior that stands for older ones, and the
likelihood."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.error_state import sphere_basis
from lio_jax.core.geometry import rotation_matrix
from lio_jax.estimation.bordered import log_determinant_bordered
from lio_jax.estimation.chain import Chain, information_of, linearise
from lio_jax.estimation.factors import (
    PoseMeasurement,
    PositionMeasurement,
    RelativePose,
    imu_information,
    predicted,
    tilted,
)
from lio_jax.estimation.innovation import square_root_information
from lio_jax.estimation.marginal_prior import LOG_2PI, Prior, Quadratic, marginalised
from lio_jax.estimation.motion_state import DOF, MotionState
from lio_jax.estimation.smoother import Smoothed, smooth
from lio_jax.imu.preintegration import Preintegrated


def log_evidence(chain: Chain, smoothed: Smoothed) -> Float[Array, ""]:
    """Return the log marginal likelihood of all measurements, by Laplace's approximation.

    ``log p(z) = log p(z, x) + d / 2 log(2 pi) - log|H| / 2`` at the d most probable unknowns x, with the
    Gauss-Newton Hessian H (MacKay, "Information theory, inference, and learning algorithms", 2003, chapter
    27). It is exact for a linear Gaussian model. A robust kernel changes the cost and the Hessian, but not
    the normalisation of a measurement's density: an outlier keeps a cost, but does not dominate. The
    derivative is that of the solution and of the log-determinant; no iteration is differentiated.

    Args:
        chain: the measurements.
        smoothed: the most probable states of the chain.
    """
    matrix, unknowns = smoothed.normal.matrix, DOF * chain.count + len(smoothed.tilt)
    volume = unknowns / 2 * LOG_2PI - log_determinant_bordered(matrix) / 2
    return log_scale(chain) - smoothed.normal.cost + volume


def log_scale(chain: Chain) -> Float[Array, ""]:
    """Return the log-density of all measurements and of the prior if every residual were zero."""
    present = chain.present()
    linked = jnp.concatenate([present[1:], jnp.zeros(1, bool)])
    of_links = jax.vmap(imu_information)(chain.imu.covariance)[1]
    total = chain.prior.log_scale + _sum(of_links - DOF * LOG_2PI, linked)
    total += _sum(_of_information(chain.lidar.information), present & chain.lidar.mask)
    if chain.relative is not None:
        total += _sum(_of_information(chain.relative.information), linked & chain.relative.mask)
    if chain.gps is not None:
        of_axes = -2 * jnp.log(chain.gps.sigma) - LOG_2PI
        total += _sum(jnp.sum(of_axes, axis=-1), present & chain.gps.mask)
    return total


def _sum(twice: Float[Array, " n"], there: Array) -> Float[Array, ""]:
    return jnp.sum(jnp.where(there, twice, 0.0)) / 2


def _of_information(information: Float[Array, "n d d"]) -> Float[Array, " n"]:
    """Return log|A| - d log(2 pi) over the d directions of each matrix that have information."""
    nothing = jnp.zeros(information.shape[:-1], information.dtype)
    values = jax.vmap(square_root_information)(information, nothing)[2]
    there = values > 0
    return jnp.sum(jnp.where(there, jnp.log(jnp.where(there, values, 1.0)) - LOG_2PI, 0.0), axis=-1)


class Window(eqx.Module):
    """The latest states, at most n of them, with their measurements; the oldest is first."""

    chain: Chain
    """Measurements of the states."""
    states: MotionState
    """n states; rows from ``chain.count`` on are padding."""
    tilt: Float[Array, " q"]
    """Tilt of gravity, rad; empty where its direction is known."""

    def latest(self) -> MotionState:
        """Return the newest state."""
        return jax.tree.map(lambda rows: rows[self.chain.count - 1], self.states)

    def gravity(self) -> Float[Array, "3"]:
        """Return the acceleration of gravity, m/s^2, in world."""
        return tilted(self.chain.gravity, self.tilt)


class Added(eqx.Module):
    """The measurements of a new state."""

    link: Preintegrated
    """Preintegrated samples from the latest state to the new one."""
    lidar: PoseMeasurement
    """Pose of the new state by scan matching."""
    relative: RelativePose | None = None
    """Pose of the new state in the frame of the latest one."""
    gps: PositionMeasurement | None = None
    """Position of the antenna at the new state."""


def open_window(capacity: int, prior: Prior, gravity: Float[Array, "3"], first: Added) -> Window:
    """Return a window of one state, the mean of its prior.

    Args:
        capacity: largest number of states, at least two.
        prior: prior of the first state, and of the tilt of gravity where its direction is unknown.
        gravity: m/s^2, in world, without the tilt.
        first: measurements of the first state. The window has room for relative poses and GPS only if
            ``first`` has them. Its ``link`` and ``relative`` are not used otherwise.
    """
    padding = Added(
        link=still_link(prior.gradient.dtype),
        lidar=dataclasses.replace(first.lidar, mask=jnp.array(False)),
        relative=first.relative and dataclasses.replace(first.relative, mask=jnp.array(False)),
        gps=first.gps and dataclasses.replace(first.gps, mask=jnp.array(False)),
    )

    def rows(leaf: Array) -> Array:
        return jnp.broadcast_to(leaf, (capacity, *leaf.shape))

    blank = jax.tree.map(rows, padding)
    chain = Chain(jnp.int32(1), gravity, prior, blank.link, blank.lidar, blank.relative, blank.gps)
    window = Window(chain, jax.tree.map(rows, prior.origin), prior.tilt)
    return _with_measurements(window, first, jnp.int32(0))


def append(window: Window, added: Added) -> Window:
    """Return the window with one more state, predicted from the latest one.

    A full window forgets its oldest state first.

    Args:
        window: states and measurements.
        added: measurements of the new state.
    """
    full = window.chain.count == window.states.velocity.shape[0]
    window = jax.lax.cond(full, forget_oldest, lambda window: window, window)
    chain, row = window.chain, window.chain.count
    new = predicted(added.link, window.gravity(), window.latest())
    states = jax.tree.map(lambda rows, state: rows.at[row].set(state), window.states, new)
    imu = jax.tree.map(lambda rows, link: rows.at[row - 1].set(link), chain.imu, added.link)
    chain = eqx.tree_at(lambda chain: (chain.count, chain.imu), chain, (row + 1, imu))
    if added.relative is not None:
        relative = jax.tree.map(lambda rows, leaf: rows.at[row - 1].set(leaf), chain.relative, added.relative)
        chain = eqx.tree_at(lambda chain: chain.relative, chain, relative)
    return _with_measurements(Window(chain, states, window.tilt), added, row)


def update(window: Window, *, max_iterations: int, tolerance: Float[Array, ""]) -> tuple[Window, Smoothed]:
    """Return the window with its states smoothed, and the smoother's result.

    Args:
        window: states and measurements.
        max_iterations: see :func:`smooth`.
        tolerance: see :func:`smooth`.
    """
    smoothed = smooth(
        window.chain, window.states, window.tilt, max_iterations=max_iterations, tolerance=tolerance
    )
    return Window(window.chain, smoothed.states, smoothed.tilt), smoothed


def append_and_update(
    window: Window, added: Added, *, max_iterations: int, tolerance: Float[Array, ""]
) -> tuple[Window, Smoothed]:
    """Return the window with one more state and all states smoothed, and the smoother's result."""
    return update(append(window, added), max_iterations=max_iterations, tolerance=tolerance)


def forget_oldest(window: Window) -> Window:
    """Return the window without its first state, which is marginalised into the prior of the second.

    The marginalised measurements stay linearised at the current states, with their current robust weights.
    This is the approximation of every fixed-lag smoother (Sibley et al., JFR 2010).

    Args:
        window: at least two states.
    """
    chain = window.chain
    pair = eqx.tree_at(lambda chain: chain.count, chain.map_rows(lambda leaf: leaf[:2]), jnp.int32(2))
    # the second state's own measurements are not marginalised
    pair = eqx.tree_at(lambda chain: chain.lidar.mask, pair, pair.lidar.mask.at[1].set(False))
    if pair.gps is not None:
        pair = eqx.tree_at(lambda chain: chain.gps.mask, pair, pair.gps.mask.at[1].set(False))
    states = jax.tree.map(lambda rows: rows[:2], window.states)
    normal = linearise(pair, information_of(pair), states, window.tilt)
    (first, second), across = normal.matrix.chain.diagonal, normal.matrix.chain.coupling[0]
    border = normal.matrix.border.reshape(2 * DOF, -1)
    own = jnp.block([[first, across.T], [across, second]])
    joint = Quadratic(
        cost=normal.cost,
        gradient=jnp.concatenate([normal.gradient.ravel(), normal.by_tilt]),
        hessian=jnp.block([[own, border], [border.T, normal.matrix.corner]]),
        weight=jnp.ones_like(normal.cost),
    )
    following = jax.tree.map(lambda rows: rows[1], states)
    prior = marginalised(joint, log_scale(pair), following, window.tilt)
    fewer = chain.map_rows(_moved_up)
    fewer = eqx.tree_at(lambda chain: (chain.count, chain.prior), fewer, (chain.count - 1, prior))
    return Window(fewer, jax.tree.map(_moved_up, window.states), window.tilt)


def moved_by(window: Window, T_new_old: jaxlie.SE3) -> Window:
    """Return the window in another world frame with the same vertical.

    Information and covariances of states refer to right perturbations, and preintegrated samples to the IMU,
    so they stay as they are. The tilt of gravity is about axes of the world, and turns with them.

    Args:
        window: without GPS positions.
        T_new_old: from the old frame to the new one, m; its rotation is about the axis of ``chain.gravity``,
            which is gravity without its tilt.
    """
    chain, prior = window.chain, window.chain.prior
    turn = turn_of_tilt(chain.gravity, T_new_old)[: len(window.tilt), : len(window.tilt)]
    unknowns = jax.scipy.linalg.block_diag(jnp.eye(DOF, dtype=turn.dtype), turn)
    moved = Prior(
        origin=prior.origin.moved_by(T_new_old),
        tilt=turn @ prior.tilt,
        information=unknowns @ prior.information @ unknowns.T,
        gradient=unknowns @ prior.gradient,
        log_scale=prior.log_scale,
    )
    chain = eqx.tree_at(
        lambda chain: (chain.prior, chain.lidar.T_world_imu),
        chain,
        (moved, T_new_old @ chain.lidar.T_world_imu),
    )
    return Window(chain, window.states.moved_by(T_new_old), turn @ window.tilt)


def turn_of_tilt(gravity: Float[Array, "3"], T_new_old: jaxlie.SE3) -> Float[Array, "2 2"]:
    """Return the matrix by which the tilt of gravity turns with the world.

    Args:
        gravity: without the tilt, m/s^2.
        T_new_old: from the old world to the new one; its rotation is about ``gravity``.
    """
    axes = sphere_basis(gravity)
    return axes.T @ rotation_matrix(T_new_old.rotation()) @ axes


def _moved_up(rows: Array) -> Array:
    return jnp.concatenate([rows[1:], rows[-1:]])


def _with_measurements(window: Window, added: Added, row: Array) -> Window:
    chain = window.chain
    put = lambda rows, leaf: rows.at[row].set(leaf)  # noqa: E731
    chain = eqx.tree_at(lambda chain: chain.lidar, chain, jax.tree.map(put, chain.lidar, added.lidar))
    if added.gps is not None:
        chain = eqx.tree_at(lambda chain: chain.gps, chain, jax.tree.map(put, chain.gps, added.gps))
    return Window(chain, window.states, window.tilt)


def still_link(dtype: jnp.dtype) -> Preintegrated:
    """Return a link for padding: no motion, and unit covariance."""
    return Preintegrated(
        duration=jnp.zeros((), dtype),
        rotation=jaxlie.SO3(jnp.array([1, 0, 0, 0], dtype)),
        position=jnp.zeros(3, dtype),
        velocity=jnp.zeros(3, dtype),
        gyro_bias=jnp.zeros(3, dtype),
        accel_bias=jnp.zeros(3, dtype),
        bias_jacobian=jnp.zeros((9, 6), dtype),
        covariance=jnp.eye(DOF, dtype=dtype),
        measured=jnp.array(True),
    )
