"""Whether a scan's elevations fit the beams it is said to have, and what they suggest instead."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import UsageError
from lio_jax.data.reconstruct import BEAMS_DEG, elevation_deg

_BIN_DEG = 0.05
_FEW = 0.1
"""Share of a typical level's points below which a bin of the histogram counts as empty."""
_MARGIN_DEG = 1.0
"""By so much points may lie beyond the outermost beams."""
_DOUBTFUL, _WRONG = 0.05, 0.25
"""Shares of points beyond them."""
_MANY, _TOO_MANY = 1.25, 1.5
"""Levels seen per beam: noise may split a few."""


def elevation_levels(points: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Return the elevations at which the points crowd, ascending, deg: one for each beam that spins.

    Levels are the runs of well-filled bins of 0.05 deg of the elevations' histogram, so that beams less than
    0.1 deg apart count as one.

    Args:
        points: (n, 3) m, lidar frame, not motion compensated.
    """
    elevation = elevation_deg(points)
    if not len(elevation):
        return np.zeros(0)
    low = float(elevation.min())
    counts = np.bincount(((elevation - low) / _BIN_DEG).astype(np.intp))
    # half of all points lie in bins that are at least this full
    ordered = np.sort(counts)[::-1]
    typical = ordered[np.searchsorted(np.cumsum(ordered), 0.5 * counts.sum())]
    full = np.concatenate([[False], counts > _FEW * typical, [False]])
    starts, ends = np.flatnonzero(~full[:-1] & full[1:]), np.flatnonzero(full[:-1] & ~full[1:])
    return low + _BIN_DEG * (starts + ends) / 2


def check_beams(points: NDArray[np.floating[Any]], beams: int, given: bool, where: str) -> tuple[str, ...]:
    """Return a sentence if the points do not fit the beams that their rings are reconstructed for.

    Args:
        points: (n, 3) m, lidar frame, of one scan.
        beams: 16, 32 or 64.
        given: by the settings, else guessed.
        where: recording and topic, for the error.

    Raises:
        UsageError: the beams were given, and are not those of the sensor.
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
