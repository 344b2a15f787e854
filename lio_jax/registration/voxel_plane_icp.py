"""Register a scan against the voxel map: point-to-plane, robust Gauss-Newton, degeneracy aware."""

from collections.abc import Callable
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.implicit import Problem, Solution, implicit
from lio_jax.core.xla import computed_once
from lio_jax.mapping.voxel_map import VoxelMap, anchor_of, query_nearest
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
from lio_jax.registration.params import Params
from lio_jax.registration.point_sums import point_sums


class Frame(eqx.Module):
    """World axes from a corner of the map's grid near the sensor: where float32 is precise."""

    anchor: Int32[Array, "3"]
    """The voxel whose lower corner is the origin."""
    origin: Float[Array, "3"]
    """Position of that corner, m, in world."""

    def place(
        self, points: Float[Array, "k 3"], T_world_lidar: jaxlie.SE3
    ) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"]]:
        """Return points of the lidar frame in world axes, from the sensor and from the origin, m."""
        R, shift = self.placing(T_world_lidar, points.dtype)
        arm = points @ R.T
        return arm, arm + shift

    def placing(
        self, T_world_lidar: jaxlie.SE3, dtype: jnp.dtype
    ) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
        """Return the turn into world axes, and the way from the sensor to the origin, m."""
        R = rotation_matrix(T_world_lidar.rotation())
        return R.astype(dtype), (T_world_lidar.translation() - self.origin).astype(dtype)


class Matches(eqx.Module):
    """What each point was associated with, in world axes from ``origin``."""

    mean: Float32[Array, "k 3"]
    """m."""
    normal: Float32[Array, "k 3"]
    """Unit normal of each voxel's plane."""
    variances: Float32[Array, "k 2"]
    """The voxel's two smaller variances, ascending, m^2."""
    count: Float32[Array, " k"]
    """Number of points of the voxel."""
    used: Bool[Array, " k"]
    """True where a point has a match."""


