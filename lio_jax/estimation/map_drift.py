"""The drift of the local map from the world of the first scan.

A scan match observes the pose within the map around the vehicle, and not the pose in the world. The new
points of a scan are added to the map at the estimated pose, and later scans are matched with them. So a part
of each pose's error stays in the map, and no innovation contains it. A filter that takes its map as exact
reports the error within the map only; the error of the trajectory is the sum of both.

Let f be the share of a scan that is new to the map, and e the pose's error within the map. The error m of the
map ahead becomes m' = (1 - f) m + f (m + e) = m + f e. This is a random walk with variance f^2 P per scan.
The errors e of successive scans are taken as independent, which holds where the match has much more
information than the prediction. The error of a map of a single scan is that of the match of another scan with
it.
"""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.error_state import DOF, POSITION, ROTATION, VELOCITY
from lio_jax.core.geometry import adjoint, from_blocks, rotation_matrix, skew
from lio_jax.core.types import NavState

_POSE = slice(ROTATION.start, POSITION.stop)


class MapDrift(eqx.Module):
    """The error of the map around the vehicle."""

    covariance: Float[Array, "6 6"]
    """Covariance of the IMU's pose in world that the map's error causes alone: right perturbation, rotation
    (rad) before translation (m)."""

    @staticmethod
    def none(dtype: jnp.dtype) -> "MapDrift":
        """Return zero drift, that of the first scan's map."""
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
            covariance: covariance, within the map, of the state at which the scan was added.
            share: share of the scan's points that were new to the map, 0 to 1.
            scans: number of earlier scans. The first scan defines the world, so its share counts as 0. The
                match of the second shows the error of the first scan's map, so its share counts as 1.
        """
        share = jnp.select([scans == 0, scans == 1], [0.0, 1.0], share.astype(covariance.dtype))
        return MapDrift(self.covariance + share**2 * covariance[_POSE, _POSE])

    def with_pose_of(self, covariance: Float[Array, "24 24"], begins: Bool[Array, ""]) -> "MapDrift":
        """Return the drift of a new piece of map that begins at an uncertain pose.

        Args:
            covariance: of the state at which it begins, within the map so far.
            begins: a new piece begins; otherwise the drift stays.
        """
        return MapDrift(self.covariance + jnp.where(begins, covariance[_POSE, _POSE], 0.0))

    def added_to(self, covariance: Float[Array, "24 24"], nav: NavState) -> Float[Array, "24 24"]:
        """Return the covariance of a state's error in the world, given its covariance within the map.

        A rotation of the map rotates the velocity as well as the pose.

        Args:
            covariance: covariance within the map, in the order of :mod:`lio_jax.core.error_state`.
            nav: the state.
        """
        R_imu_world = rotation_matrix(nav.T_world_imu.rotation()).T
        dtype = covariance.dtype
        moves = from_blocks(
            (DOF, 6),
            (_POSE, slice(0, 6), jnp.eye(6, dtype=dtype)),
            (VELOCITY, ROTATION, -skew(R_imu_world @ nav.velocity)),
        )
        return covariance + moves @ self.covariance @ moves.T
