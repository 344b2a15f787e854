"""The covariance of odometry whose poses come from scan matches alone, without inertial samples.

A match observes the pose within the map. Where it leaves a direction open, the pose goes on with the last
velocity. How fast the velocity changes is seen in the scans before: it is taken for a random walk, by white
acceleration. The map's error is considered as with inertial samples (:mod:`lio_jax.estimation.map_drift`).
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.error_state import DOF, GYRO_BIAS, POSITION, ROTATION, VELOCITY, NavEstimate
from lio_jax.core.geometry import adjoint, from_blocks, inverse, rotation_matrix, skew
from lio_jax.core.types import NavState, initial_nav_state
from lio_jax.estimation.map_drift import MapDrift, error_by_planes
from lio_jax.estimation.pose_measurement import keep_observed, lidar_pose_jacobian
from lio_jax.imu.initialise import MOVING_SPEED
from lio_jax.lidar.deskew import TrialMotion
from lio_jax.recipes.inertial_filter import after_match
from lio_jax.registration.gauss_newton import Registration

_POSE = slice(ROTATION.start, POSITION.stop)
_RATE = GYRO_BIAS
"""The angular rate's error stands in the place of the gyroscope's bias, which nobody has here."""
_FIRST_RATE = 1.0
"""Standard deviation of the first angular rate per axis, rad/s."""
_REMEMBERED = 10
"""Number of scans over which the changes of velocity are averaged."""
_UNSEEN = (0.01, 1.0)
"""Least density of angular (rad^2/s^3) and linear (m^2/s^3) acceleration while no scan shows all directions.
Vehicles accelerate for seconds, which adds up to more than the changes from scan to scan let expect."""


class ScanOnMap(eqx.Module):
    """How a scan was matched with the map and added to it."""

    match: Registration
    degeneracy_ratio: Float[Array, ""]
    """Of the match, ``params.registration.degeneracy_ratio``."""
    arm_squared: Float[Array, ""]
    """Mean squared distance of the matched points from the sensor, m^2."""
    plane_share: Float[Array, ""]
    """Variance of the pose by the errors of the map's planes, as a share of that by the scan's own noise."""
    added: Float[Array, ""]
    """Share of the scan's points that were new to the map, 0 to 1."""
    lost: Bool[Array, ""]
    """The scan was not matched."""
    new_piece: Bool[Array, ""]
    """A new piece of map begins with the scan."""


