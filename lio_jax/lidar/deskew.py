"""Motion compensation with constant velocity, known or under trial together with the pose."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.types import Scan


def deskew_constant_velocity(
    points: Float[Array, "n 3"], delay: Float[Array, " n"], twist: Float[Array, "6"]
) -> Float[Array, "n 3"]:
    """Move points measured ``delay`` seconds after an instant into the sensor frame of that instant.

    The result is p' = exp(delay * twist) p. The SE(3) exponential is in closed form (Rodrigues), in the
    points' dtype, without a quaternion for each point.

    Args:
        points: m, sensor frame at the firing time of each point.
        delay: firing time minus the instant, s; negative for points before the instant.
        twist: velocity of the sensor in its own frame, translation (m/s) first, then rotation (rad/s).
    """
    velocity, rate = twist[:3].astype(points.dtype), twist[3:].astype(points.dtype)
    angle_squared = delay**2 * jnp.sum(rate**2)
    small = angle_squared < 1e-2  # above it 1 - cos keeps enough digits in float32
    safe = jnp.where(small, 1.0, angle_squared)
    angle = jnp.sqrt(safe)
    a = jnp.where(small, 1 - angle_squared / 6 * (1 - angle_squared / 20), jnp.sin(angle) / angle)
    b = jnp.where(small, 0.5 - angle_squared / 24 * (1 - angle_squared / 30), (1 - jnp.cos(angle)) / safe)
    c = jnp.where(small, 1 / 6 - angle_squared / 120 * (1 - angle_squared / 42), (1 - a) / safe)
    omega = delay[:, None] * rate
    shift = delay[:, None] * velocity
    crossed = jnp.cross(omega, points)
    rotated = points + a[:, None] * crossed + b[:, None] * jnp.cross(omega, crossed)
    swept = jnp.cross(omega, shift)
    return rotated + shift + b[:, None] * swept + c[:, None] * jnp.cross(omega, swept)


def twist_without_turn(velocity: Float[Array, "3"], T_imu_lidar: jaxlie.SE3) -> Float[Array, "6"]:
    """Return the velocity of the lidar in its own frame, m/s then rad/s, while the body does not turn.

    Args:
        velocity: of the IMU, along its own axes, m/s.
        T_imu_lidar: extrinsic pose of the lidar in the IMU frame.
    """
    return jnp.concatenate([T_imu_lidar.rotation().inverse() @ velocity, jnp.zeros_like(velocity)])


class TrialMotion(eqx.Module):
    """The motion from one instant to the middle of a scan."""

    last_twist: Float[Array, "6"]
    """The velocity before, m/s then rad/s, lidar frame."""
    elapsed: Float[Array, ""]
    """From that instant to the scan's middle, s."""
    known: Bool[Array, ""]
    """False where there was no scan before, or no time between the two."""
    middle: Float[Array, ""]
    """The scan's middle from its start, s."""
    to_end: Float[Array, ""]
    """From that instant to the scan's end, s."""

    @staticmethod
    def since(
        twist: Float[Array, "6"],
        turning: Float[Array, ""],
        since: Float[Array, ""],
        scan: Scan,
        first: Bool[Array, ""],
    ) -> "TrialMotion":
        """Return the motion to a scan's middle.

        Args:
            twist: velocity at the last scan.
            turning: share of the turning rate that lasts, 0 to 1.
            since: from the instant that the motion begins at to the last scan's end, s.
            scan: its interval and duration.
            first: no scan was seen before.
        """
        last_twist = jnp.concatenate([twist[:3], turning * twist[3:]])
        middle = 0.5 * scan.duration.astype(last_twist.dtype)
        # the first scan's end is the world's origin, however many empty scans went before
        interval = jnp.where(first, 0.0, scan.interval.astype(last_twist.dtype))
        to_end = since + interval
        elapsed = to_end - middle
        return TrialMotion(last_twist, elapsed, ~first & (elapsed > 0), middle, to_end)

    def predicted(self) -> jaxlie.SE3:
        """Return T_last_lidar if the velocity stays."""
        return jaxlie.SE3.exp(self.elapsed * self.last_twist)

    def twist_to(self, T_last_lidar: jaxlie.SE3) -> Float[Array, "6"]:
        """Return the constant twist that leads to a pose; the last one where there was no scan before."""
        return jnp.where(
            self.known, T_last_lidar.log() / jnp.where(self.known, self.elapsed, 1.0), self.last_twist
        )

    def compensated(
        self, points: Float[Array, "n 3"], time: Float[Array, " n"], T_last_lidar: jaxlie.SE3
    ) -> Float[Array, "n 3"]:
        """Return points as the sensor would have seen them from where it was in the scan's middle.

        Args:
            points: m, lidar frame at each point's own time.
            time: s from the scan's start.
            T_last_lidar: the pose under trial.
        """
        delay = time - self.middle.astype(time.dtype)
        return deskew_constant_velocity(points, delay, self.twist_to(T_last_lidar))
