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


class LoopParams(eqx.Module):
    """Places that are seen again: which are compared, and what has to hold before a loop is closed."""

    radius: Scalar
    """The nearest earlier keyframe within this distance is compared, m ..."""
    time_gap: Scalar
    """... if it is older than this, s."""
    drift: Scalar
    """Largest error of position that the odometry may have gathered, m per m run."""
    heading_drift: Scalar
    """Likewise of heading, rad per m run."""
    tilt: Scalar
    """Largest error of roll and pitch that a loop may correct, rad."""
    descriptor_range: Scalar
    """Farthest points that describe a place, m."""
    descriptor_distance: Scalar
    """Places whose descriptors differ by more than this are not compared, 0 to 1."""
    aligning_voxel: Scalar
    """Of the map that a scan is aligned with in the end, m; at first it is twice this."""
    overlap_distance: Scalar
    """A point agrees with the map if the map has a point nearer than this, m."""
    overlap: Scalar
    """Least share of points of upright things that agree."""
    fitness: Scalar
    """Largest mean squared distance to the map of the points that have it near, m^2."""
    conflict: Scalar
    """Largest share of the map's upright things that stand where the scan saw through."""
    rival: Scalar
    """No other alignment may agree with more than this share of the points that agree with the best."""
    rotation_sigma: Scalar
    """What a loop's rotation is believed with at best, rad."""
    translation_sigma: Scalar
    """Likewise its translation, m."""
    support_reach: Scalar
    """Loops confirm or contradict each other if both ends are no farther apart than this, m run."""


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
