"""Reconstruct rings and point times of scans whose recording holds neither."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError

_BIN_DEG = 0.05
_FEW = 0.1
"""A bin of the histogram counts as empty below this share of a typical level's points."""
_MARGIN_DEG = 1.0
"""Angle by which points may exceed the outermost beams, deg."""
_DOUBTFUL, _WRONG = 0.05, 0.25
"""Share of points outside the beams above which a layout is doubtful, or wrong."""
_MANY, _TOO_MANY = 1.25, 1.5
"""Levels per beam above which a layout is doubtful, or wrong; noise may split a few levels."""


def elevation_levels(points: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the elevations at which points accumulate, ascending, deg: one for each spinning beam.

    Levels are runs of well-filled bins of 0.05 deg in the histogram of elevations. Beams less than 0.1 deg
    apart therefore count as one.

    Args:
        points: (n, 3) m, lidar frame, not motion compensated.
    """
    elevation = elevation_deg(points)
    if not len(elevation):
        return np.zeros(0)
    low = float(elevation.min())
    counts = np.bincount(((elevation - low) / _BIN_DEG).astype(np.intp))
    # half of all points are in bins that are at least this full
    ordered = np.sort(counts)[::-1]
    typical = ordered[np.searchsorted(np.cumsum(ordered), 0.5 * counts.sum())]
    full = np.concatenate([[False], counts > _FEW * typical, [False]])
    starts, ends = np.flatnonzero(~full[:-1] & full[1:]), np.flatnonzero(full[:-1] & ~full[1:])
    return low + _BIN_DEG * (starts + ends) / 2


def check_beams(points: NDArray[np.floating[Any]], beams: int, given: bool, where: str) -> tuple[str, ...]:
    """Return a sentence if the points do not fit the beams for which their rings are reconstructed.

    Args:
        points: points of one scan, (n, 3) m, lidar frame.
        beams: 16, 32 or 64.
        given: whether the settings state the number of beams; else it is guessed.
        where: recording and topic, for the error.

    Raises:
        UsageError: the number of beams is given by the settings and does not fit the sensor.
    """
    if not len(points):
        return ()
    levels = elevation_levels(points)
    lowest, highest = BEAMS_DEG[beams]
    elevation = elevation_deg(points)
    astray = np.mean((elevation < lowest - _MARGIN_DEG) | (elevation > highest + _MARGIN_DEG))
    crowding = len(levels) / beams
    if astray < _DOUBTFUL and crowding < _MANY:
        return ()
    sentence = (
        f"{beams} beams from {lowest:.1f} to {highest:.1f} deg do not fit the points, whose elevations, "
        f"{levels[0]:.1f} to {levels[-1]:.1f} deg in {len(levels)} levels, suggest {_suggestion(levels)}"
    )
    if given and (astray >= _WRONG or crowding >= _TOO_MANY):
        raise UsageError(f"{where}: config.data.beams={sentence}.")
    return (sentence,)


def _suggestion(levels: NDArray[np.float64]) -> str:
    for beams, (lowest, highest) in BEAMS_DEG.items():
        # the highest beams may see only sky
        fits = abs(levels[0] - lowest) < 2 * _MARGIN_DEG and levels[-1] < highest + _MARGIN_DEG
        if fits and len(levels) < _MANY * beams:
            return f"config.data.beams={beams}"
    return (
        f"a sensor of about {len(levels)} beams whose layout is not known (known are those of the VLP-16, "
        "HDL-32E and HDL-64E): record the field ring"
    )


KITTI_START_AZIMUTH = float(np.pi)
"""atan2(y, x) at which a sweep of KITTI's HDL-64E starts (straight behind), rad."""

_TWO_PI = np.float32(2 * np.pi)
BEAMS_DEG = {16: (-15.0, 15.0), 64: (-24.33, 2.0), 32: (-92.0 / 3.0, 32.0 / 3.0)}
"""Elevation of the lowest and the highest beam of the sensors whose layout is known, by number of beams."""


def azimuth_time(
    points: NDArray[np.floating[Any]],
    duration: float,
    *,
    start_azimuth: float | None = None,
    clockwise: bool = True,
) -> NDArray[np.float32]:
    """Return each point's time in the sweep from its azimuth, (n,) s within [0, duration].

    With ``start_azimuth`` the sweep is one full turn from there. Without it the first and the last point are
    the ends of the sweep, whose length is taken between pi and 3 pi (A-LOAM's scan registration). If the
    points are stored ring after ring, the last point ends a ring and not the sweep; the sweep is then one
    full turn from the first point.

    KITTI's HDL-64E scans need ``start_azimuth=KITTI_START_AZIMUTH`` and clockwise: they store every ring by
    rising azimuth from straight ahead, which is not the firing order. This was measured on raw drive 0005
    during its turn. Ten hypotheses were compared (start behind, ahead, left, right or at 150 deg; either
    direction), and "already compensated". The clockwise sweep from behind leaves the smallest point-to-plane
    residual between scans 1.2 to 2 s apart (median of the inliers, averaged over six pairs: 18.6 mm;
    uncompensated 20.7, clockwise from 165 and 195 deg 18.8 and 19.4, counter-clockwise from behind 25.1, from
    ahead 21.3). KISS-ICP assumes it too.

    Args:
        points: (n, 3) m, lidar frame.
        duration: duration of the sweep, s.
        start_azimuth: atan2(y, x) at which the sweep starts, rad; None: see above.
        clockwise: whether the sensor turns clockwise seen from above (azimuth falls with time).
    """
    if len(points) == 0 or duration <= 0.0:
        return np.zeros(len(points), np.float32)
    turned = np.arctan2(points[:, 1], points[:, 0]).astype(np.float32, copy=False)
    sign = np.float32(-1.0 if clockwise else 1.0)
    turned *= sign
    if start_azimuth is None and not _stored_ring_by_ring(turned):
        fraction = _fraction_between_ends(turned)
    else:
        start = turned[0] if start_azimuth is None else sign * np.float32(start_azimuth)
        fraction = (turned - start) / _TWO_PI
        fraction -= np.floor(fraction)
    return np.clip(fraction, 0.0, 1.0) * np.float32(duration)


def ring_from_elevation(points: NDArray[np.floating[Any]], beams: int) -> NDArray[np.int32]:
    """Return the beam of each point by its elevation, (n,); -1 where no beam has that elevation.

    The beam layouts are those of A-LOAM: VLP-16 and HDL-32E count from the lowest beam, HDL-64E from the
    highest.

    Args:
        points: (n, 3) m, lidar frame.
        beams: 16, 32 or 64.

    Raises:
        UsageError: no beam layout is known for that number of beams.
    """
    elevation = elevation_deg(points)
    if beams == 16:
        ring = ((elevation + 15.0) / 2.0 + 0.5).astype(np.int32)
        valid = ring < 16
    elif beams == 32:
        ring = ((elevation + 92.0 / 3.0) * 0.75).astype(np.int32)
        valid = ring < 32
    elif beams == 64:
        upper = elevation >= -8.83
        ring = np.where(
            upper, (2.0 - elevation) * 3.0 + 0.5, 32.0 + np.trunc((-8.83 - elevation) * 2.0 + 0.5)
        )
        ring = ring.astype(np.int32)
        valid = (elevation >= -24.33) & (elevation <= 2.0) & (ring <= 50)
    else:
        raise UsageError(
            f"config.data.beams={beams}: rings can be reconstructed for 16, 32 or 64 beams only."
        )
    return np.where(valid & (ring >= 0), ring, -1).astype(np.int32)


def ring_from_azimuth_wraps(points: NDArray[np.floating[Any]]) -> NDArray[np.int32]:
    """Return the beam of each point of a file that stores ring after ring from straight ahead, (n,) from 0.

    A ring ends where the azimuth in [0, 2 pi) decreases by more than an eighth of a turn: compensated scans
    jitter by up to 11 deg, and a new ring decreases it by about 320 deg. All scans at hand of KITTI raw and
    odometry give 64 rings in this way, from the highest beam (2 deg) to the lowest (-24 deg). By elevation,
    neighbouring rings would mix.

    Args:
        points: (n, 3) m, lidar frame, as stored by KITTI.
    """
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    azimuth[np.signbit(azimuth)] += _TWO_PI  # y = -0.0, rounded from a negative, still ends a ring
    ring = np.zeros(len(points), np.int32)
    np.cumsum(np.diff(azimuth) < -0.125 * _TWO_PI, out=ring[1:])
    return ring


def guess_beams(points: NDArray[np.floating[Any]]) -> int:
    """Return 16, 32 or 64: the layout whose lowest beam is nearest to the lowest elevation in the scan.

    The lowest beams meet the ground, so they return in almost every scene; the highest beams often see only
    sky.
    """
    if len(points) == 0:
        return 16
    lowest = float(np.percentile(elevation_deg(points), 0.5))
    return min(BEAMS_DEG, key=lambda beams: abs(BEAMS_DEG[beams][0] - lowest))


def elevation_deg(points: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """Return the elevation of each point above the sensor's x-y plane, (n,) deg."""
    xyz = points.astype(np.float32, copy=False)
    elevation = np.arctan2(xyz[:, 2], np.sqrt(xyz[:, 0] ** 2 + xyz[:, 1] ** 2))
    return np.degrees(elevation)


def _stored_ring_by_ring(turned: NDArray[np.float32]) -> bool:
    """Return whether an eighth of the points covers all azimuths, as whole rings do."""
    bins = ((turned[: max(len(turned) // 8, 1)] + np.float32(np.pi)) * np.float32(36.0 / (2 * np.pi))).astype(
        int
    )
    return np.unique(np.minimum(bins, 35)).size > 24


def _fraction_between_ends(turned: NDArray[np.float32]) -> NDArray[np.float32]:
    start = turned[0]
    end = turned[-1] + _TWO_PI
    if end - start > 1.5 * _TWO_PI:
        end -= _TWO_PI
    elif end - start < 0.5 * _TWO_PI:
        end += _TWO_PI
    # Points of the first half turn are unwrapped around the start, later ones around the end: near the seam
    # an azimuth fits both ends of the sweep, and only the place in the file separates them.
    first = turned + _TWO_PI * ((turned < start - 0.25 * _TWO_PI).astype(np.float32))
    first -= _TWO_PI * (turned > start + 0.75 * _TWO_PI).astype(np.float32)
    past_half = first - start > 0.5 * _TWO_PI
    boundary = int(np.argmax(past_half)) + 1 if past_half.any() else len(turned)
    later = turned[boundary:] + _TWO_PI
    too_low, too_high = later < end - 0.75 * _TWO_PI, later > end + 0.25 * _TWO_PI
    later += _TWO_PI * too_low.astype(np.float32) - _TWO_PI * too_high.astype(np.float32)
    return (np.concatenate([first[:boundary], later]) - start) / (end - start)
