"""The most probable states of a chain, that of a window or of a whole recording.

The method is Gauss-Newton on all states at once, with a damped step (Levenberg-Marquardt) where a full step
does not lower the cost. Block-tridiagonal Cholesky makes the cost of a step linear in the number of states
(Barfoot, "State estimation for robotics", 2017, chapter 3). Run it in float64: the information of 0.1 s of
inertial samples is 1e10 times that of a prior.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.implicit import ImplicitSolution, Problem, implicit
from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, NOT_FINITE
from lio_jax.estimation.block_tridiagonal import BlockTridiagonal
from lio_jax.estimation.bordered import Bordered, factorise_bordered, inverse_bordered, solve_bordered
from lio_jax.estimation.chain import Chain, Normal, information_of, linearise
from lio_jax.estimation.motion_state import DOF, MotionState

_FIRST_DAMPING = 1e-4
_LEAST_DAMPING = 1e-6
"""Damping below which it becomes zero."""
_MOST_DAMPING = 1e8
"""Damping at which the search ends without convergence."""
_WORTH = 10.0
"""Factor by which the damping changes after each step."""
_LONGEST = 2.0
"""Largest share of a step that is taken, and the inverse of the smallest."""


class Smoothed(eqx.Module):
    """The result of a smoother."""

    states: MotionState
    """The most probable n states."""
    tilt: Float[Array, " q"]
    """The most probable tilt of gravity, rad; empty where gravity's direction is known."""
    normal: Normal
    """Normal equations at ``states`` and ``tilt``."""
    status: Int32[Array, ""]
    """CONVERGED, ITERATION_LIMIT or NOT_FINITE; in the last case the states are the last finite ones."""
    iterations: Int32[Array, ""]
    """Number of linearisations."""
    decrement: Float[Array, ""]
    """Distance from the minimum, standard deviations: sqrt(step' H step) of the next step, not taken."""
    unmeasured: Int32[Array, ""]
    """Number of links without inertial samples."""

    def covariances(self) -> Float[Array, "n 15 15"]:
        """Return the marginal covariance of each state's error; the identity for padding."""
        return inverse_bordered(factorise_bordered(self.normal.matrix)).chain.diagonal

    def joint_covariance(self, row: Int32[Array, ""]) -> Float[Array, "p p"]:
        """Return the joint covariance of the errors of one state and of the tilt, p = 15 + q.

        Args:
            row: of the state.
        """
        inverse = inverse_bordered(factorise_bordered(self.normal.matrix))
        across = inverse.border[row]
        return jnp.block([[inverse.chain.diagonal[row], across], [across.T, inverse.corner]])


class _Step(NamedTuple):
    """A step without damping, for comparison with the next one."""

    of_states: Float[Array, "n 15"]
    of_tilt: Float[Array, " q"]
    square: Float[Array, ""]
    """Its squared length, in squared standard deviations; inf: there is no such step."""
    share: Float[Array, ""]
    """The share of it that was taken."""


class _Loop(NamedTuple):
    trial: tuple[MotionState, Array]
    """The states and the tilt after the last step, whose cost is not known yet."""
    best: tuple[MotionState, Array]
    """The best states and tilt so far."""
    normal: Normal
    """Normal equations at ``best``."""
    damping: Float[Array, ""]
    decrement: Float[Array, ""]
    last: _Step
    """The step from ``best`` to ``trial``."""
    iterations: Int32[Array, ""]
    done: Bool[Array, ""]


class _Found(NamedTuple):
    """The part of the result that the derivative takes as constant."""

    states: MotionState
    tilt: Float[Array, " q"]
    decrement: Float[Array, ""]
    iterations: Int32[Array, ""]
    done: Bool[Array, ""]


def smooth(
    chain: Chain,
    guess: MotionState,
    tilt: Float[Array, " q"] | None = None,
    *,
    max_iterations: int | Int32[Array, ""],
    tolerance: Float[Array, ""],
) -> Smoothed:
    """Return the states that agree best with all measurements of a chain.

    Derivatives by all values in the chain are those of the converged solution, by the implicit function
    theorem with the exact second derivatives. Do not use them where ``status`` is not CONVERGED. Only first
    derivatives are correct.

    Args:
        chain: n rows, at least two; rows from ``chain.count`` on are padding.
        guess: n states, the first iterate.
        tilt: of gravity, the first iterate, rad; None: that of the prior.
        max_iterations: largest number of linearisations, at least 1, those of rejected steps included.
        tolerance: length of the next step below which the solve has converged, standard deviations.
    """
    problem = Problem(_solve, _no_probe, _gradient, _report, inverse_slope=_inverse_hessian)
    first = guess, chain.prior.tilt if tilt is None else tilt
    solution = implicit(problem, (chain, first, tolerance, max_iterations))
    states, tilt, normal = solution.reported
    found: _Found = solution.selection
    finite = jnp.isfinite(normal.cost) & jnp.isfinite(found.decrement)
    status = jnp.where(found.done, CONVERGED, jnp.where(finite, ITERATION_LIMIT, NOT_FINITE))
    linked = chain.present()[1:]
    return Smoothed(
        states=states,
        tilt=tilt,
        normal=normal,
        status=status.astype(jnp.int32),
        iterations=found.iterations,
        decrement=found.decrement,
        unmeasured=jnp.sum(linked & ~chain.imu.measured[:-1]).astype(jnp.int32),
    )


