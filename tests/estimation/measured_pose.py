"""The measurement of a navigation state by a lidar pose whose covariance is known."""

import jax.numpy as jnp
import jaxlie

from lio_jax.core.geometry import rotation_matrix
from lio_jax.core.types import NavState
from lio_jax.estimation.iterated_filter import Measurement


def measured_pose(nav: NavState, T_world_lidar: jaxlie.SE3, information) -> Measurement:
    """Return the measurement; ``information`` (6, 6) is that of the pose's right perturbation."""
    missed = T_world_lidar.inverse() @ nav.T_world_imu @ nav.T_imu_lidar
    residual = jnp.concatenate([missed.rotation().log(), missed.translation()])
    to_measured = rotation_matrix(T_world_lidar.rotation().inverse())
    H = jnp.zeros((6, 6), residual.dtype)
    # Exp(turn) on the left of the residual's rotation acts through its inverse left Jacobian
    H = H.at[:3, :3].set(missed.rotation().inverse().jlog() @ to_measured).at[3:, 3:].set(to_measured)
    return Measurement(H.T @ information @ H, H.T @ information @ residual, lost=jnp.array(False))
