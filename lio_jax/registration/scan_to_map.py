"""Register a scan against the voxel map: point-to-plane, robust Gauss-Newton, degeneracy aware."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Float32, Int32

from lio_jax.core.params import Params
from lio_jax.core.rotation import rotation_matrix
from lio_jax.mapping.voxel_map import VoxelMap, anchor_of, query_nearest
from lio_jax.registration.association import associated, no_association

CONVERGED, ITERATION_LIMIT, TOO_FEW_MATCHES = 0, 1, 2
"""Status codes of a solve."""


class Registration(eqx.Module):
    """Result of a scan-to-map solve."""

    T_world_lidar: jaxlie.SE3
    information: Float[Array, "6 6"]
    """Inverse covariance of the right perturbation, rotation (rad) before translation (m)."""
    degenerate: Bool[Array, " 6"]
    """Which eigenvectors of the scaled information were held at the prediction, weakest first."""
    matches: Int32[Array, ""]
    """Points that found a distribution in the map."""
    rmse: Float[Array, ""]
    """Robustly weighted root mean square distance to the map, m."""
    iterations: Int32[Array, ""]
    status: Int32[Array, ""]
    """CONVERGED, ITERATION_LIMIT or TOO_FEW_MATCHES; in the last case the pose is the prediction."""


class NormalEquations(eqx.Module):
    """The solve linearised at one pose, in world axes at the sensor's position."""

    hessian: Float[Array, "6 6"]
    gradient: Float[Array, "6"]
    matches: Int32[Array, ""]
    weight: Float[Array, ""]
    """Sum of the robust weights."""
    squared_error: Float[Array, ""]
    """Robustly weighted sum of squared distances, m^2."""
    arm_squared: Float[Array, ""]
    """Mean squared distance of the points from the sensor, m^2: scales rotations to metres."""


class Frame(eqx.Module):
    """World axes from a corner of the map's grid near the sensor: where float32 is precise."""

    anchor: Int32[Array, "3"]
    """The voxel whose lower corner is the origin."""
    origin: Float[Array, "3"]
    """That corner, m in world."""

    def place(
        self, points: Float32[Array, "k 3"], T_world_lidar: jaxlie.SE3
    ) -> tuple[Float32[Array, "k 3"], Float32[Array, "k 3"]]:
        """Return points of the lidar frame in world axes, from the sensor and from the origin, m."""
        arm = points @ rotation_matrix(T_world_lidar.rotation()).astype(jnp.float32).T
        return arm, arm + (T_world_lidar.translation() - self.origin).astype(jnp.float32)


class Matches(eqx.Module):
    """What each point was associated with, in world axes from ``origin``."""

    mean: Float32[Array, "k 3"]
    """m."""
    normal: Float32[Array, "k 3"]
    precision: Float32[Array, " k"]
    """Of the distance along the normal, 1/m^2; zero where there is no match."""
    used: Bool[Array, " k"]


