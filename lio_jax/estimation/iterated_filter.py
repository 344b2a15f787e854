"""The iterated error-state update, over any state that has a retraction."""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.implicit import ImplicitSolution, Problem, implicit
from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, LOST, NOT_FINITE
from lio_jax.estimation.innovation import Innovation, innovation_of, square_root_information

State = TypeVar("State")
"""Any pytree."""


class Measurement(eqx.Module):
    """What one linearisation tells about a k-dimensional quantity, such as a pose.

    Its cost is quadratic in the quantity's perturbation d: ``d' information d / 2 + gradient' d``.
    """

    information: Float[Array, "k k"]
    """Sum of H' R^-1 H over the residuals; directions without information are allowed."""
    gradient: Float[Array, " k"]
    """Sum of H' R^-1 r: it lies in the range of ``information``."""
    lost: Bool[Array, ""]
    """The measurement is of no use: keep the prior."""
    aux: Any = None
    """Anything to hand to the next linearisation and back to the caller, as a pytree of arrays."""
    settled: Bool[Array, ""] = eqx.field(default_factory=lambda: jnp.array(True))
    """False keeps the iteration going: the measurement will still change, as with a kernel that narrows."""


class Update(NamedTuple):
    """Result of an update."""

    state: Any
    covariance: Float[Array, "d d"]
    """Covariance of the error at ``state``."""
    innovation: Innovation
    measurement: Measurement
    """The last linearisation, at the iterate before ``state``."""
    iterations: Int32[Array, ""]
    status: Int32[Array, ""]
    """See :mod:`lio_jax.core.types`; after LOST and NOT_FINITE state and covariance are the prior's."""
    considered: Float[Array, "d c"] | None = None
    """Covariance of the error at ``state`` with the considered errors; None where there are none."""


