"""What the scan matches' Gauss-Newton solves share: normal equations of a pose, observed steps, the result.

A step turns a pose about its own position and moves it, in the axes of the frame it is given in.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.params import RegistrationParams
from lio_jax.core.status import CONVERGED, ITERATION_LIMIT, LOST


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
    """CONVERGED, ITERATION_LIMIT or LOST; in the last case the pose is the prediction."""


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

    @staticmethod
    def nothing(dtype: jnp.dtype) -> "NormalEquations":
        """Return the equations of no points."""
        zero = jnp.zeros((), dtype)
        return NormalEquations(jnp.zeros((6, 6), dtype), jnp.zeros(6, dtype), jnp.int32(0), zero, zero, zero)

    def rmse(self) -> Float[Array, ""]:
        """Return the robustly weighted root mean square distance to the map, m; 0 without matches."""
        some = (self.weight > 0) & (self.squared_error > 0)
        mean = jnp.where(some, self.squared_error, 1.0) / jnp.where(some, self.weight, 1.0)
        return jnp.where(some, jnp.sqrt(mean), 0.0)


class Directions(eqx.Module):
    """Along which a step was taken."""

    vectors: Float[Array, "6 6"]
    """In columns, scaled to metres."""
    degenerate: Bool[Array, " 6"]
    """Which of them the scan does not constrain: they were held."""

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


def unmet(
    T_world_lidar: jaxlie.SE3,
    T_predicted: jaxlie.SE3,
    directions: Directions,
    gradient: Float[Array, "6"],
) -> Float[Array, "6"]:
    """Return what vanishes at a solution: the gradient where observed, else the way from the prediction.

    Args:
        T_world_lidar: a pose at the solution or beside it.
        T_predicted: what the solve began at.
        directions: of its last step.
        gradient: at ``T_world_lidar``.
    """
    turn = (T_world_lidar.rotation() @ T_predicted.rotation().inverse()).log()
    way = jnp.concatenate([turn, T_world_lidar.translation() - T_predicted.translation()])
    along = jnp.linalg.solve(directions.vectors, way)
    held = along - jax.lax.stop_gradient(along)
    return jnp.where(directions.degenerate, held, directions.vectors.T @ gradient)


def registration_at(
    T_world_lidar: jaxlie.SE3,
    T_predicted: jaxlie.SE3,
    equations: NormalEquations,
    directions: Directions,
    iterations: Int32[Array, ""],
    done: Bool[Array, ""],
    settings: RegistrationParams,
) -> Registration:
    """Return the result of a solve that ended at a pose, or at the prediction if it found too few matches."""
    T = T_world_lidar
    lost = (equations.matches < settings.min_matches) | ~jnp.all(jnp.isfinite(T.wxyz_xyz))
    T = jaxlie.SE3(jnp.where(lost, T_predicted.wxyz_xyz, T.wxyz_xyz))
    to_body = jax.scipy.linalg.block_diag(*[rotation_matrix(T.rotation())] * 2)
    return Registration(
        T_world_lidar=T,
        information=jnp.where(lost, 0.0, to_body.T @ equations.hessian @ to_body),
        degenerate=directions.degenerate,
        matches=equations.matches,
        rmse=equations.rmse(),
        iterations=iterations,
        status=jnp.where(lost, LOST, jnp.where(done, CONVERGED, ITERATION_LIMIT)).astype(jnp.int32),
    )