class LidarCovariance(eqx.Module):
    """The covariance of a pose and a velocity that come from scan matches alone, at a scan's middle."""

    covariance: Float[Array, "24 24"]
    """Covariance of the lidar's error within the map, in the order of :mod:`lio_jax.core.error_state`, as if
    it were the IMU. The error of the angular rate, rad/s, takes the place of the gyroscope's bias."""
    drift: MapDrift
    acceleration: Float[Array, "2"]
    """Density of white angular (rad^2/s^3) and linear (m^2/s^3) acceleration, per axis."""

    @staticmethod
    def at_start(dtype: jnp.dtype) -> "LidarCovariance":
        """Return what is known before the first scan: its pose, which is the world's origin."""
        sigma = jnp.zeros(DOF, dtype).at[VELOCITY].set(MOVING_SPEED).at[_RATE].set(_FIRST_RATE)
        return LidarCovariance(jnp.diag(sigma**2), MapDrift.none(dtype), jnp.asarray(_UNSEEN, dtype))

    def after(
        self,
        motion: TrialMotion,
        T_last: jaxlie.SE3,
        twist: Float[Array, "6"],
        scan: ScanOnMap,
        scans: Int32[Array, ""],
        T_imu_lidar: jaxlie.SE3,
    ) -> tuple["LidarCovariance", Float[Array, "24 24"]]:
        """Return the covariances after a scan, and that of the navigation state at the scan's end.

        Args:
            motion: from the last scan's middle to this one's.
            T_last: pose of the lidar in the last scan's middle.
            twist: velocity found, m/s then rad/s, lidar frame.
            scan: its match.
            scans: number of earlier scans.
            T_imu_lidar: extrinsic.

        Returns:
            The covariances, and that of pose and velocity of the IMU in the world of the first scan; other
            rows are zero.
        """
        seconds = jnp.where(motion.known, motion.elapsed, 0.0)
        T, observing = scan.match.T_world_lidar, ~scan.lost & ~jnp.any(scan.match.degenerate)
        before, nav = _lidar_as_imu(T_last, motion.last_twist), _lidar_as_imu(T, twist)
        least = jnp.where(observing, 0.0, jnp.asarray(_UNSEEN, seconds.dtype))
        moving = dataclasses.replace(self, acceleration=jnp.maximum(self.acceleration, least))
        predicted = moving._carried(self.covariance, before, nav, seconds)
        cross = _carry(before, nav, seconds) @ self.drift.cross
        covariance, cross, information = _matched(predicted, cross, nav, scan)
        no_sweep = jnp.zeros_like(seconds)
        matched = NavEstimate(nav, covariance)
        within, drift = after_match(matched, self.drift, cross, T_last, no_sweep, scan.new_piece)
        by_planes = error_by_planes(information, scan.arm_squared, nav, scan.plane_share)
        after, grown = drift.grown(within, scan.added, by_planes, scans)
        learns = observing & motion.known & (scans > 1)
        learnt = LidarCovariance(after.covariance, grown, self._learnt(motion, twist, scans, learns))
        at_end = _lidar_as_imu(T @ jaxlie.SE3.exp(motion.middle * twist), twist)
        # the first scan's end is the world's origin
        to_end = jnp.where(scans == 0, 0.0, motion.middle)
        world = learnt._carried(drift.added_to(within), nav, at_end, to_end)
        to_imu = _to_imu(at_end, twist, T_imu_lidar)
        return learnt, to_imu @ world @ to_imu.T

    def _carried(
        self,
        covariance: Float[Array, "24 24"],
        before: NavState,
        nav: NavState,
        seconds: Float[Array, ""],
    ) -> Float[Array, "24 24"]:
        """Return a covariance after some time of white acceleration."""
        carry = _carry(before, nav, seconds)
        angular, linear = self.acceleration[:, None, None] * jnp.eye(3, dtype=carry.dtype)
        blocks = []
        for place, speed, density in ((ROTATION, _RATE, angular), (POSITION, VELOCITY, linear)):
            blocks += [(place, place, density * seconds**3 / 3), (speed, speed, density * seconds)]
            blocks += [(place, speed, density * seconds**2 / 2), (speed, place, density * seconds**2 / 2)]
        return carry @ covariance @ carry.T + from_blocks((DOF, DOF), *blocks)

    def _learnt(
        self, motion: TrialMotion, twist: Float[Array, "6"], scans: Int32[Array, ""], learns: Bool[Array, ""]
    ) -> Float[Array, "2"]:
        """Return the density of acceleration with what a scan says of it.

        The mean velocities of two intervals of white acceleration of density q differ by the variance
        2/3 q t.
        """
        change = jnp.mean((twist - motion.last_twist).reshape(2, 3) ** 2, 1)[::-1]
        density = 1.5 * change / jnp.where(motion.known, motion.elapsed, 1.0)
        weight = jnp.where(learns, 1 / jnp.clip(scans - 1, 1, _REMEMBERED), 0.0)
        return self.acceleration + weight.astype(density.dtype) * (density - self.acceleration)


def _lidar_as_imu(T_world_lidar: jaxlie.SE3, twist: Float[Array, "6"]) -> NavState:
    """Return the state of an IMU at the lidar's pose that moves with its twist; see ``_RATE``."""
    still = initial_nav_state(jaxlie.SE3(jnp.array([1, 0, 0, 0, 0, 0, 0], twist.dtype)))
    pose = jaxlie.SE3(T_world_lidar.wxyz_xyz)
    velocity = pose.rotation() @ twist[:3]
    return dataclasses.replace(still, T_world_imu=pose, velocity=velocity, gyro_bias=twist[3:])