def iterated_update(
    state: State,
    covariance: Float[Array, "d d"],
    measure: Callable[..., Measurement],
    jacobian: Callable[[State], Float[Array, "k d"]],
    retract: Callable[[State, Float[Array, " d"]], State],
    local: Callable[[State, State], Float[Array, " d"]],
    *,
    max_iterations: int,
    tolerance: Float[Array, " d"],
    first_aux: Any = None,
    again: Callable[..., Measurement] | None = None,
    reset: Callable[[State, Float[Array, " d"]], Float[Array, "d d"]] | None = None,
    considered: Float[Array, "d c"] | None = None,
) -> Update:
    """Return the state that best agrees with the prior and the measurement together, and its covariance.

    Gauss-Newton on ``e' P^-1 e / 2`` plus the measurement's cost, where e is the error from the prior mean
    and P its covariance (Bell & Cathey, "The iterated Kalman filter update as a Gauss-Newton method", 1993).
    All iterates are errors from the prior mean, so that the prior's Jacobian is the identity and the manifold
    enters only through the reset G(e) (Sola, "Quaternion kinematics for the error-state Kalman filter", 2017,
    section 6.3). With the measurement's information A = C C', gradient C u and Jacobian J at the iterate e_j,
    and H = C' J G(e_j), the next one is

        e = P H' (I + H P H')^-1 (H e_j - u),

    whose only inverse is k by k: neither P nor A needs one, what P holds as certain stays put to the last
    bit, and directions without information are left alone. The posterior is in Joseph's form.

    Derivatives are those of the converged solution, choices held (:mod:`lio_jax.core.implicit`); where the
    status is ITERATION_LIMIT they are not to be trusted. ``measure`` and ``again`` must be pytrees, such as
    methods of an :class:`equinox.Module`, if what they hold is to be differentiated.

    Args:
        state: prior mean.
        covariance: of the prior's error, positive semidefinite.
        measure: ``state -> Measurement`` linearised there; called at each iterate, so it may re-associate.
            With ``first_aux`` it is ``(state, aux) -> Measurement`` and also gets what the last linearisation
            left in ``aux``, for instance associations to use once more.
        jacobian: ``state ->`` derivative of the measured quantity with respect to the error at the state. The
            measurement depends on the state through that quantity alone.
        retract: ``(state, error) -> state``.
        local: its inverse, ``(state, other) -> error``.
        max_iterations: bound of the loop, at least 1.
        tolerance: converged when each component's step is at most this; infinite for those not to look at.
        first_aux: the first linearisation's ``aux``, of the structure that every one returns.
        again: ``(state, aux) ->`` the linearisation that left ``aux``, at another state but with the same
            choices: its derivative stands for the converged iteration's. ``measure`` where not given.
        reset: ``(state, e) ->`` derivative of ``local(retract(state, e), retract(state, e + w))`` with
            respect to w at zero; by automatic differentiation where not given.
        considered: covariance of the prior's error with c errors that the measurement does not depend on and
            that the update does not correct (Schmidt, "Application of state-space methods to navigation
            problems", 1966).
    """
    reset_at = reset or _reset_by_differentiation(retract, local)
    if first_aux is None:
        measure, again = _WithoutAux(measure), again and _WithoutAux(again)
    again = again or measure

    def jacobian_at(origin: State, error: Array) -> Array:
        return jacobian(retract(origin, error)) @ reset_at(origin, error)

    def blend(measured: Measurement, prior: _Prior, error: Array) -> _Blend:
        root, residual, values = square_root_information(measured.information, measured.gradient)
        H = root.T @ jacobian_at(prior.state, error)
        PH = prior.covariance @ H.T
        return _Blend(measured, H, PH, innovation_of(H @ PH, residual - H @ error, values))

    def solve(inputs: tuple) -> ImplicitSolution:
        prior, measure, _, first_aux, tolerance = inputs

        # jitted so that it is traced once for the shapes and the loop together
        @jax.jit
        def blended_at(error: Array, aux: Any) -> _Blend:
            return blend(measure(retract(prior.state, error), aux), prior, error)

        def iterate(carry: tuple) -> tuple:
            error, iteration, _, _, last = carry
            blended = blended_at(error, last.measured.aux)
            measured, innovation = blended.measured, blended.innovation
            following = -blended.PH @ innovation.solve(innovation.whitened[:, None])[:, 0]
            lost = measured.lost | ~jnp.all(jnp.isfinite(following))
            done = lost | (measured.settled & jnp.all(jnp.abs(following - error) <= tolerance))
            return following, iteration + 1, done, lost, blended

        def unfinished(carry: tuple) -> Array:
            return (carry[1] < max_iterations) & ~carry[2]

        error = jnp.zeros(covariance.shape[0], covariance.dtype)
        blank = _blank(jax.eval_shape(blended_at, error, first_aux))
        if first_aux is not None:
            blank = eqx.tree_at(lambda blank: blank.measured.aux, blank, first_aux)
        start = (error, jnp.int32(0), jnp.array(False), jnp.array(False), blank)
        error, iterations, done, lost, last = jax.lax.while_loop(unfinished, iterate, start)
        return ImplicitSolution(error, _Loop(last.measured.aux, iterations, done, lost), last)

    def probe(error: Array, loop: _Loop, inputs: tuple) -> Measurement:
        prior, _, again, *_ = inputs
        return again(retract(prior.state, error), loop.aux)

    def residual(error: Array, measured: Measurement, loop: _Loop, inputs: tuple) -> Array:
        prior = inputs[0]
        return error + prior.covariance @ (jacobian_at(prior.state, error).T @ measured.gradient)

    def report(error: Array, measured: Measurement, loop: _Loop, inputs: tuple) -> _Blend:
        return blend(measured, inputs[0], error)

    def directions(error: Array, inputs: tuple) -> tuple[Array, Array]:
        forth = jacobian_at(inputs[0].state, error)
        return jnp.linalg.pinv(forth), forth

    inputs = (_Prior(state, covariance), measure, again, first_aux, tolerance)
    error, loop, last = implicit(Problem(solve, probe, residual, report, directions), inputs)
    innovation = last.innovation
    G = reset_at(state, error)
    gain = innovation.solve(last.PH.T).T
    kept = G - (G @ gain) @ last.H
    posterior = kept @ covariance @ kept.T + (G @ gain) @ (G @ gain).T
    finite = jnp.all(jnp.isfinite(error)) & jnp.all(jnp.isfinite(posterior))
    lost = loop.lost | ~finite
    idle = lost | (innovation.dof == 0)
    innovation = jax.tree.map(lambda leaf: jnp.where(idle, jnp.zeros_like(leaf), leaf), innovation)

    def unless_idle(new: Array, old: Array) -> Array:
        return jnp.where(idle, old, new)

    status = jnp.where(loop.done, CONVERGED, ITERATION_LIMIT)
    status = jnp.where(lost, NOT_FINITE, status)
    return Update(
        state=jax.tree.map(unless_idle, retract(state, error), state),
        covariance=unless_idle((posterior + posterior.T) / 2, covariance),
        innovation=innovation,
        measurement=last.measured,
        iterations=loop.iterations,
        status=jnp.where(last.measured.lost, LOST, status).astype(jnp.int32),
        considered=None if considered is None else unless_idle(kept @ considered, considered),
    )


class _Prior(eqx.Module):
    state: Any
    covariance: Float[Array, "d d"]


class _Blend(eqx.Module):
    """A measurement set against the prior."""

    measured: Measurement
    H: Float[Array, "k d"]
    """Derivative of the whitened measurement by the error from the prior mean."""
    PH: Float[Array, "d k"]
    innovation: Innovation


class _Loop(eqx.Module):
    """How the iteration ended."""

    aux: Any
    iterations: Int32[Array, ""]
    done: Bool[Array, ""]
    lost: Bool[Array, ""]


class _WithoutAux(eqx.Module):
    """A measurement that does without what the last one left."""

    measure: Callable[[Any], Measurement]

    def __call__(self, state: Any, aux: Any) -> Measurement:
        return self.measure(state)


def _reset_by_differentiation(
    retract: Callable[[State, Float[Array, " d"]], State],
    local: Callable[[State, State], Float[Array, " d"]],
) -> Callable[[State, Float[Array, " d"]], Float[Array, "d d"]]:
    """Return ``reset`` of :func:`iterated_update` for any retraction and its inverse."""

    def reset(state: State, error: Float[Array, " d"]) -> Float[Array, "d d"]:
        moved = retract(state, error)
        return jax.jacfwd(lambda small: local(moved, retract(state, error + small)))(jnp.zeros_like(error))

    return reset


def _blank(shapes: Any) -> Any:
    return jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