def associate(
    vmap: VoxelMap,
    points: Float[Array, "k 3"],
    mask: Bool[Array, " k"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    params: Params,
) -> Matches:
    """Return the distribution of the map that each point lies on at a pose."""
    _, placed = frame.place(jnp.where(mask[:, None], points, 0.0), T_world_lidar)
    near = query_nearest(
        vmap,
        placed,
        frame.anchor,
        params.map.voxel_size.astype(jnp.float32),
        params.map.min_points.astype(jnp.float32),
    )
    return Matches(near.mean, near.normal, near.variances, near.count, mask & near.valid)


def no_matches(mask: Bool[Array, " k"]) -> Matches:
    """Return matches of none of the points."""
    zeros = jnp.zeros((*mask.shape, 3), jnp.float32)
    return Matches(zeros, zeros, zeros[:, :2], zeros[:, 0], jnp.zeros_like(mask))


class PointNoise(eqx.Module):
    """Each matched point's distance from its plane and the noise of that distance."""

    arm: Float[Array, "k 3"]
    """Vector from the sensor to each point, in world axes, m."""
    distance: Float[Array, " k"]
    """Distance from the plane along its normal, m; zero where there is no match."""
    variance: Float[Array, " k"]
    """Variance of the distance, m^2; one where there is no match."""
    precision: Float[Array, " k"]
    """Precision with which the distance is weighted, 1/m^2; zero where there is no match."""
    scaled_squared: Float[Array, " k"]
    """Squared distance, scaled by its noise, m^2; in a flat voxel it is the squared distance itself."""

    def weight(self, kernel: Float[Array, ""]) -> Float[Array, " k"]:
        """Return the Geman-McClure weights of the noise-scaled distances, zero where there is no match."""
        return jnp.where(self.precision > 0, (kernel**2 / (kernel**2 + self.scaled_squared)) ** 2, 0.0)


def point_noise(
    matches: Matches,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    params: Params,
) -> PointNoise:
    """Return the distances of associated points from their planes at a pose, and their noise.

    A point is measured along the normal of its voxel, with the precision
    k = 1 / (s^2 + l0) - 1 / (s^2 + l1), where l0 <= l1 are the two smaller variances of the voxel: what is
    known about the normal in excess of the next direction. A flat voxel acts as a plane; a shapeless one does
    not act at all, and neither does a single scan line, whose normal is undefined, with no class boundaries
    between. The point's own variance s^2 is that of the range and of the surface, plus that of the beam's
    direction times the squared offset along the surface, which grows with range and grazing incidence.
    """
    R, shift = frame.placing(T_world_lidar, points.dtype)
    arm = jnp.where(matches.used[:, None], points, 0.0) @ R.T
    return plane_noise(matches, arm, shift, *point_variances(params, points.dtype))


def point_variances(params: Params, dtype: jnp.dtype) -> tuple[Array, Array]:
    """Return the variances of a point along its plane's normal (m^2) and of a beam's direction (rad^2)."""
    lidar = params.lidar
    facing = lidar.range_sigma**2 + lidar.surface_sigma**2
    return facing.astype(dtype), (lidar.angle_sigma**2).astype(dtype)


def plane_noise(matches: Matches, arm: Array, shift: Array, facing: Array, turning: Array) -> PointNoise:
    along = jnp.sum(arm * matches.normal, -1)
    range_squared = jnp.sum(arm**2, -1)
    across = jnp.maximum(range_squared - along**2, 0.0)
    variances = (facing + turning * across)[:, None] + matches.variances
    known = 1 / variances
    distance = jnp.sum(matches.normal * (arm + shift - matches.mean), -1)
    distance = jnp.where(matches.used, distance, 0.0)
    precision = jnp.where(matches.used, known[:, 0] - known[:, 1], 0.0)
    return PointNoise(
        arm=arm,
        distance=distance,
        variance=jnp.where(matches.used, variances[:, 0], 1.0),
        precision=precision,
        scaled_squared=facing * precision * distance**2,
    )


def linearise(
    matches: Matches,
    points: Float[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    kernel: Float[Array, ""],
    params: Params,
) -> NormalEquations:
    """Return the robustly weighted normal equations of associated points at a pose.

    Robust weight: Geman-McClure on s sqrt(k) n'e, the noise-scaled distance in m of a point at offset e from
    its plane's mean, with precision k and s^2 of range and surface.
    """
    dtype, kind = T_world_lidar.wxyz_xyz.dtype, points.dtype
    noise = point_noise(matches, points, T_world_lidar, frame, params)
    weight = noise.weight(kernel.astype(kind))
    arm, distance = noise.arm, noise.distance

    # one matrix product gives every sum over the points: the normal equations from the rows, the rest from
    # the column of ones
    row = jnp.concatenate(
        [
            jnp.cross(arm, matches.normal),
            matches.normal,
            distance[:, None],
            jnp.ones_like(distance)[:, None],
        ],
        -1,
    )
    matched = matches.used.astype(kind)
    scalars = [matched, weight, weight * noise.scaled_squared, matched * jnp.sum(arm**2, -1)]
    weighted = jnp.concatenate([(weight * noise.precision)[:, None] * row, jnp.stack(scalars, -1)], -1)
    sums = jax.lax.stop_gradient(row.T @ weighted)
    total = point_sums(
        jnp.concatenate([sums[:6, :6].ravel(), sums[:6, 6], sums[7, 9:]]),
        _rows,
        points,
        *frame.placing(T_world_lidar, kind),
        jnp.stack([*point_variances(params, kind), kernel.astype(kind)]),
        matches,
    ).astype(dtype)
    hessian, count = total[:36].reshape(6, 6), sums[7, 8]
    weight_sum, squared_error, arm_squared = total[42:]
    return NormalEquations(
        hessian=(hessian + hessian.T) / 2,
        gradient=total[36:42],
        matches=count.astype(jnp.int32),
        weight=weight_sum,
        squared_error=squared_error,
        arm_squared=arm_squared / jnp.maximum(count, 1.0).astype(dtype),
    )


def _rows(arm: Array, shift: Array, scales: Array, matches: Matches) -> Array:
    """Return what each point adds to the sums of :func:`linearise`."""
    facing, turning, kernel = scales
    noise = plane_noise(matches, arm.T, shift, facing, turning)
    weight = noise.weight(kernel)
    believed = weight * noise.precision
    jacobian = jnp.concatenate([jnp.cross(noise.arm, matches.normal), matches.normal], -1).T
    jacobian, scaled = computed_once((jacobian, believed * jacobian))
    arm_squared = jnp.where(matches.used, jnp.sum(noise.arm**2, -1), 0.0)
    return jnp.concatenate(
        [
            (scaled[:, None] * jacobian).reshape(36, -1),
            noise.distance * scaled,
            jnp.stack([weight, weight * noise.scaled_squared, arm_squared]),
        ]
    )


def register(
    vmap: VoxelMap,
    points_at: Callable[[jaxlie.SE3], Float[Array, "k 3"]],
    mask: Bool[Array, " k"],
    T_world_lidar: jaxlie.SE3,
    prediction_error: Float[Array, ""],
    params: Params,
    max_iterations: int,
) -> Registration:
    """Find the pose at which the scan fits the map best.

    The kernel starts as wide as the prediction may be wrong and halves with each iteration down to its own
    scale, so that a scan without a velocity prior still finds the map (graduated non-convexity, Blake &
    Zisserman 1987). Directions the scan does not constrain keep the prediction (Zhang & Singh, "On
    degeneracy of optimization-based state estimation problems", ICRA 2016).

    Derivatives are those of the converged pose with map, associations, kernel and held directions fixed
    (:mod:`lio_jax.core.implicit`); where the status is ITERATION_LIMIT they are not to be trusted.

    Args:
        vmap: the map.
        points_at: the motion-compensated points in the lidar frame, m, given the pose under trial: the
            compensation may depend on it. A pytree, if what it holds is to be differentiated.
        mask: which points are real.
        T_world_lidar: predicted pose.
        prediction_error: expected error of the prediction, m.
        params: traced parameters.
        max_iterations: bound of the loop.
    """
    task = _Task(vmap, points_at, mask, T_world_lidar, prediction_error, params)
    problem = Problem(
        partial(_solve, max_iterations), _again, _missed, lambda step, equations, end, task: equations
    )
    step, end, equations = implicit(problem, task)
    T = moved(end.T_world_lidar, step)
    return registration_at(
        T, T_world_lidar, equations, end.directions, end.iterations, end.done, params.registration
    )


class _Task(eqx.Module):
    """What there is to register."""

    map: VoxelMap
    points_at: Callable[[jaxlie.SE3], Float[Array, "k 3"]]
    mask: Bool[Array, " k"]
    T_predicted: jaxlie.SE3
    prediction_error: Float[Array, ""]
    params: Params

    def opening(self, iteration: Int32[Array, ""]) -> Float[Array, ""]:
        """Return by how much the kernel is still open."""
        return self.prediction_error * 0.5 ** iteration.astype(self.prediction_error.dtype)

    def linearised(
        self, T_world_lidar: jaxlie.SE3, points: Array, matches: Matches, iteration: Int32[Array, ""]
    ) -> NormalEquations:
        """Return the normal equations at a pose with the kernel of an iteration."""
        kernel = self.params.registration.kernel + self.opening(iteration)
        return linearise(matches, points, T_world_lidar, self.frame(), kernel, self.params)

    def frame(self) -> Frame:
        """Return axes near the sensor."""
        return Frame(*anchor_of(self.T_predicted.translation(), self.params.map.voxel_size))


class _End(eqx.Module):
    """Where the iteration ended, and by what choices."""

    T_world_lidar: jaxlie.SE3
    iterations: Int32[Array, ""]
    done: Bool[Array, ""]
    association: Association[Matches]
    directions: Directions
    """Principal directions of the last step."""


def _solve(max_iterations: int, task: _Task) -> Solution:
    settings = task.params.registration
    mask, prediction = task.mask, task.T_predicted

    def iterate(carry: tuple) -> tuple:
        end, _ = carry
        T = end.T_world_lidar
        points = task.points_at(T)
        association = associated(
            end.association,
            lambda: associate(task.map, points, mask, T, task.frame(), task.params),
            points,
            mask,
            T,
            settings.reassociation_distance,
        )
        equations = task.linearised(T, points, association.found, end.iterations)
        step, directions = observable_step(equations, settings.degeneracy_ratio)
        done = is_small(step, settings) & (task.opening(end.iterations) < settings.kernel)
        done = done | (equations.matches < settings.min_matches)
        following = moved(T, step)
        return _End(following, end.iterations + 1, done, association, directions), equations

    def unfinished(carry: tuple) -> Array:
        return (carry[0].iterations < max_iterations) & ~carry[0].done

    dtype = prediction.wxyz_xyz.dtype
    nothing = no_association(no_matches(mask), prediction)
    start = _End(prediction, jnp.int32(0), jnp.array(False), nothing, Directions.none(dtype))
    end, equations = jax.lax.while_loop(unfinished, iterate, (start, NormalEquations.nothing(dtype)))
    return Solution(jnp.zeros(6, dtype), end, equations)


def _again(step: Float[Array, "6"], end: _End, task: _Task) -> NormalEquations:
    """Linearise once more at a pose near the solution, with its associations."""
    T = moved(end.T_world_lidar, step)
    return task.linearised(T, task.points_at(T), end.association.found, end.iterations - 1)


def _missed(step: Float[Array, "6"], equations: NormalEquations, end: _End, task: _Task) -> Float[Array, "6"]:
    """Return what vanishes at the solution: the gradient where observed, else the way from the prediction."""
    T = moved(end.T_world_lidar, step)
    return unmet(T, task.T_predicted, end.directions, equations.gradient)
