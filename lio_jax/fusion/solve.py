"""The most probable unknowns of a fusion, their covariance, and the likelihood of its noise.

Iterated least squares over all states (Levenberg-Marquardt), with a cost that is linear in their number.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int32

from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, NOT_FINITE
from lio_jax.estimation.block_tridiagonal import BlockTridiagonal
from lio_jax.estimation.bordered import (
    Bordered,
    factorise_bordered,
    inverse_bordered,
    log_determinant_bordered,
    solve_bordered,
)
from lio_jax.estimation.factors import imu_residual
from lio_jax.fusion.params import FusionParams
from lio_jax.fusion.problem import (
    COMMON_DOF,
    NODE_DOF,
    FusedStates,
    Problem,
    Roots,
    common_residual,
    first_residual,
    fix_residual,
    gravity_by_level,
    gravity_in_world,
    motion_of,
    odometry_residual,
    retract_common,
    retract_node,
    roots_of,
)
from lio_jax.imu.preintegration import Preintegrated

_FIRST_DAMPING, _MOST_DAMPING, _WORTH = 1e-6, 1e8, 10.0
_PRECISION = 1e-2
"""Length of the next step, standard deviations of all unknowns together, below which the search ends."""


class FusionNormal(eqx.Module):
    """The cost of the unknowns to second order in their errors."""

    matrix: Bordered
    """Gauss-Newton's Hessian."""
    nodes: Float[Array, "n 21"]
    """Gradient by the states' errors."""
    common: Float[Array, "18"]
    """Gradient by the common unknowns' errors."""
    cost: Float[Array, ""]
    """Negative log-density of unknowns and measurements, without a constant."""


class Fused(eqx.Module):
    """The result of a fusion."""

    states: FusedStates
    """The most probable unknowns."""
    status: Int32[Array, ""]
    """CONVERGED, ITERATION_LIMIT or NOT_FINITE."""
    iterations: Int32[Array, ""]
    """Number of linearisations."""
    cost: Float[Array, ""]
    """Half the sum of squared whitened residuals."""
    negative_log_likelihood: Float[Array, ""]
    """Of the measurements, given the noise, without a constant (Laplace's approximation). It has a derivative
    by the parameters."""
    covariance: Float[Array, "n 21 21"]
    """Marginal covariance of each state's error."""
    cross_covariance: Float[Array, "n 21 18"]
    """Covariance of each state's error with the common unknowns' error."""
    common_covariance: Float[Array, "18 18"]
    """Covariance of the common unknowns' error."""


class Residuals(NamedTuple):
    """Whitened residuals."""

    link: Array
    white: Array
    first: Array
    common: Array
    fix: Array


def _rows(problem: Problem, states: FusedStates) -> tuple[tuple, tuple]:
    """Return the arguments of the residuals of links and of fixes."""
    z, x, fixes = problem.odometry, states.motion, problem.fixes
    link = (x[:-1], x[1:], (z[:-1], z[1:], problem.gyro[:-1], problem.gyro[1:]))
    elapsed = jnp.diff(problem.time)[fixes.link]
    fix = (x[fixes.link], x[fixes.link + 1], (fixes.share, elapsed, fixes.position))
    return link, fix


def whitened_residuals(
    problem: Problem, params: FusionParams, roots: Roots, states: FusedStates
) -> Residuals:
    """Return all residuals, whitened by ``roots``; half their sum of squares is the cost without kernel."""
    (a, b, row), (c, d, fix) = _rows(problem, states)
    packed, gravity, arm = states.common, params.imu.gravity, params.gps.lever_arm
    down = gravity_in_world(packed, gravity)
    imu = jax.vmap(lambda a, b, imu: imu_residual(imu, down, motion_of(a), motion_of(b))[0])(
        a, b, problem.imu
    )
    odometry = jax.vmap(lambda a, b, row: odometry_residual(a, b, packed, row))(a, b, row)
    link = jnp.concatenate([imu, odometry], axis=1)
    fixes = jax.vmap(lambda c, d, fix: fix_residual(c, d, packed, fix, arm))(c, d, fix)
    return Residuals(
        jnp.einsum("mij,mj->mi", roots.link, link),
        roots.white * states.motion[:, 16:],
        roots.first * first_residual(states.motion[0], packed, problem),
        roots.common * common_residual(packed, problem),
        roots.fix * fixes,
    )


