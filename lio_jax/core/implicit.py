"""Derivatives of converged solves by the implicit function theorem, and of values that are already known.

No iteration is differentiated. Both rules support forward and reverse mode. A batch of tangents shares the
work that does not depend on the tangent.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_Value = TypeVar("_Value")


class ImplicitSolution(NamedTuple):
    """The result of a solve."""

    root: Float[Array, " d"]
    """The unknowns at which the residual is zero."""
    selection: Any
    """Discrete choices of the solve, such as associations. The derivative takes them as constant."""
    reported: Any
    """Further values at the root, which have a derivative as well."""


class Problem(eqx.Module):
    """A solve and the equations that its result satisfies.

    Its functions must not close over arrays that are differentiated: such arrays belong in ``inputs``.
    """

    solve: Callable[[Any], ImplicitSolution]
    """``inputs -> solution``. It may use any iteration."""
    probe: Callable[[Array, Any, Any], Any]
    """``(root, selection, inputs) -> probed``: the costly values that residual and report share."""
    residual: Callable[[Array, Any, Any, Any], Array]
    """``(root, probed, selection, inputs) -> (d,)`` values, which are zero at the root."""
    report: Callable[[Array, Any, Any, Any], Any]
    """``(root, probed, selection, inputs) -> reported``: the values that ``solve`` reports, as a function of
    the root."""
    directions: Callable[[Array, Any], tuple[Array, Array]] | None = None
    """``(root, inputs) -> B (d, k), C (k, d)``: the derivative of the probe with respect to the root is the
    same along dx and along B C dx, so its derivatives along the k columns of B suffice. None: B and C are the
    identity."""
    inverse_slope: Callable[[Array, Any, Any, Array], Array] | None = None
    """``(root, selection, inputs, right) -> (dr/dx)^-1 right``, for a symmetric dr/dx whose structure, for
    example that of a chain, makes this cheaper than a dense factorisation. Its arguments are held constant:
    it is not differentiated itself."""


def implicit(problem: Problem, inputs: Any) -> ImplicitSolution:
    """Return the problem's solution with the derivative of the root of ``residual = 0``.

    By the implicit function theorem dx = -(dr/dx)^-1 (dr/dinputs) dinputs (Krantz & Parks, "The implicit
    function theorem", 2002). The cost is one d by d factorisation; it does not depend on the number of
    iterations of the solve, nor on the number of tangents. The result is the derivative of a *converged*
    solve: check the solve's status, and do not use the derivative where the solve did not converge.

    Args:
        problem: the solve and its equations.
        inputs: a pytree; its floating-point leaves may have tangents.
    """
    return _implicit(problem, inputs)


@eqx.filter_custom_jvp
def _implicit(problem: Problem, inputs: Any) -> ImplicitSolution:
    return problem.solve(inputs)


@_implicit.def_jvp
def _implicit_jvp(primals: tuple, tangents: tuple) -> tuple[ImplicitSolution, ImplicitSolution]:
    problem, inputs = primals
    solution = _implicit(problem, inputs)
    root = solution.root
    moving, fixed, inputs_dot = _split(inputs, tangents[1])

    def probe(root: Array, moving: Any) -> tuple[Any, Any]:
        probed = problem.probe(root, solution.selection, eqx.combine(moving, fixed))
        return eqx.partition(probed, eqx.is_inexact_array)

    smooth, probed_push, rest = jax.jvp(
        lambda moving: probe(root, moving), (moving,), (inputs_dot,), has_aux=True
    )

    def probed_along(step: Array) -> Any:
        return jax.jvp(lambda root: probe(root, moving)[0], (root,), (step,))[1]

    felt = probed_along if problem.inverse_slope else _felt(problem, root, inputs, probed_along)

    def known_of(smooth: Any) -> tuple[Any, Any]:
        return eqx.combine(smooth, rest), solution.selection

    def residual(root: Array, smooth: Any, moving: Any) -> Array:
        return problem.residual(root, *known_of(smooth), eqx.combine(moving, fixed))

    def report(root: Array, smooth: Any, moving: Any) -> Any:
        return problem.report(root, *known_of(smooth), eqx.combine(moving, fixed))

    def slope_along(step: Array) -> Array:
        by_root = lambda root, smooth: residual(root, smooth, moving)  # noqa: E731
        return jax.jvp(by_root, (root, smooth), (step, felt(step)))[1]

    _, push = jax.jvp(
        lambda smooth, moving: residual(root, smooth, moving), (smooth, moving), (probed_push, inputs_dot)
    )
    if problem.inverse_slope:
        held = jax.lax.stop_gradient((root, solution.selection, inputs))
        invert = problem.inverse_slope
        root_dot = -jax.lax.custom_linear_solve(
            slope_along, push, lambda _, right: invert(*held, right), symmetric=True
        )
    else:
        slope = jax.vmap(slope_along, out_axes=1)(jnp.eye(len(root), dtype=root.dtype))
        root_dot = -jnp.linalg.solve(slope, push)
    probed_dot = jax.tree.map(jnp.add, probed_push, felt(root_dot))
    _, reported_dot = jax.jvp(report, (root, smooth, moving), (root_dot, probed_dot, inputs_dot))
    return solution, ImplicitSolution(root_dot, _still(solution.selection), _tangent(reported_dot))


def _felt(problem: Problem, root: Array, inputs: Any, probed_along: Callable[[Array], Any]) -> Callable:
    """Return ``probed_along`` as a product with the probe's derivatives along the columns of B."""
    forth = back = jnp.eye(len(root), dtype=root.dtype)
    if problem.directions is not None:
        forth, back = problem.directions(root, inputs)
    along = jax.vmap(probed_along)(forth.T)

    def felt(step: Array) -> Any:
        return jax.tree.map(lambda slope: jnp.tensordot((back @ step).astype(slope.dtype), slope, 1), along)

    return felt


def with_derivative_of(value: _Value, function: Callable[..., _Value], *inputs: Any) -> _Value:
    """Return ``value`` with the derivative of ``function(*inputs)``, which would compute the same value.

    Use it for a result that is already known as a part of a larger computation whose other parts need no
    derivative.

    Args:
        value: what ``function(*inputs)`` evaluates to.
        function: must not close over arrays that are differentiated.
        inputs: the arguments of ``function``; their floating-point leaves may have tangents.
    """
    return _known(value, function, inputs)


@eqx.filter_custom_jvp
def _known(value: Any, function: Any, inputs: Any) -> Any:
    return value


@_known.def_jvp
def _known_jvp(primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    value, function, inputs = primals
    moving, fixed, inputs_dot = _split(inputs, tangents[2])
    _, value_dot = jax.jvp(lambda moving: function(*eqx.combine(moving, fixed)), (moving,), (inputs_dot,))
    return value, _tangent(value_dot)


def _split(inputs: Any, tangents: Any) -> tuple[Any, Any, Any]:
    """Return the leaves that have a tangent, the other leaves, and the tangents."""
    still = jax.tree.map(lambda tangent: tangent is None, tangents, is_leaf=lambda leaf: leaf is None)
    fixed, moving = eqx.partition(inputs, still)
    return moving, fixed, tangents


def _still(tree: Any) -> Any:
    return jax.tree.map(lambda leaf: None, tree)


def _tangent(tree: Any) -> Any:
    """Return the tangents, with None in place of the tangents of integers and booleans."""
    return jax.tree.map(lambda leaf: leaf if eqx.is_inexact_array(leaf) else None, tree)
