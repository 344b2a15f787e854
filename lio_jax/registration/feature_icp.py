"""Match corners and surface points with lines and planes in rounds: search, then a few steps (A-LOAM).

Zhang & Singh, "LOAM: Lidar odometry and mapping in real-time", RSS 2014, sections V.C and VI.
"""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.implicit import Problem, Solution, implicit
from lio_jax.registration.association import Association, associated, no_association
from lio_jax.registration.gauss_newton import (
    Directions,
    NormalEquations,
    Registration,
    is_small,
    moved,
    observable_step,
    registration_at,
    unmet,
)
from lio_jax.registration.lines_and_planes import (
    FeaturePoints,
    Frames,
    LinesAndPlanes,
    Weights,
    huber,
    linearise,
    no_lines_and_planes,
)
from lio_jax.registration.params import Params


class ScanRegistration(eqx.Module):
    """What there is to match. What it holds may be differentiated."""

    T_predicted: eqx.AbstractVar[jaxlie.SE3]
    params: eqx.AbstractVar[Params]

    @abc.abstractmethod
    def points_at(self, T_target_lidar: jaxlie.SE3) -> FeaturePoints:
        """Return the motion-compensated points, given the pose under trial."""

    @abc.abstractmethod
    def frames(self) -> Frames:
        """Return the frames of the matches."""

    @abc.abstractmethod
    def associate(self, points: FeaturePoints, T_target_lidar: jaxlie.SE3) -> LinesAndPlanes:
        """Return the line or plane of each point at a pose."""

    def weights(self) -> Weights:
        """Return the robust weights of distances: Huber's."""
        return huber(self.params.registration.kernel)

    def linearised(self, T_target_lidar: jaxlie.SE3, matches: LinesAndPlanes) -> NormalEquations:
        """Return the normal equations at a pose."""
        points, range_sigma = self.points_at(T_target_lidar), self.params.lidar.range_sigma
        return linearise(matches, points, T_target_lidar, self.frames(), self.weights(), range_sigma)


def register_features(
    task: ScanRegistration, rounds: int | Int32[Array, ""], max_iterations: int
) -> Registration:
    """Find the pose at which the points fit their lines and planes best, by the task's robust measure.

    Directions the matches do not constrain keep the prediction (Zhang, Kaess & Singh, "On degeneracy of
    optimization-based state estimation problems", ICRA 2016). Matches are kept in a later round if the
    points have moved less than ``params.registration.reassociation_distance`` since; a round whose first step
    ends the iteration is the last.

    Derivatives are those of the converged pose with the last matches and the held directions fixed
    (:mod:`lio_jax.core.implicit`); where the status is ITERATION_LIMIT they are not to be trusted.

    Args:
        task: points, targets, prediction.
        rounds: how often matches are searched.
        max_iterations: Gauss-Newton steps at most after each search.
    """
    problem = Problem(
        lambda inputs: _solve(max_iterations, *inputs),
        lambda step, end, inputs: _again(step, end, inputs[1]),
        lambda step, equations, end, inputs: _missed(step, equations, end, inputs[1]),
        lambda step, equations, end, inputs: equations,
    )
    step, end, equations = implicit(problem, (jnp.asarray(rounds, jnp.int32), task))
    return registration_at(
        moved(end.T_target_lidar, step),
        task.T_predicted,
        equations,
        end.directions,
        end.iterations,
        end.done,
        task.params.registration,
    )


class _End(eqx.Module):
    """Where the iteration ended, and by what choices."""

    T_target_lidar: jaxlie.SE3
    iterations: Int32[Array, ""]
    done: Bool[Array, ""]
    association: Association[LinesAndPlanes]
    directions: Directions
    """Principal directions of the last step."""


def _solve(max_iterations: int, rounds: Int32[Array, ""], task: ScanRegistration) -> Solution:
    settings = task.params.registration

    def one_round(carry: tuple) -> tuple:
        count, _, end, equations = carry
        T = end.T_target_lidar
        points = task.points_at(T)
        association = associated(
            end.association,
            lambda: task.associate(points, T),
            jnp.concatenate([points.corner, points.surface]),
            jnp.concatenate([points.corner_mask, points.surface_mask]),
            T,
            settings.reassociation_distance,
        )

        def iterate(carry: tuple) -> tuple:
            number, T, *_ = carry
            equations = task.linearised(T, association.found)
            step, directions = observable_step(equations, settings.degeneracy_ratio)
            done = is_small(step, settings) | (equations.matches < settings.min_matches)
            return number + 1, moved(T, step), done, directions, equations

        def unfinished(carry: tuple) -> Array:
            return (carry[0] < max_iterations) & ~carry[2]

        start = (jnp.int32(0), T, jnp.array(False), end.directions, equations)
        number, T, done, directions, equations = jax.lax.while_loop(unfinished, iterate, start)
        end = _End(T, end.iterations + number, done, association, directions)
        return count + 1, done & (number == 1), end, equations

    prediction = task.T_predicted
    dtype = prediction.wxyz_xyz.dtype
    nothing = no_association(no_lines_and_planes(task.points_at(prediction)), prediction)
    start = _End(prediction, jnp.int32(0), jnp.array(False), nothing, Directions.none(dtype))
    _, _, end, equations = jax.lax.while_loop(
        lambda carry: (carry[0] < rounds) & ~carry[1],
        one_round,
        (jnp.int32(0), jnp.array(False), start, NormalEquations.nothing(dtype)),
    )
    return Solution(jnp.zeros(6, dtype), end, equations)


def _again(step: Float[Array, "6"], end: _End, task: ScanRegistration) -> NormalEquations:
    """Linearise once more at a pose near the solution, with its matches."""
    return task.linearised(moved(end.T_target_lidar, step), end.association.found)


def _missed(
    step: Float[Array, "6"], equations: NormalEquations, end: _End, task: ScanRegistration
) -> Float[Array, "6"]:
    """Return what vanishes at the solution."""
    T = moved(end.T_target_lidar, step)
    return unmet(T, task.T_predicted, end.directions, equations.gradient)