def associate(
    vmap: VoxelMap,
    points: Float32[Array, "k 3"],
    mask: Bool[Array, " k"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    params: Params,
) -> Matches:
    """Return the plane of the map that each point lies on at a pose.

    A point is measured along the normal of its voxel, with the precision
    k = 1 / (s^2 + l0) - 1 / (s^2 + l1), where l0 <= l1 are the two smaller variances of the voxel: what is
    known about the normal in excess of the next direction. A flat voxel acts as a plane; a shapeless one does
    not act at all, and neither does a single scan line, whose normal is undefined, with no class boundaries
    between. The point's own variance s^2 is that of the range, plus that of the beam's direction times the
    squared offset along the surface, which grows with range and grazing incidence.
    """
    arm, placed = frame.place(jnp.where(mask[:, None], points, 0.0), T_world_lidar)
    near = query_nearest(
        vmap,
        placed,
        frame.anchor,
        params.map.voxel_size.astype(jnp.float32),
        params.map.min_points.astype(jnp.float32),
    )
    along = jnp.sum(arm * near.normal, -1)
    across = jnp.sum(arm**2, -1) - along**2
    angle_sigma = params.lidar.angle_sigma.astype(jnp.float32)
    noise = params.lidar.range_sigma.astype(jnp.float32) ** 2 + angle_sigma**2 * jnp.maximum(across, 0.0)
    known = 1 / (noise[:, None] + near.variances)
    used = mask & near.valid
    return Matches(near.mean, near.normal, jnp.where(used, known[:, 0] - known[:, 1], 0.0), used)


def no_matches(mask: Bool[Array, " k"]) -> Matches:
    """Return matches of none of the points."""
    zeros = jnp.zeros((*mask.shape, 3), jnp.float32)
    return Matches(zeros, zeros, zeros[:, 0], jnp.zeros_like(mask))


def linearise(
    matches: Matches,
    points: Float32[Array, "k 3"],
    T_world_lidar: jaxlie.SE3,
    frame: Frame,
    kernel: Float[Array, ""],
    params: Params,
) -> NormalEquations:
    """Return the robustly weighted normal equations of associated points at a pose.

    Robust weight: Geman-McClure on s sqrt(k) n'e, the noise-scaled distance in m of a point at offset e from
    its plane's mean, with precision k.
    """
    dtype = T_world_lidar.wxyz_xyz.dtype
    arm, placed = frame.place(jnp.where(matches.used[:, None], points, 0.0), T_world_lidar)
    noise = params.lidar.range_sigma.astype(jnp.float32) ** 2
    distance = jnp.where(matches.used, jnp.sum(matches.normal * (placed - matches.mean), -1), 0.0)
    distance_squared = noise * matches.precision * distance**2
    kernel_squared = kernel.astype(jnp.float32) ** 2
    weight = jnp.where(matches.used, (kernel_squared / (kernel_squared + distance_squared)) ** 2, 0.0)

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
    matched = matches.used.astype(jnp.float32)
    scalars = [matched, weight, weight * distance_squared, matched * jnp.sum(arm**2, -1)]
    weighted = jnp.concatenate([(weight * matches.precision)[:, None] * row, jnp.stack(scalars, -1)], -1)
    sums = (row.T @ weighted).astype(dtype)
    count, weight_sum, squared_error, arm_squared = sums[7, 8:]
    return NormalEquations(
        hessian=(sums[:6, :6] + sums[:6, :6].T) / 2,
        gradient=sums[:6, 6],
        matches=count.astype(jnp.int32),
        weight=weight_sum,
        squared_error=squared_error,
        arm_squared=arm_squared / jnp.maximum(count, 1.0),
    )


def register(
    vmap: VoxelMap,
    points_at: Callable[[jaxlie.SE3], Float32[Array, "k 3"]],
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

    Args:
        vmap: the map.
        points_at: the motion-compensated points in the lidar frame, m, given the pose under trial: the
            compensation may depend on it.
        mask: which points are real.
        T_world_lidar: predicted pose.
        prediction_error: expected error of the prediction, m.
        params: traced parameters.
        max_iterations: bound of the loop.
    """
    settings = params.registration
    dtype = T_world_lidar.wxyz_xyz.dtype

    def opening(iteration: Array) -> Array:
        return prediction_error * 0.5 ** iteration.astype(dtype)

    frame = Frame(*anchor_of(T_world_lidar.translation(), params.map.voxel_size))

    def iterate(carry: tuple) -> tuple:
        T, iteration, _, association, _, _ = carry
        points = points_at(T)
        association = associated(
            association,
            lambda: associate(vmap, points, mask, T, frame, params),
            points,
            mask,
            T,
            settings.reassociation_distance,
        )
        kernel = settings.kernel + opening(iteration)
        equations = linearise(association.found, points, T, frame, kernel, params)
        step, degenerate = _solve_observable(equations, settings.degeneracy_ratio)
        turn, move = step[:3], step[3:]
        T = jaxlie.SE3.from_rotation_and_translation(
            (jaxlie.SO3.exp(turn) @ T.rotation()).normalize(), T.translation() + move
        )
        small = (jnp.linalg.norm(turn) < settings.rotation_tolerance) & (
            jnp.linalg.norm(move) < settings.translation_tolerance
        )
        done = (small & (opening(iteration) < settings.kernel)) | (equations.matches < settings.min_matches)
        return T, iteration + 1, done, association, equations, degenerate

    def unfinished(carry: tuple) -> Array:
        return (carry[1] < max_iterations) & ~carry[2]

    start = (T_world_lidar, jnp.int32(0), jnp.array(False), no_association(no_matches(mask), T_world_lidar))
    shapes = jax.eval_shape(lambda: iterate((*start, None, None))[4:])
    blank = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    T, iterations, done, _, equations, degenerate = jax.lax.while_loop(unfinished, iterate, (*start, *blank))

    lost = (equations.matches < settings.min_matches) | ~jnp.all(jnp.isfinite(T.wxyz_xyz))
    T = jaxlie.SE3(jnp.where(lost, T_world_lidar.wxyz_xyz, T.wxyz_xyz))
    to_body = jax.scipy.linalg.block_diag(*[rotation_matrix(T.rotation())] * 2)
    return Registration(
        T_world_lidar=T,
        information=jnp.where(lost, 0.0, to_body.T @ equations.hessian @ to_body),
        degenerate=degenerate,
        matches=equations.matches,
        rmse=jnp.sqrt(equations.squared_error / jnp.maximum(equations.weight, jnp.finfo(dtype).tiny)),
        iterations=iterations,
        status=jnp.where(lost, TOO_FEW_MATCHES, jnp.where(done, CONVERGED, ITERATION_LIMIT)).astype(
            jnp.int32
        ),
    )


def _solve_observable(
    equations: NormalEquations, degeneracy_ratio: Float[Array, ""]
) -> tuple[Float[Array, "6"], Bool[Array, " 6"]]:
    """Return the Gauss-Newton step in the directions that are observed, and which are not.

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
    return scale * (vectors @ along), degenerate