def _by_body(nav: NavState) -> Float[Array, "24 24"]:
    """Return the derivative of the error of the velocity along the body's own axes, the rest as it is."""
    velocity = rotation_matrix(nav.T_world_imu.rotation()).T @ nav.velocity
    return jnp.eye(DOF, dtype=velocity.dtype).at[VELOCITY, ROTATION].set(skew(velocity))


def _carry(before: NavState, nav: NavState, seconds: Float[Array, ""]) -> Float[Array, "24 24"]:
    """Return the derivative of a state's error by that some time before; the body keeps its own velocity."""
    way = adjoint(nav.T_world_imu.inverse() @ before.T_world_imu)
    velocity = rotation_matrix(nav.T_world_imu.rotation()).T @ nav.velocity
    # the right Jacobian of the exponential, to second order in the time
    turn = seconds * jnp.eye(3, dtype=way.dtype) - seconds**2 / 2 * skew(nav.gyro_bias)
    rest = slice(POSITION.stop, DOF)
    kept = from_blocks(
        (DOF, DOF),
        (_POSE, _POSE, way),
        (rest, rest, jnp.eye(DOF - POSITION.stop, dtype=way.dtype)),
        (ROTATION, _RATE, turn),
        (POSITION, VELOCITY, turn),
        (POSITION, _RATE, -(seconds**2) / 2 * skew(velocity)),
    )
    return (2 * jnp.eye(DOF, dtype=way.dtype) - _by_body(nav)) @ kept @ _by_body(before)


def _matched(
    covariance: Float[Array, "24 24"], cross: Float[Array, "24 6"], nav: NavState, scan: ScanOnMap
) -> tuple[Float[Array, "24 24"], Float[Array, "24 6"], Float[Array, "6 6"]]:
    """Return covariances after a match, and its information in world axes."""
    to_world = rotation_matrix(nav.T_world_imu.rotation())
    axes = from_blocks((6, 6), (ROTATION, ROTATION, to_world), (POSITION, POSITION, to_world))
    # along a degenerate direction the pose is the prediction
    ratio = jnp.where(jnp.any(scan.match.degenerate), scan.degeneracy_ratio, 0.0)
    information, _, _ = keep_observed(
        axes @ scan.match.information @ axes.T, jnp.zeros(6, covariance.dtype), scan.arm_squared, ratio
    )
    by_pose = lidar_pose_jacobian(nav)
    reached = by_pose @ covariance
    inside = jnp.eye(6, dtype=covariance.dtype) + reached @ by_pose.T @ information
    gain = reached.T @ information @ inverse(inside)
    covariance, cross = covariance - gain @ reached, cross - gain @ by_pose @ cross
    return (covariance + covariance.T) / 2, cross, information


def _to_imu(lidar: NavState, twist: Float[Array, "6"], T_imu_lidar: jaxlie.SE3) -> Float[Array, "24 24"]:
    """Return the derivative of the error of the IMU's pose and velocity; the other rows are zero."""
    turn, arm = rotation_matrix(T_imu_lidar.rotation()), skew(T_imu_lidar.translation())
    moved = from_blocks(
        (DOF, DOF),
        (_POSE, _POSE, adjoint(T_imu_lidar)),
        (VELOCITY, VELOCITY, turn),
        (VELOCITY, _RATE, arm @ turn),
    )
    velocity = turn @ twist[:3] + arm @ turn @ twist[3:]
    identity = jnp.eye(DOF, dtype=turn.dtype)
    return identity.at[VELOCITY, ROTATION].set(-skew(velocity)) @ moved @ _by_body(lidar)


def mean_squared_range(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], dtype: jnp.dtype
) -> Float[Array, ""]:
    """Return the mean squared distance of a scan's points from the sensor, m^2."""
    squared = jnp.where(mask, jnp.sum(points**2, -1), 0.0)
    return (jnp.sum(squared) / jnp.maximum(jnp.sum(mask), 1)).astype(dtype)
