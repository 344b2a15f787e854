"""The iterated update of the navigation state."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.core.blocks import from_blocks
from lio_jax.core.error_state import (
    BIASES,
    DOF,
    EXTRINSIC_ROTATION,
    EXTRINSIC_TRANSLATION,
    GRAVITY,
    POSITION,
    ROTATION,
    TIME_OFFSET,
    VELOCITY,
    Uncertain,
    local,
    retract,
    sphere_basis,
)
from lio_jax.core.types import NavState
from lio_jax.estimation.iterated_filter import Measurement, Update, iterated_update
from lio_jax.estimation.pose_measurement import lidar_pose_jacobian
from lio_jax.imu.rotation_integrals import rotation_exponential, rotation_integrals


def update_nav(
    prior: Uncertain,
    measure: Callable[..., Measurement],
    *,
    max_iterations: int,
    rotation_tolerance: Float[Array, ""],
    translation_tolerance: Float[Array, ""],
    first_aux: Any = None,
    again: Callable[..., Measurement] | None = None,
) -> Update:
    """Return the iterated update of a navigation state; its ``state`` is an :class:`Uncertain`.

    Args:
        prior: predicted state.
        measure: linearises the measurement at the :class:`NavState` it is given with respect to the lidar's
            pose, perturbed as in :func:`lidar_pose_jacobian`; see :func:`iterated_update`.
        max_iterations: bound of the loop, at least 1.
        rotation_tolerance: converged when no component of a step turns more than this, rad ...
        translation_tolerance: ... and none moves more than this, m.
        first_aux: see :func:`iterated_update`; ``again`` likewise.
    """
    dtype = prior.covariance.dtype
    tolerance = jnp.full(DOF, jnp.inf, dtype)
    tolerance = tolerance.at[ROTATION].set(rotation_tolerance).at[POSITION].set(translation_tolerance)
    update = iterated_update(
        prior.nav,
        prior.covariance,
        measure,
        lidar_pose_jacobian,
        retract,
        local,
        max_iterations=max_iterations,
        tolerance=tolerance,
        first_aux=first_aux,
        again=again,
        reset=reset_jacobian,
    )
    return update._replace(state=Uncertain(update.state, update.covariance))


def reset_jacobian(nav: NavState, error: Float[Array, "24"]) -> Float[Array, "24 24"]:
    """Return the derivative of ``local(retract(nav, error), retract(nav, error + w))`` at w = 0.

    It moves the covariance of an error from the tangent space at ``nav`` to that at ``retract(nav, error)``:
    right Jacobians for the rotations, the rotation back for position and velocity, and on the gravity sphere
    the left Jacobian between the two bases.
    """
    basis = sphere_basis(nav.gravity)
    turns = jnp.stack([-error[ROTATION], -error[EXTRINSIC_ROTATION], basis @ error[GRAVITY]])
    back, _, turn = rotation_exponential(turns)
    jacobian, extrinsic_jacobian, gravity_jacobian = rotation_integrals(turns)[0]
    identity = jnp.eye(6, dtype=error.dtype)
    blocks = (
        (ROTATION, jacobian),
        (POSITION, back),
        (VELOCITY, back),
        (BIASES, identity),
        (GRAVITY, sphere_basis(turn @ nav.gravity).T @ gravity_jacobian @ basis),
        (EXTRINSIC_ROTATION, extrinsic_jacobian),
        (slice(EXTRINSIC_TRANSLATION.start, TIME_OFFSET.stop), identity[:4, :4]),
    )
    return from_blocks((DOF, DOF), *((part, part, block) for part, block in blocks))