def _cost(residuals: Residuals, kernel: Array) -> Array:
    square = jnp.sum(residuals.fix**2, axis=1)
    plain = sum((jnp.sum(part**2) for part in residuals[:4]), jnp.zeros_like(kernel))
    return (plain + jnp.sum(square / (1 + square / kernel**2))) / 2


def linearise_fusion(
    problem: Problem, params: FusionParams, roots: Roots, states: FusedStates, kernel: Array
) -> FusionNormal:
    """Return the normal equations at given unknowns.

    Args:
        problem: the measurements.
        params: noise and priors.
        roots: of ``params``.
        states: where to linearise.
        kernel: width of the fixes' Geman-McClure kernel, standard deviations; infinite for none.
    """
    dtype = states.common.dtype
    (a, b, row), (c, d, fix) = _rows(problem, states)
    gravity, arm = params.imu.gravity, params.gps.lever_arm
    no_node, no_common = jnp.zeros(NODE_DOF, dtype), jnp.zeros(COMMON_DOF, dtype)

    def pair(residual: Callable[..., Array], start: Array, end: Array, row: tuple) -> tuple[Array, Array]:
        def of(error: Array) -> tuple[Array, Array]:
            first = retract_node(start, error[:NODE_DOF])
            second = retract_node(end, error[NODE_DOF : 2 * NODE_DOF])
            shared = retract_common(states.common, error[2 * NODE_DOF :])
            value = residual(first, second, shared, row)
            return value, value

        # few residuals by many errors: backwards
        return jax.jacrev(of, has_aux=True)(jnp.concatenate([no_node, no_node, no_common]))

    down = gravity_in_world(states.common, gravity)

    def inertial(start: Array, end: Array, imu: Preintegrated) -> tuple[Array, Array]:
        value, by = imu_residual(imu, down, motion_of(start), motion_of(end))
        level = gravity_by_level(end, states.common, imu.duration, gravity)
        by = jnp.concatenate(
            [
                jnp.pad(by[:, :15], ((0, 0), (0, 6))),
                jnp.pad(by[:, 15:], ((0, 0), (0, 16))),
                jnp.where(imu.measured, level, 0.0),
                jnp.zeros((15, 5), dtype),
            ],
            axis=1,
        )
        return by, value

    imu_by, imu = jax.vmap(inertial)(a, b, problem.imu)
    odometry_by, odometry = jax.vmap(lambda a, b, row: pair(odometry_residual, a, b, row))(a, b, row)
    fix_by, fixes = jax.vmap(
        lambda c, d, fix: pair(
            lambda first, second, shared, row: fix_residual(first, second, shared, row, arm), c, d, fix
        )
    )(c, d, fix)
    link_by = jnp.concatenate([imu_by, odometry_by], axis=1)
    link = jnp.concatenate([imu, odometry], axis=1)

    def first_of(error: Array) -> Array:
        common = retract_common(states.common, error[NODE_DOF:])
        return first_residual(retract_node(states.motion[0], error[:NODE_DOF]), common, problem)

    def common_of_error(error: Array) -> Array:
        return common_residual(retract_common(states.common, error), problem)

    first_by = jax.jacrev(first_of)(jnp.concatenate([no_node, no_common])) * roots.first[:, None]
    first = first_residual(states.motion[0], states.common, problem) * roots.first
    prior_by = jax.jacrev(common_of_error)(no_common) * roots.common[:, None]
    prior = common_residual(states.common, problem) * roots.common
    link_by, link = roots.link @ link_by, jnp.einsum("mij,mj->mi", roots.link, link)
    fix_by, fixes = roots.fix[:, :, None] * fix_by, roots.fix * fixes
    cost = _cost(Residuals(link, roots.white * states.motion[:, 16:], first, prior, fixes), kernel)
    square = jnp.sum(fixes**2, axis=1, keepdims=True)
    weight = jax.lax.stop_gradient(1 / (1 + square / kernel**2))
    fix_by, fixes = fix_by * weight[:, :, None], fixes * weight

    count = len(states.motion)
    diagonal = jnp.zeros((count, NODE_DOF, NODE_DOF), dtype)
    coupling = jnp.zeros((count - 1, NODE_DOF, NODE_DOF), dtype)
    border = jnp.zeros((count, NODE_DOF, COMMON_DOF), dtype)
    nodes = jnp.zeros((count, NODE_DOF), dtype)
    corner, common = prior_by.T @ prior_by, prior_by.T @ prior
    rows = (jnp.arange(count - 1), problem.fixes.link)
    for at, by, value in zip(rows, (link_by, fix_by), (link, fixes), strict=True):
        left, right, shared = by[..., :NODE_DOF], by[..., NODE_DOF : 2 * NODE_DOF], by[..., 2 * NODE_DOF :]
        left_t, right_t, shared_t = (jnp.swapaxes(part, 1, 2) for part in (left, right, shared))
        diagonal = diagonal.at[at].add(left_t @ left).at[at + 1].add(right_t @ right)
        coupling = coupling.at[at].add(right_t @ left)
        border = border.at[at].add(left_t @ shared).at[at + 1].add(right_t @ shared)
        nodes = nodes.at[at].add((left_t @ value[..., None])[..., 0])
        nodes = nodes.at[at + 1].add((right_t @ value[..., None])[..., 0])
        corner = corner + jnp.sum(shared_t @ shared, axis=0)
        common = common + jnp.sum((shared_t @ value[..., None])[..., 0], axis=0)
    own, shared = first_by[:, :NODE_DOF], first_by[:, NODE_DOF:]
    diagonal = diagonal.at[0].add(own.T @ own).at[:, 15:, 15:].add(jnp.diag(roots.white**2))
    border = border.at[0].add(own.T @ shared)
    nodes = nodes.at[0].add(own.T @ first).at[:, 15:].add(roots.white**2 * states.motion[:, 16:])
    matrix = Bordered(BlockTridiagonal(diagonal, coupling), border, corner + shared.T @ shared)
    return FusionNormal(matrix, nodes, common + shared.T @ first, cost)


