"""The iterated update of the navigation state."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from lio_jax.core.error_state import (
    DOF,
    EXTRINSIC_ROTATION,
    GRAVITY,
    POSITION,
    ROTATION,
    VELOCITY,
    Uncertain,
    local,
    retract,
    sphere_basis,
)
from lio_jax.core.types import NavState
from lio_jax.estimation.iterated_filter import Measurement, Update, iterated_update
from lio_jax.estimation.pose_measurement import lidar_pose_jacobian
from lio_jax.imu.rotation_integrals import rotation_integrals


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
    back = jaxlie.SO3.exp(-error[ROTATION]).as_matrix()
    basis = sphere_basis(nav.gravity)
    turn = basis @ error[GRAVITY]
    turned_basis = sphere_basis(jaxlie.SO3.exp(turn) @ nav.gravity)
    blocks = (
        (ROTATION, rotation_integrals(-error[ROTATION])[0]),
        (POSITION, back),
        (VELOCITY, back),
        (GRAVITY, turned_basis.T @ rotation_integrals(turn)[0] @ basis),
        (EXTRINSIC_ROTATION, rotation_integrals(-error[EXTRINSIC_ROTATION])[0]),
    )
    reset = jnp.eye(DOF, dtype=error.dtype)
    for part, block in blocks:
        reset = reset.at[part, part].set(block)
    return reset
