"""The error of the local map in the world of the first scan, considered beside the navigation state.

A scan match observes the pose within the map around the vehicle, and not the pose in the world. The new
points of a scan are added to the map at the estimated pose, and later scans are matched with them. So a part
of each pose's error stays in the map, and no innovation contains it. Neither does an innovation show that the
map's planes lie beside the surfaces, because their points are noisy: the next scans meet the same planes.

Let e be the error of the pose within the map, and m the error of the map around the vehicle, as the error of
a pose that fits the map exactly. The error of the pose in the world is e + m. When a scan is added whose
share f is new to the map, then

    m' = (1 - f) m + f (m + e) + n = m + f e + n,        e' = e - f e.

The noise n is that of the new planes. If the planes that the scans meet are renewed at this rate, and the
pose's error by all of them has the covariance B, then n has the covariance f (2 - f) B. The joint covariance
of e and m is propagated and updated as that of an estimated and a considered state (Schmidt, "Application of
state-space methods to navigation problems", 1966): a match corrects the pose, and the map stays where it is.

Neglected: the pose is taken to follow the new planes at once, though inertial samples hold it back; planes
leave the view and come back later; surfaces are not flat.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.error_state import DOF, GRAVITY, POSITION, ROTATION, VELOCITY, NavEstimate, sphere_basis
from lio_jax.core.geometry import adjoint, from_blocks, inverse, rotation_matrix, skew
from lio_jax.core.types import NavState
from lio_jax.estimation.pose_measurement import imu_pose_jacobian, lidar_pose_jacobian

_POSE = slice(ROTATION.start, POSITION.stop)


class MapDrift(eqx.Module):
    """The error of the map around the vehicle, as a perturbation of the IMU's pose in world: right
    perturbation, rotation (rad) before translation (m)."""

    covariance: Float[Array, "6 6"]
    """Covariance of the map's error."""
    cross: Float[Array, "24 6"]
    """Covariance of the state's error within the map with the map's error, in the order of
    :mod:`lio_jax.core.error_state`."""

    @staticmethod
    def none(dtype: jnp.dtype) -> "MapDrift":
        """Return zero drift, that of the first scan's map."""
        return MapDrift(jnp.zeros((6, 6), dtype), jnp.zeros((DOF, 6), dtype))

    def carried(self, T_world_before: jaxlie.SE3, T_world_imu: jaxlie.SE3) -> "MapDrift":
        """Return the drift as seen from another pose in the same map."""
        carry = adjoint(T_world_imu.inverse() @ T_world_before)
        return MapDrift(_symmetric(carry @ self.covariance @ carry.T), self.cross @ carry.T)

    def grown(
        self,
        within: NavEstimate,
        share: Float[Array, ""],
        by_planes: Float[Array, "6 6"],
        scans: Int32[Array, ""],
    ) -> tuple[NavEstimate, "MapDrift"]:
        """Return state and drift after a scan was added.

        Args:
            within: state at which the scan was added, with the covariance of its error within the map.
            share: share of the scan's points that were new to the map, 0 to 1.
            by_planes: covariance B of the pose's error by the planes of the map.
            scans: number of earlier scans.
        """
        dtype = within.covariance.dtype
        share, noise = taken_into_map(share.astype(dtype), by_planes, scans)
        # the points lie where the lidar's pose puts them: a wrong extrinsic alone moves none
        into_map = share * imu_pose_jacobian(within.nav)
        kept = jnp.eye(DOF, dtype=dtype) - _moves(within.nav) @ into_map
        covariance, both = within.covariance, into_map @ self.cross
        drift = MapDrift(
            _symmetric(self.covariance + both + both.T + into_map @ covariance @ into_map.T + noise),
            kept @ (self.cross + covariance @ into_map.T),
        )
        covariance = kept @ covariance @ kept.T
        return NavEstimate(within.nav, _symmetric(covariance)), drift

    def with_pose_of(
        self,
        covariance: Float[Array, "24 24"],
        begins: Bool[Array, ""],
        moved: Float[Array, "24 24"] | None = None,
    ) -> "MapDrift":
        """Return the drift of a new piece of map that begins at an uncertain pose.

        Args:
            covariance: of the error of the state at which it begins, within the map so far.
            begins: a new piece begins; otherwise the drift stays.
            moved: derivative of the state's error within the new piece by that error; None: zero.
        """
        both, pose = self.cross[_POSE], covariance[_POSE]
        whole = _symmetric(self.covariance + both + both.T + pose[:, _POSE])
        cross = jnp.zeros_like(self.cross) if moved is None else moved @ (self.cross + pose.T)
        return MapDrift(jnp.where(begins, whole, self.covariance), jnp.where(begins, cross, self.cross))

    def added_to(self, within: NavEstimate) -> Float[Array, "24 24"]:
        """Return the covariance of a state's error in the world, given its covariance within the map."""
        moves = _moves(within.nav)
        shared = self.cross @ moves.T
        return _symmetric(within.covariance + moves @ self.covariance @ moves.T + shared + shared.T)