class _Search(NamedTuple):
    states: FusedStates
    damping: Array
    cost: Array
    iterations: Array
    status: Array


def _damped(matrix: Bordered, damping: Array) -> Bordered:
    diagonal, corner = matrix.chain.diagonal, matrix.corner
    own = jnp.diagonal(diagonal, axis1=1, axis2=2)[:, :, None] * jnp.eye(NODE_DOF, dtype=corner.dtype)
    chain = BlockTridiagonal(diagonal + damping * own, matrix.chain.coupling)
    return Bordered(chain, matrix.border, corner + damping * jnp.diag(jnp.diagonal(corner)))


@jax.jit
def search(
    problem: Problem, params: FusionParams, states: FusedStates, kernel: Array, most: Int32[Array, ""]
) -> tuple[FusedStates, Int32[Array, ""], Int32[Array, ""], Float[Array, ""]]:
    """Return the most probable unknowns, the status, the number of linearisations, and the cost.

    Args:
        problem: the measurements.
        params: noise and priors.
        states: first guess.
        kernel: width of the fixes' kernel, standard deviations; infinite for none.
        most: largest number of linearisations.
    """
    roots = roots_of(problem, params)

    def step(search: _Search) -> _Search:
        normal = linearise_fusion(problem, params, roots, search.states, kernel)
        factor = factorise_bordered(_damped(normal.matrix, search.damping))
        nodes, common = solve_bordered(factor, -normal.nodes, -normal.common)
        trial = search.states.retract(nodes, common)
        cost = _cost(whitened_residuals(problem, params, roots, trial), kernel)
        decrement = -jnp.sum(nodes * normal.nodes) - jnp.sum(common * normal.common)
        better = cost <= normal.cost
        near = jnp.abs(decrement) < _PRECISION**2
        taken = better | (near & jnp.isfinite(cost))
        kept = jax.tree.map(lambda new, old: jnp.where(taken, new, old), trial, search.states)
        damping = jnp.where(better, search.damping / _WORTH, search.damping * _WORTH)
        status = jnp.where(near, CONVERGED, ITERATION_LIMIT)
        status = jnp.where(jnp.isfinite(normal.cost), status, NOT_FINITE).astype(jnp.int32)
        return _Search(kept, damping, jnp.where(taken, cost, normal.cost), search.iterations + 1, status)

    def going(search: _Search) -> Array:
        more = (search.iterations < most) & (search.damping <= _MOST_DAMPING)
        return (search.status == ITERATION_LIMIT) & more

    zero, dtype = jnp.zeros((), jnp.int32), states.common.dtype
    begin = _Search(
        states,
        jnp.asarray(_FIRST_DAMPING, dtype),
        jnp.asarray(jnp.inf, dtype),
        zero,
        zero + ITERATION_LIMIT,
    )
    end = jax.lax.while_loop(going, step, begin)
    return end.states, end.status, end.iterations, end.cost


