"""Traced parameters of the back end, which corrects the odometry's drift beside any recipe."""

import equinox as eqx
from jaxtyping import Array, Float

from lio_jax.core.types import Scalar


class BackendParams(eqx.Module):
    """What the back end believes of the odometry."""

    odometry_rotation_sigma: Scalar
    """Of the turn from one keyframe to the next, rad."""
    odometry_translation_sigma: Scalar
    """Of the way between them, m."""
    tilt_sigma: Scalar
    """Of the first keyframe's roll and pitch, rad, where GPS ties the trajectory to the world."""


class GpsParams(eqx.Module):
    """Which GPS fixes tie the trajectory to the earth, and how far they are trusted."""

    lever_arm: Float[Array, "3"]
    """Position of the antenna in the IMU frame, m."""
    min_travel: Scalar
    """Fixes are used once the trajectory is this long, m."""
    pose_variance: Scalar
    """A pose whose variance along x and along y is below this does without, m^2."""
    time_gap: Scalar
    """A fix has to be this near to the keyframe in time, s."""
    interpolation: Scalar
    """Between two fixes no farther apart than this the position is interpolated, s."""
    max_variance: Scalar
    """Fixes with a larger variance to the east or north are left out, m^2."""
    min_variance: Scalar
    """Of no axis a smaller variance is believed, m^2: errors of fixes follow each other."""
    height_variance: Scalar
    """Of the height, where it is the odometry's and not the fix's, m^2."""
    spacing: Scalar
    """Keyframes nearer than this to the last one with a fix do without, m."""
    jump_sigmas: Scalar
    """A fix fits another one if their distance differs from the odometry's by less than so many sigmas ..."""
    drift: Scalar
    """... and this share of the way between them."""
    yaw_sigma: Scalar
    """The heading counts as known once its standard deviation is below this, rad."""
