"""A chain of states with all measurements along it, and its normal equations.

The direction of gravity is an unknown that all states share, if the prior contains its tilt.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.estimation.block_tridiagonal import BlockTridiagonal
from lio_jax.estimation.bordered import Bordered
from lio_jax.estimation.factors import (
    PoseMeasurement,
    PositionMeasurement,
    RelativePose,
    imu_information,
    imu_quadratic,
)
from lio_jax.estimation.marginal_prior import Prior, Quadratic
from lio_jax.estimation.motion_state import DOF, POSE_DOF, MotionState
from lio_jax.imu.preintegration import Preintegrated


class Chain(eqx.Module):
    """Measurements of n states, in n rows; a measurement between two states is in the row of the first."""

    count: Int32[Array, ""]
    """Number of real states. Later rows are padding, and so are the links to them."""
    gravity: Float[Array, "3"]
    """Acceleration of gravity, m/s^2, in world, without the tilt."""
    prior: Prior
    """Prior of the first state, and of the tilt of gravity where its direction is unknown."""
    imu: Preintegrated
    """Preintegrated samples to the next state; the last row is not used. A link without samples has a large
    covariance."""
    lidar: PoseMeasurement
    """Pose of each state by scan matching."""
    relative: RelativePose | None = None
    """Pose of the next state in the frame of each; None: there are no such measurements."""
    gps: PositionMeasurement | None = None
    """Position of the antenna at each state; None: there are no such measurements."""

    def present(self) -> Bool[Array, " n"]:
        """Return the mask of real states."""
        return jnp.arange(self.imu.duration.shape[0]) < self.count

    def map_rows(self, change: Callable[..., Array], *others: "Chain") -> "Chain":
        """Return the chain with all arrays of n rows changed.

        Args:
            change: function of an array of n rows, and of the same array of each of ``others``.
            others: chains of the same structure.
        """
        fields = lambda chain: (chain.imu, chain.lidar, chain.relative, chain.gps)  # noqa: E731
        rows = jax.tree.map(change, fields(self), *map(fields, others))
        return Chain(self.count, self.gravity, self.prior, *rows)


class FactorWeights(NamedTuple):
    """Weights of the measurements by the robust kernel, from 0 to 1; 0 where there is no measurement."""

    lidar: Float[Array, " n"]
    """Weights of the poses by scan matching."""
    relative: Float[Array, " m"] | None
    """Weights of the relative poses between neighbours, m = n - 1."""
    gps: Float[Array, " n"] | None
    """Weights of the antenna's positions."""


class Normal(eqx.Module):
    """The cost of a chain's states and of the tilt to second order in their errors."""

    matrix: Bordered
    """Hessian of the cost, by Gauss-Newton unless exact; the identity for padding. The tilt is common to all
    states; its border is empty where the direction of gravity is known."""
    gradient: Float[Array, "n 15"]
    """Gradient of the cost by each state's error."""
    by_tilt: Float[Array, " q"]
    """Gradient of the cost by the tilt."""
    cost: Float[Array, ""]
    """Negative log-density of states and measurements, without a constant."""
    weights: FactorWeights
    """Weights of the measurements at these states."""


def information_of(chain: Chain) -> Float[Array, "m 15 15"]:
    """Return the information of each inertial link, which does not depend on the states."""
    return jax.vmap(imu_information)(chain.imu.covariance[:-1])[0]


def linearise(
    chain: Chain,
    information: Float[Array, "m 15 15"],
    states: MotionState,
    tilt: Float[Array, " q"],
    exact: bool = False,
) -> Normal:
    """Return the normal equations of a chain.

    Args:
        chain: n rows, at least two.
        information: information of the links, from :func:`information_of`.
        states: n states at which to linearise.
        tilt: of gravity, at which to linearise, rad.
        exact: include the second derivatives of the residuals, which the derivative of a solution needs. The
            matrix is then the derivative of the gradient, which is symmetric where the gradient vanishes.
    """
    present = chain.present()
    start = jax.tree.map(lambda rows: rows[:-1], states)
    end = jax.tree.map(lambda rows: rows[1:], states)

    def over(quadratic: Callable[..., Quadratic], dof: int, there: Array, row: Any, *of: Any) -> Quadratic:
        terms = jax.vmap(_to_second_order(quadratic, dof) if exact else quadratic)(row, *of)
        return jax.tree.map(lambda leaf: jnp.where(_column(there, leaf), leaf, 0.0), terms)

    first = jax.tree.map(lambda rows: rows[:1], states)
    gravity, tilts = (jnp.broadcast_to(one, (len(information), len(one))) for one in (chain.gravity, tilt))
    of_prior = jax.tree.map(lambda leaf: leaf[None], chain.prior)
    prior = over(Prior.quadratic, DOF, present[:1], of_prior, first, tilt[None])
    link = _leading(chain.imu), gravity, information
    links = over(_link_quadratic, DOF, present[1:], link, start, end, tilts)
    lidar = over(PoseMeasurement.quadratic, POSE_DOF, present, chain.lidar, states)
    unary = [prior, lidar]
    binary = [links]
    relative = gps = None
    if chain.relative is not None:
        row = _leading(chain.relative)
        relative = over(RelativePose.quadratic, POSE_DOF, present[1:], row, start, end)
        binary.append(relative)
    if chain.gps is not None:
        gps = over(PositionMeasurement.quadratic, POSE_DOF, present, chain.gps, states)
        unary.append(gps)
    chain_matrix, gradient = _assembled(present, unary, binary)
    border, corner, slope = _with_tilt(len(present), prior, links)
    return Normal(
        matrix=Bordered(chain_matrix, border, corner),
        gradient=gradient,
        by_tilt=slope,
        cost=sum((jnp.sum(term.cost) for term in unary + binary), jnp.zeros((), gradient.dtype)),
        weights=FactorWeights(
            lidar.weight, relative.weight if relative else None, gps.weight if gps else None
        ),
    )