def negative_log_likelihood(
    problem: Problem, params: FusionParams, states: FusedStates, kernel: Array, exact: bool = True
) -> Float[Array, ""]:
    """Return the negative log-likelihood of the measurements by Laplace's approximation.

    Its derivative is by the parameters; ``states`` are the most probable unknowns for them.

    Args:
        problem: the measurements.
        params: noise and priors.
        states: result of :func:`search` for these parameters.
        kernel: as for :func:`search`.
        exact: follow the states through the log-determinant too, which takes far more memory. Otherwise the
            derivative is that at fixed states.
    """
    held = jax.lax.stop_gradient(states)
    roots = roots_of(problem, params)
    if exact:
        normal = linearise_fusion(problem, params, roots, held, kernel)
        factor = jax.lax.stop_gradient(factorise_bordered(normal.matrix))
        # zero, with the derivative of the gradient
        pull = [jax.lax.stop_gradient(part) - part for part in (normal.nodes, normal.common)]
        nodes, common = solve_bordered(factor, *pull)
        held = held.retract(nodes, common)
    return _laplace(linearise_fusion(problem, params, roots, held, kernel), roots)


def _laplace(normal: FusionNormal, roots: Roots) -> Array:
    return normal.cost + log_determinant_bordered(normal.matrix) / 2 - roots.log_determinant()


@eqx.filter_jit
def fuse(
    problem: Problem, params: FusionParams, states: FusedStates, iterations: int = 50, exact: bool = False
) -> Fused:
    """Return the most probable unknowns of a fusion, their covariance, and the likelihood of the noise.

    The function is pure. ``negative_log_likelihood`` has a derivative by ``params``; nothing else has one.
    The fixes are taken with all their weight first, and then with their kernel, so that a poor first guess
    does not lose them. Turn on double precision: float32 does not hold the information of inertial samples.

    Args:
        problem: the measurements, from :func:`prepare_fusion`.
        params: noise, priors and calibration.
        states: first guess, from :func:`prepare_fusion`.
        iterations: largest number of linearisations of each of both searches.
        exact: as for :func:`negative_log_likelihood`.
    """
    held = jax.lax.stop_gradient(params)
    most = jnp.asarray(iterations, jnp.int32)
    kernels = [jnp.full_like(held.gps.kernel, jnp.inf)]
    if len(problem.fixes.link):
        kernels = [*kernels, held.gps.kernel]

    def again(begun: tuple, kernel: Array) -> tuple[tuple, None]:
        states, _, iterations, _ = begun
        states, status, more, cost = search(problem, held, states, kernel, most)
        return (states, status, iterations + more, cost), None

    zero = jnp.zeros((), jnp.int32)
    begin = (jax.lax.stop_gradient(states), zero, zero, jnp.zeros_like(held.gps.kernel))
    (found, status, count, cost), _ = jax.lax.scan(again, begin, jnp.stack(kernels))
    roots = roots_of(problem, params)
    normal = linearise_fusion(problem, params, roots, found, kernels[-1])
    value = _laplace(normal, roots)
    if exact:
        value = negative_log_likelihood(problem, params, found, kernels[-1])
    inverse = inverse_bordered(factorise_bordered(jax.lax.stop_gradient(normal.matrix)))
    covariances = inverse.chain.diagonal, inverse.border, inverse.corner
    return Fused(found, status, count, cost, value, *covariances)
