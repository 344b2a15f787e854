"""Solve a scan match by Gauss-Newton: robust, aware of degenerate directions, with the implicit derivative.

A step turns a pose about its own position and moves it, in the axes of the frame it is given in.
"""

from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.implicit import ImplicitSolution, Problem, implicit
from lio_jax.core.types import CONVERGED, ITERATION_LIMIT, LOST
from lio_jax.registration.params import GaussNewtonMatch, RegistrationParams
from lio_jax.registration.scan_match import Association, NormalEquations, ScanMatch

F = TypeVar("F")
"""What each point was matched with."""


class Registration(eqx.Module):
    """Result of a scan-to-map solve."""

    T_world_lidar: jaxlie.SE3
    """Estimated pose of the lidar, m."""
    information: Float[Array, "6 6"]
    """Inverse covariance of the right perturbation, rotation (rad) before translation (m)."""
    degenerate: Bool[Array, " 6"]
    """Which eigenvectors of the scaled information were held at the prediction, weakest first."""
    matches: Int32[Array, ""]
    """Points that found a distribution in the map."""
    rmse: Float[Array, ""]
    """Robustly weighted root mean square distance to the map, m."""
    blur: Float[Array, ""]
    """Mean squared distance of the points from the map, robust, as a share of their squared ranges."""
    iterations: Int32[Array, ""]
    """Number of Gauss-Newton steps."""
    status: Int32[Array, ""]
    """CONVERGED, ITERATION_LIMIT or LOST; in the last case the pose is the prediction."""


class Directions(eqx.Module):
    """The principal directions of a step."""

    vectors: Float[Array, "6 6"]
    """Principal directions in columns, scaled to metres."""
    degenerate: Bool[Array, " 6"]
    """True for directions that the scan does not constrain; the pose keeps the prediction along them."""

    @staticmethod
    def none(dtype: jnp.dtype) -> "Directions":
        """Return what stands there before the first step."""
        return Directions(jnp.zeros((6, 6), dtype), jnp.zeros(6, bool))


def moved(T_world_lidar: jaxlie.SE3, step: Float[Array, "6"]) -> jaxlie.SE3:
    """Return a pose turned and moved in world axes at its own position."""
    rotation = (jaxlie.SO3.exp(step[:3]) @ T_world_lidar.rotation()).normalize()
    return jaxlie.SE3.from_rotation_and_translation(rotation, T_world_lidar.translation() + step[3:])


def is_small(step: Float[Array, "6"], settings: RegistrationParams) -> Bool[Array, ""]:
    """Return whether a step ends the iteration."""
    turn, move = jnp.linalg.norm(step[:3]), jnp.linalg.norm(step[3:])
    return (turn < settings.rotation_tolerance) & (move < settings.translation_tolerance)


def observable_step(
    equations: NormalEquations, degeneracy_ratio: Float[Array, ""]
) -> tuple[Float[Array, "6"], Directions]:
    """Return the Gauss-Newton step in the directions that are observed, and the directions.

    Rotations are scaled by the scan's rms lever arm so that all six directions are in metres.
    """
    dtype = equations.hessian.dtype
    scale = jnp.concatenate([jnp.full(3, 1.0) / jnp.sqrt(equations.arm_squared + 1e-6), jnp.ones(3)]).astype(
        dtype
    )
    values, vectors = jnp.linalg.eigh(scale[:, None] * equations.hessian * scale)
    degenerate = values <= jnp.maximum(degeneracy_ratio * values[-1], jnp.finfo(dtype).tiny)
    along = -(vectors.T @ (scale * equations.gradient))
    along = jnp.where(degenerate, 0.0, along / jnp.where(degenerate, 1.0, values))
    return scale * (vectors @ along), Directions(scale[:, None] * vectors, degenerate)


def gauss_newton(match: ScanMatch[Any, Any], max_searches: int, max_steps: int = 1) -> Registration:
    """Find the pose at which a scan fits its map best, by the match's robust measure.

    The loop searches what each point lies on, then takes a few steps. A search whose first step ends the
    iteration is the last. Directions that the matches do not constrain keep the prediction (Zhang, Kaess &
    Singh, "On degeneracy of optimization-based state estimation problems", ICRA 2016).

    Derivatives are those of the converged pose with the last associations, the kernel and the held directions
    fixed (:mod:`lio_jax.core.implicit`); where the status is ITERATION_LIMIT they are not to be trusted.

    Args:
        match: scan, map and prediction.
        max_searches: bound of the outer loop.
        max_steps: Gauss-Newton steps at most after each search.
    """
    return gauss_newton_with_matches(match, max_searches, max_steps)[0]


