"""The motion since the last scan while a pose is under trial: each trial pose implies a constant velocity."""

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from lio_jax.core.types import Scan
from lio_jax.lidar.deskew import deskew_constant_velocity


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
        last_twist: Float[Array, "6"], since: Float[Array, ""], scan: Scan, first: Bool[Array, ""]
    ) -> "TrialMotion":
        """Return the motion to a scan's middle.

        Args:
            last_twist: velocity before.
            since: from the instant that the motion begins at to the last scan's end, s.
            scan: its interval and duration.
            first: no scan was seen before.
        """
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
