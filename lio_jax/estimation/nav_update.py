"""The iterated update of the navigation state by a measurement of a sweep's mean pose."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.core.error_state import (
    BIASES,
    DOF,
    EXTRINSIC_ROTATION,
    EXTRINSIC_TRANSLATION,
    GRAVITY,
    LAG,
    POSITION,
    ROTATION,
    TIME_OFFSET,
    VELOCITY,
    NavEstimate,
    SweptState,
    retract,
    sphere_basis,
)
from lio_jax.core.geometry import from_blocks
from lio_jax.core.types import NavState
from lio_jax.estimation.iterated_filter import Measurement, Update, iterated_update
from lio_jax.estimation.pose_measurement import lidar_pose_jacobian
from lio_jax.imu.rotation_integrals import rotation_exponential, rotation_integrals


class _State(NamedTuple):
    """A prediction and its estimated error; all iterates are in the tangent space of the prediction."""

    predicted: NavState
    """The predicted state."""
    error: Float[Array, "30"]
    """Error of the prediction, with the entries of :class:`SweptState`'s covariance."""

    def end(self) -> NavState:
        """Return the state at the sweep's end."""
        return retract(self.predicted, self.error[:DOF])

    def mean(self) -> NavState:
        """Return the state with the sweep's mean pose."""
        return retract(self.predicted, self._mean_error())

    def jacobian(self) -> Float[Array, "6 30"]:
        """Return the derivative of the mean lidar pose by the error."""
        by_mean = lidar_pose_jacobian(self.mean()) @ reset_jacobian(self.predicted, self._mean_error())
        return jnp.concatenate([by_mean, -by_mean[:, : POSITION.stop]], axis=1)

    def add(self, error: Float[Array, "30"]) -> "_State":
        """Return the state with the error added."""
        return _State(self.predicted, self.error + error)

    def subtract(self, other: "_State") -> Float[Array, "30"]:
        """Return the error of the other state less that of this one."""
        return other.error - self.error

    def reset(self, error: Float[Array, "30"]) -> Float[Array, "30 30"]:
        """Return the Jacobian of a change of the tangent space: the identity, because it does not change."""
        return jnp.eye(error.shape[0], dtype=error.dtype)

    def _mean_error(self) -> Float[Array, "24"]:
        lag = self.error[LAG]
        return self.error[:DOF] - jnp.pad(lag, (0, DOF - lag.shape[0]))


class _AtMean(eqx.Module):
    """A measurement of the sweep's mean pose."""

    measure: Callable[..., Measurement]

    def __call__(self, state: _State, *aux: Any) -> Measurement:
        return self.measure(state.mean(), *aux)


def predicted_pose_covariance(prior: SweptState) -> Float[Array, "6 6"]:
    """Return the covariance of the predicted mean lidar pose over a sweep.

    Args:
        prior: predicted state.

    Returns:
        Covariance of the perturbation of :func:`~lio_jax.estimation.pose_measurement.lidar_pose_jacobian`.
    """
    jacobian = _unchanged(prior).jacobian()
    return jacobian @ prior.covariance @ jacobian.T


def update_nav(
    prior: SweptState,
    measure: Callable[..., Measurement],
    *,
    max_iterations: int,
    rotation_tolerance: Float[Array, ""],
    translation_tolerance: Float[Array, ""],
    first_aux: Any = None,
    again: Callable[..., Measurement] | None = None,
    considered: Float[Array, "30 c"] | None = None,
) -> tuple[Update, NavState]:
    """Return the iterated update of a navigation state, and the state with the sweep's mean pose.

    A sweep that was deskewed along the predicted motion is matched as a rigid body, so it measures the mean
    of the pose's error over its points. The error at the sweep's end follows from its correlation with the
    mean.

    Args:
        prior: predicted state.
        measure: linearises the measurement at a :class:`NavState` with the sweep's mean pose, by the lidar's
            pose with the perturbation of :func:`lidar_pose_jacobian`; see :func:`iterated_update`.
        max_iterations: largest number of iterations, at least 1.
        rotation_tolerance: largest rotation of a converged step, rad, per component.
        translation_tolerance: largest translation of a converged step, m, per component.
        first_aux: see :func:`iterated_update`.
        again: see :func:`iterated_update`.
        considered: covariance of the prior's error with c errors that the update does not correct.

    Returns:
        The update, with an :class:`NavEstimate` of the sweep's end as its ``state``, and the state with the
        sweep's mean pose.
    """
    dtype = prior.covariance.dtype
    tolerance = jnp.full(LAG.stop, jnp.inf, dtype)
    tolerance = tolerance.at[ROTATION].set(rotation_tolerance).at[POSITION].set(translation_tolerance)
    update = iterated_update(
        _unchanged(prior),
        prior.covariance,
        _AtMean(measure),
        _State.jacobian,
        _State.add,
        _State.subtract,
        max_iterations=max_iterations,
        tolerance=tolerance,
        first_aux=first_aux,
        again=again and _AtMean(again),
        reset=_State.reset,
        considered=considered,
    )
    found: _State = update.state
    turn = reset_jacobian(prior.nav, found.error[:DOF])
    covariance = turn @ update.covariance[:DOF, :DOF] @ turn.T
    end = NavEstimate(found.end(), (covariance + covariance.T) / 2)
    if update.considered is not None:
        update = update._replace(considered=turn @ update.considered[:DOF])
    return update._replace(state=end, covariance=end.covariance), found.mean()


def _unchanged(prior: SweptState) -> _State:
    return _State(prior.nav, jnp.zeros(prior.covariance.shape[0], prior.covariance.dtype))


def reset_jacobian(nav: NavState, error: Float[Array, "24"]) -> Float[Array, "24 24"]:
    """Return the derivative of ``local(retract(nav, error), retract(nav, error + w))`` at w = 0.

    It maps the covariance of an error from the tangent space at ``nav`` to that at ``retract(nav, error)``.
    Its blocks are right Jacobians for the rotations, the inverse rotation for position and velocity, and on
    the gravity sphere the left Jacobian between the two bases.

    Args:
        nav: state at the origin of the first tangent space.
        error: from ``nav`` to the origin of the second tangent space.
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
