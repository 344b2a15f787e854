"""How far the local map has drifted from the world of the first scan.

A scan match tells the pose within the map around the vehicle, not within the world: what is new in a scan is
added where the vehicle is taken to be, and later scans are matched with it. So a part of each pose's error
stays in the map and is never seen in an innovation. A filter that takes its map for true reports the first
error alone; the trajectory's error is the sum of both.

With f the share of a scan that is new to the map, the map ahead is wrong by m' = (1 - f) m + f (m + e) =
m + f e, e the pose's error within the map: a random walk with variance f^2 P a scan, carried along as the
vehicle moves. It takes the errors e of successive scans as independent, as they are where the match tells
much more than the prediction. A map of one scan alone is as wrong as the match of another scan with it.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float, Int32

from lio_jax.core.error_state import DOF, POSITION, ROTATION, VELOCITY
from lio_jax.core.geometry import adjoint, from_blocks, rotation_matrix, skew
from lio_jax.core.types import NavState

_POSE = slice(ROTATION.start, POSITION.stop)


class MapDrift(eqx.Module):
    """The error of the map around the vehicle."""

    covariance: Float[Array, "6 6"]
    """Of the IMU's pose in the world if it were exact within the map; right perturbation, rotation (rad)
    before translation (m)."""

    @staticmethod
    def none(dtype: jnp.dtype) -> "MapDrift":
        """Return the drift of a map that its first scan defines."""
        return MapDrift(jnp.zeros((6, 6), dtype))

    def carried(self, T_world_before: jaxlie.SE3, T_world_imu: jaxlie.SE3) -> "MapDrift":
        """Return the drift as seen from another pose in the same map."""
        carry = adjoint(T_world_imu.inverse() @ T_world_before)
        covariance = carry @ self.covariance @ carry.T
        return MapDrift((covariance + covariance.T) / 2)

    def grown(
        self, covariance: Float[Array, "24 24"], share: Float[Array, ""], scans: Int32[Array, ""]
    ) -> "MapDrift":
        """Return the drift after a scan was added.

        Args:
            covariance: of the error within the map of the state that the scan was added at.
            share: of the scan's points that were new to the map.
            scans: how many had been seen before: the first one is the world, and the second tells how well it
                shows it.
        """
        share = jnp.select([scans == 0, scans == 1], [0.0, 1.0], share.astype(covariance.dtype))
        return MapDrift(self.covariance + share**2 * covariance[_POSE, _POSE])

    def added_to(self, covariance: Float[Array, "24 24"], nav: NavState) -> Float[Array, "24 24"]:
        """Return the covariance in the world of a state's error, given that within the map.

        A turned map turns the velocity with the pose.
        """
        R_imu_world = rotation_matrix(nav.T_world_imu.rotation()).T
        dtype = covariance.dtype
        moves = from_blocks(
            (DOF, 6),
            (_POSE, slice(0, 6), jnp.eye(6, dtype=dtype)),
            (VELOCITY, ROTATION, -skew(R_imu_world @ nav.velocity)),
        )
        return covariance + moves @ self.covariance @ moves.T