def _solve(inputs: Any) -> ImplicitSolution:
    chain, guess, tolerance, max_iterations = inputs
    information = information_of(chain)

    @jax.jit
    def normal_at(at: tuple[MotionState, Array]) -> Normal:
        return linearise(chain, information, *at)

    def iterate(loop: _Loop) -> _Loop:
        normal = normal_at(loop.trial)
        # at the minimum rounding decides whether the cost falls
        rounding = 1e3 * jnp.finfo(normal.cost.dtype).eps * (1 + jnp.abs(normal.cost))
        pays = normal.cost <= loop.normal.cost + rounding
        less = jnp.where(loop.damping > _LEAST_DAMPING, loop.damping / _WORTH, 0.0)
        damping = jnp.where(pays, less, jnp.maximum(loop.damping * _WORTH, _FIRST_DAMPING))
        (states, tilt), normal = jax.tree.map(
            lambda new, old: jnp.where(pays, new, old), (loop.trial, normal), (loop.best, loop.normal)
        )
        factor = factorise_bordered(_damped(normal.matrix, damping))
        step, turn = solve_bordered(factor, -normal.gradient, -normal.by_tilt)
        square = jnp.abs(_along(normal, step, turn))
        decrement = jnp.sqrt(square)
        share = jnp.where(pays & (damping == 0), _share(loop.last, normal), 1.0)
        return _Loop(
            trial=(states.retract(share * step), tilt + share * turn),
            best=(states, tilt),
            normal=normal,
            damping=damping,
            decrement=decrement,
            last=_Step(step, turn, jnp.where(damping == 0, square, jnp.inf), share),
            iterations=loop.iterations + 1,
            done=(damping == 0) & (decrement <= tolerance),
        )

    def unfinished(loop: _Loop) -> Array:
        return ~loop.done & (loop.iterations < max_iterations) & (loop.damping < _MOST_DAMPING)

    blank = jax.tree.map(
        lambda leaf: jnp.full(leaf.shape, jnp.inf, leaf.dtype), jax.eval_shape(normal_at, guess)
    )
    zero = jnp.zeros((), blank.cost.dtype)
    no_step = _Step(jnp.zeros_like(blank.gradient), jnp.zeros_like(blank.by_tilt), zero + jnp.inf, zero + 1)
    start = _Loop(guess, guess, blank, zero, zero, no_step, jnp.int32(0), jnp.array(False))
    loop = jax.lax.while_loop(unfinished, iterate, start)
    root = jnp.zeros(blank.gradient.size + blank.by_tilt.size, blank.gradient.dtype)
    kept = _Found(*loop.best, loop.decrement, loop.iterations, loop.done)
    return ImplicitSolution(root, kept, (*loop.best, loop.normal))


def _along(normal: Normal, of_states: Array, of_tilt: Array) -> Array:
    """Return the slope of the cost along a step."""
    return jnp.sum(of_states * normal.gradient) + jnp.sum(of_tilt * normal.by_tilt)


def _share(last: _Step, normal: Normal) -> Array:
    """Return the share of the next step that leads to the minimum along the last one.

    The cost's second derivative along a step is ``curvature`` times that of Gauss-Newton, which leaves out
    the curvature of large residuals. It shows in the slope that remains after the step (Barzilai & Borwein
    1988). Where one weak direction holds most of the error, as those of an accelerometer bias and of gravity
    do, full steps would come nearer to the minimum only by a constant factor each.
    """
    remaining = -_along(normal, last.of_states, last.of_tilt) / last.square
    curvature = (1 - remaining) / last.share
    return 1 / jnp.clip(curvature, 1 / _LONGEST, _LONGEST)


def _damped(matrix: Bordered, damping: Array) -> Bordered:
    """Return the matrix with its diagonal increased by a share of itself (Marquardt 1963)."""

    def scale(size: int) -> Array:
        return 1 + damping * jnp.eye(size, dtype=matrix.corner.dtype)

    chain = BlockTridiagonal(matrix.chain.diagonal * scale(DOF), matrix.chain.coupling)
    return Bordered(chain, matrix.border, matrix.corner * scale(len(matrix.corner)))


def _no_probe(error: Array, found: _Found, inputs: Any) -> None:
    return None


def _gradient(error: Array, probed: None, found: _Found, inputs: Any) -> Array:
    """Return the gradient of the cost at the solution perturbed by ``error``; it vanishes at zero error."""
    normal = _report(error, probed, found, inputs)[2]
    return jnp.concatenate([normal.gradient.ravel(), normal.by_tilt])


def _report(
    error: Array, probed: None, found: _Found, inputs: Any
) -> tuple[MotionState, Float[Array, " q"], Normal]:
    chain = inputs[0]
    of_states, of_tilt = _apart(error, found)
    states, tilt = found.states.retract(of_states), found.tilt + of_tilt
    return states, tilt, linearise(chain, information_of(chain), states, tilt)


def _inverse_hessian(error: Array, found: _Found, inputs: Any, right: Array) -> Array:
    chain = inputs[0]
    exact = linearise(chain, information_of(chain), found.states, found.tilt, exact=True)
    solved = solve_bordered(factorise_bordered(exact.matrix), *_apart(right, found))
    return jnp.concatenate([part.ravel() for part in solved])


def _apart(unknowns: Array, found: _Found) -> tuple[Float[Array, "n 15"], Float[Array, " q"]]:
    """Return the entries of the states and those of the tilt."""
    end = len(unknowns) - len(found.tilt)
    return unknowns[:end].reshape(-1, DOF), unknowns[end:]