def taken_into_map(
    share: Float[Array, ""], by_planes: Float[Array, "6 6"], scans: Int32[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, "6 6"]]:
    """Return the share of the pose's error that the map takes in with a scan, and the covariance of n.

    The first scan defines the world, so it adds no error. All planes that the second one meets are new.

    Args:
        share: share of the scan's points that were new to the map, 0 to 1.
        by_planes: covariance B of the pose's error by the planes of the map.
        scans: number of earlier scans.
    """
    share = jnp.where(scans == 0, 0.0, share)
    renewed = jnp.where(scans == 1, 1.0, share)
    return share, renewed * (2 - renewed) * by_planes


_WEAKEST = 3e-3
"""Least information of a direction, as a share of that of all directions, by which the planes' error is
bounded where the scene leaves the direction open."""


def error_by_planes(
    information: Float[Array, "6 6"],
    arm_squared: Float[Array, ""],
    nav: NavState,
    share: Float[Array, ""],
) -> Float[Array, "6 6"]:
    """Return the covariance of the pose's error by the errors of the planes that a scan met.

    Args:
        information: of the scan match, with the perturbation of :func:`lidar_pose_jacobian`; zero without a
            match.
        arm_squared: mean squared distance of the points from the sensor, m^2.
        nav: state at which the scan lies on the map.
        share: the planes' variance as a share of the variance by the scan's own noise.

    Returns:
        Covariance of the IMU's right perturbation, rotation (rad) before translation (m); zero without a
        match.
    """
    dtype = information.dtype
    to_metres = jnp.ones(6, dtype).at[:3].set(jax.lax.rsqrt(arm_squared + 1e-6))
    weakest = _WEAKEST * jnp.sum(jnp.diagonal(information) * to_metres**2)
    matched = weakest > 0
    by_imu = lidar_pose_jacobian(nav)[:, _POSE]
    whole = by_imu.T @ (information + jnp.diag(weakest / to_metres**2)) @ by_imu
    found = share * inverse(jnp.where(matched, whole, jnp.eye(6, dtype=dtype)))
    return jnp.where(matched, _symmetric(found), 0.0)


def _moves(nav: NavState) -> Float[Array, "24 6"]:
    """Return the change of a state's error in the world by the map's error.

    A rotation of the map rotates velocity and gravity as well as the pose.
    """
    R_world_imu = rotation_matrix(nav.T_world_imu.rotation())
    return from_blocks(
        (DOF, 6),
        (_POSE, slice(0, 6), jnp.eye(6, dtype=R_world_imu.dtype)),
        (VELOCITY, ROTATION, -skew(R_world_imu.T @ nav.velocity)),
        (GRAVITY, ROTATION, sphere_basis(nav.gravity).T @ R_world_imu),
    )


def _symmetric(covariance: Array) -> Array:
    return (covariance + covariance.T) / 2