def gauss_newton_with_matches(
    match: ScanMatch[Any, F], max_searches: int, max_steps: int = 1
) -> tuple[Registration, F]:
    """Return the result of :func:`gauss_newton` and the last matches, which have no derivative."""
    problem = Problem(
        lambda inputs: _solve(max_steps, *inputs),
        lambda step, end, inputs: _linearised_again(step, end, inputs[1]),
        lambda step, equations, end, inputs: _residual(step, equations, end, inputs[1]),
        lambda step, equations, end, inputs: equations,
    )
    step, end, equations = implicit(problem, (jnp.asarray(max_searches, jnp.int32), match))
    found = jax.lax.stop_gradient(end.association.found)
    return _registration_at(moved(end.T_world_lidar, step), equations, end, match), found


class _End(eqx.Module):
    """Where the iteration ended, and by what choices."""

    T_world_lidar: jaxlie.SE3
    iterations: Int32[Array, ""]
    done: Bool[Array, ""]
    association: Association[Any]
    directions: Directions
    """The directions of the last step."""


def _solve(max_steps: int, max_searches: Int32[Array, ""], match: ScanMatch[Any, Any]) -> ImplicitSolution:
    settings = match.registration
    assert isinstance(settings, GaussNewtonMatch)

    def search(carry: tuple) -> tuple:
        count, _, end, equations = carry
        association = match.associated(end.association, end.T_world_lidar, count)

        def iterate(carry: tuple) -> tuple:
            number, T, *_ = carry
            iteration = end.iterations + number
            equations = match.linearise(T, association.found, iteration)
            step, directions = observable_step(equations, settings.degeneracy_ratio)
            done = is_small(step, settings) & match.settled(iteration)
            done = done | (equations.matches < settings.min_matches)
            return number + 1, moved(T, step), done, directions, equations

        def unfinished(carry: tuple) -> Array:
            return (carry[0] < max_steps) & ~carry[2]

        first = (jnp.int32(0), end.T_world_lidar, jnp.array(False), end.directions, equations)
        number, T, done, directions, equations = jax.lax.while_loop(unfinished, iterate, first)
        end = _End(T, end.iterations + number, done, association, directions)
        return count + 1, done & (number == 1), end, equations

    dtype = match.T_predicted.wxyz_xyz.dtype
    start = _End(match.T_predicted, jnp.int32(0), jnp.array(False), match.start(), Directions.none(dtype))
    _, _, end, equations = jax.lax.while_loop(
        lambda carry: (carry[0] < max_searches) & ~carry[1],
        search,
        (jnp.int32(0), jnp.array(False), start, NormalEquations.nothing(dtype)),
    )
    return ImplicitSolution(jnp.zeros(6, dtype), end, equations)


def _linearised_again(step: Float[Array, "6"], end: _End, match: ScanMatch[Any, Any]) -> NormalEquations:
    """Linearise once more at a pose near the solution, with the associations found."""
    return match.linearise(moved(end.T_world_lidar, step), end.association.found, end.iterations - 1)


def _residual(
    step: Float[Array, "6"], equations: NormalEquations, end: _End, match: ScanMatch[Any, Any]
) -> Float[Array, "6"]:
    """Return what vanishes at the solution: the gradient where observed, else the way from the prediction."""
    T, directions = moved(end.T_world_lidar, step), end.directions
    turn = (T.rotation() @ match.T_predicted.rotation().inverse()).log()
    way = jnp.concatenate([turn, T.translation() - match.T_predicted.translation()])
    along = jnp.linalg.solve(directions.vectors, way)
    held = along - jax.lax.stop_gradient(along)
    return jnp.where(directions.degenerate, held, directions.vectors.T @ equations.gradient)


def _registration_at(
    T_world_lidar: jaxlie.SE3, equations: NormalEquations, end: _End, match: ScanMatch[Any, Any]
) -> Registration:
    """Return the result of a solve that ended at a pose, or at the prediction if it found too few matches."""
    T, settings = T_world_lidar, match.registration
    lost = (equations.matches < settings.min_matches) | ~jnp.all(jnp.isfinite(T.wxyz_xyz))
    T = jaxlie.SE3(jnp.where(lost, match.T_predicted.wxyz_xyz, T.wxyz_xyz))
    to_body = jax.scipy.linalg.block_diag(*[rotation_matrix(T.rotation())] * 2)
    status = jnp.where(lost, LOST, jnp.where(end.done, CONVERGED, ITERATION_LIMIT))
    return Registration(
        T_world_lidar=T,
        information=jnp.where(lost, 0.0, to_body.T @ equations.hessian @ to_body),
        degenerate=end.directions.degenerate,
        matches=equations.matches,
        rmse=equations.rmse(),
        blur=equations.blur,
        iterations=end.iterations,
        status=status.astype(jnp.int32),
    )
