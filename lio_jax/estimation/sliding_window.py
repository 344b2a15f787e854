"""A chain of bounded length that follows the vehicle: what leaves it becomes the prior of what stays."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.estimation.chain import Chain, information_of, linearise
from lio_jax.estimation.imu_factor import predicted
from lio_jax.estimation.marginal_likelihood import log_scale
from lio_jax.estimation.marginal_prior import Prior, marginalised
from lio_jax.estimation.motion_state import DOF, MotionState
from lio_jax.estimation.pose_factors import PoseMeasurement, PositionMeasurement, RelativePose
from lio_jax.estimation.quadratic import Quadratic
from lio_jax.estimation.smoother import Smoothed, smooth
from lio_jax.imu.preintegration import Preintegrated


class Window(eqx.Module):
    """The latest states, oldest first, at most as many as there are rows."""

    chain: Chain
    states: MotionState
    """n rows, those behind ``chain.count`` are padding."""

    def latest(self) -> MotionState:
        """Return the newest state."""
        return jax.tree.map(lambda rows: rows[self.chain.count - 1], self.states)


class Added(eqx.Module):
    """What comes with a new state."""

    link: Preintegrated
    """From the latest state to the new one."""
    lidar: PoseMeasurement
    """Of the new state."""
    relative: RelativePose | None = None
    """Of the new state in the frame of the latest one."""
    gps: PositionMeasurement | None = None
    """Of the new state."""


def open_window(capacity: int, prior: Prior, gravity: Float[Array, "3"], first: Added) -> Window:
    """Return a window of one state, the prior's mean.

    Args:
        capacity: states it has room for, at least two.
        prior: of the first state.
        gravity: in world, m/s^2.
        first: measurements of the first state; whether it has relative poses and GPS says whether the window
            will have them. ``link`` and ``relative`` lead to no state yet and are not used otherwise.
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
    window = Window(chain, jax.tree.map(rows, prior.origin))
    return _with_measurements(window, first, jnp.int32(0))


def append(window: Window, added: Added) -> Window:
    """Return the window with one more state, predicted from the latest one; a full one forgets its oldest."""
    full = window.chain.count == window.states.velocity.shape[0]
    window = jax.lax.cond(full, forget_oldest, lambda window: window, window)
    chain, row = window.chain, window.chain.count
    new = predicted(added.link, chain.gravity, window.latest())
    states = jax.tree.map(lambda rows, state: rows.at[row].set(state), window.states, new)
    imu = jax.tree.map(lambda rows, link: rows.at[row - 1].set(link), chain.imu, added.link)
    chain = eqx.tree_at(lambda chain: (chain.count, chain.imu), chain, (row + 1, imu))
    if added.relative is not None:
        relative = jax.tree.map(lambda rows, leaf: rows.at[row - 1].set(leaf), chain.relative, added.relative)
        chain = eqx.tree_at(lambda chain: chain.relative, chain, relative)
    return _with_measurements(Window(chain, states), added, row)


def update(window: Window, *, max_iterations: int, tolerance: Float[Array, ""]) -> tuple[Window, Smoothed]:
    """Return the window with its states smoothed, and the result; arguments as of :func:`smooth`."""
    smoothed = smooth(window.chain, window.states, max_iterations=max_iterations, tolerance=tolerance)
    return Window(window.chain, smoothed.states), smoothed


def append_and_update(
    window: Window, added: Added, *, max_iterations: int, tolerance: Float[Array, ""]
) -> tuple[Window, Smoothed]:
    """Return the window with one more state, all of them smoothed, and the smoother's result."""
    return update(append(window, added), max_iterations=max_iterations, tolerance=tolerance)


def forget_oldest(window: Window) -> Window:
    """Return the window without its first state, of at least two, whose knowledge goes into the prior.

    What is linearised is linearised where the states stand now, robust weights included, for good: the
    approximation of every fixed-lag smoother (Sibley et al., JFR 2010).
    """
    chain = window.chain
    pair = eqx.tree_at(lambda chain: chain.count, chain.map_rows(lambda leaf: leaf[:2]), jnp.int32(2))
    # the second state's own measurements stay behind
    pair = eqx.tree_at(lambda chain: chain.lidar.mask, pair, pair.lidar.mask.at[1].set(False))
    if pair.gps is not None:
        pair = eqx.tree_at(lambda chain: chain.gps.mask, pair, pair.gps.mask.at[1].set(False))
    states = jax.tree.map(lambda rows: rows[:2], window.states)
    normal = linearise(pair, information_of(pair), states)
    (first, second), across = normal.matrix.diagonal, normal.matrix.coupling[0]
    joint = Quadratic(
        cost=normal.cost,
        gradient=normal.gradient.ravel(),
        hessian=jnp.block([[first, across.T], [across, second]]),
        weight=jnp.ones_like(normal.cost),
    )
    prior = marginalised(joint, log_scale(pair), jax.tree.map(lambda rows: rows[1], states))
    fewer = chain.map_rows(_moved_up)
    fewer = eqx.tree_at(lambda chain: (chain.count, chain.prior), fewer, (chain.count - 1, prior))
    return Window(fewer, jax.tree.map(_moved_up, window.states))


def _moved_up(rows: Array) -> Array:
    return jnp.concatenate([rows[1:], rows[-1:]])


def _with_measurements(window: Window, added: Added, row: Array) -> Window:
    chain = window.chain
    put = lambda rows, leaf: rows.at[row].set(leaf)  # noqa: E731
    chain = eqx.tree_at(lambda chain: chain.lidar, chain, jax.tree.map(put, chain.lidar, added.lidar))
    if added.gps is not None:
        chain = eqx.tree_at(lambda chain: chain.gps, chain, jax.tree.map(put, chain.gps, added.gps))
    return Window(chain, window.states)


def still_link(dtype: jnp.dtype) -> Preintegrated:
    """Return a link that is padding."""
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