def _assembled(
    present: Array, unary: list[Quadratic], binary: list[Quadratic]
) -> tuple[BlockTridiagonal, Array]:
    """Return the sums of all terms' Hessians and gradients by the states' errors."""
    dtype = unary[0].gradient.dtype
    diagonal = jnp.where(present[:, None, None], 0.0, jnp.eye(DOF, dtype=dtype))
    coupling = jnp.zeros((len(present) - 1, DOF, DOF), dtype)
    gradient = jnp.zeros((len(present), DOF), dtype)
    for term in unary:
        rows, part = slice(len(term.gradient)), slice(min(term.gradient.shape[1], DOF))
        diagonal = diagonal.at[rows, part, part].add(term.hessian[:, part, part])
        gradient = gradient.at[rows, part].add(term.gradient[:, part])
    for term in binary:
        dof = min(term.gradient.shape[1] // 2, DOF)
        part, first, second = slice(dof), slice(dof), slice(dof, 2 * dof)
        diagonal = diagonal.at[:-1, part, part].add(term.hessian[:, first, first])
        diagonal = diagonal.at[1:, part, part].add(term.hessian[:, second, second])
        coupling = coupling.at[:, part, part].add(term.hessian[:, second, first])
        gradient = gradient.at[:-1, part].add(term.gradient[:, first])
        gradient = gradient.at[1:, part].add(term.gradient[:, second])
    return BlockTridiagonal((diagonal + jnp.swapaxes(diagonal, 1, 2)) / 2, coupling), gradient


def _with_tilt(count: int, prior: Quadratic, links: Quadratic) -> tuple[Array, Array, Array]:
    """Return the border and the corner of the Hessian, and the gradient by the tilt.

    Args:
        count: number of the chain's rows.
        prior: one term by the errors of the first state and of the tilt.
        links: terms by the errors of both states and of the tilt.
    """
    own, pair = slice(DOF), slice(2 * DOF)
    border = jnp.zeros((count, DOF, prior.gradient.shape[1] - DOF), prior.gradient.dtype)
    border = border.at[0].add(prior.hessian[0, own, DOF:])
    across = links.hessian[:, pair, 2 * DOF :]
    border = border.at[:-1].add(across[:, own]).at[1:].add(across[:, DOF:])
    corner = prior.hessian[0, DOF:, DOF:] + jnp.sum(links.hessian[:, 2 * DOF :, 2 * DOF :], axis=0)
    slope = prior.gradient[0, DOF:] + jnp.sum(links.gradient[:, 2 * DOF :], axis=0)
    return border, (corner + corner.T) / 2, slope


def _link_quadratic(link: tuple, start: MotionState, end: MotionState, tilt: Array) -> Quadratic:
    measured, gravity, information = link
    return imu_quadratic(measured, gravity, tilt, information, start, end)


def _to_second_order(quadratic: Callable[..., Quadratic], dof: int) -> Callable[..., Quadratic]:
    """Return the same cost with the derivative of its gradient in place of Gauss-Newton's Hessian."""

    def curved(row: Any, *of: Any) -> Quadratic:
        states = [one for one in of if isinstance(one, MotionState)]
        tilts = of[len(states) :]

        def gradient(error: Array) -> Array:
            parts = error[: dof * len(states)].reshape(len(states), dof)
            padded = jnp.pad(parts, ((0, 0), (0, DOF - dof)))
            moved = [state.retract(part) for state, part in zip(states, padded, strict=True)]
            turned = [tilt + error[dof * len(states) :] for tilt in tilts]
            return quadratic(row, *moved, *turned).gradient

        unknowns = dof * len(states) + sum(map(len, tilts))
        slope = jax.jacfwd(gradient)(jnp.zeros(unknowns, states[0].velocity.dtype))
        return eqx.tree_at(lambda term: term.hessian, quadratic(row, *of), slope)

    return curved


def _leading(rows: Any) -> Any:
    return jax.tree.map(lambda leaf: leaf[:-1], rows)


def _column(there: Array, leaf: Array) -> Array:
    return there.reshape(-1, *(1,) * (leaf.ndim - 1))
