"""Values that follow from how near a recording's surroundings are."""

import numpy as np

from lio_jax.core.settings import Settings
from lio_jax.data.sequence import Sequence

_NEAR_M, _SHARE = 10.0, 90
"""Range within which that percentage of the points lies where the surroundings are near: rooms, corridors and
stairs. On open ground the many returns next to a low sensor do not reach it."""
_LOOKED_AT = 3
"""Scans of which the first with points decides."""
_OWN_BODY_M = 0.3
"""Nearer returns are of whoever carries the sensor."""
NEAR_VALUES = {
    "params.lidar.min_range": 0.5,
    "params.map.voxel_size": 0.4,
    "params.map.point_spacing": 0.1,
    "params.registration.point_spacing": 0.2,
    "params.registration.inertial_point_spacing": 0.2,
}
_TOGETHER = {path for path in NEAR_VALUES if path != "params.lidar.min_range"}
"""Of the recipe ``default``. With its values for streets, voxels hold more than one wall: on 20 s of walking
in a simulated office the trajectory's error was 32 mm instead of 7 mm."""


def fitted_to_surroundings(sequence: Sequence, settings: Settings) -> tuple[Settings, list[str]]:
    """Return settings with finer voxels where the surroundings are near, unless they were given; say so.

    Voxels and spacings go together: where one of them was given, none is changed.
    """
    given = settings.given | (_TOGETHER if settings.given & _TOGETHER else set())
    free = [path for path in NEAR_VALUES if path not in given]
    if settings.recipe != "default" or not free:
        return settings, []
    reach = _reach(sequence)
    if reach is None or reach >= _NEAR_M:
        return settings, []
    reason = f"surroundings are near ({_SHARE} % of the points within {reach:.1f} m)"
    for path in free:
        settings = settings.with_value(path, NEAR_VALUES[path], reason)
    chosen = ", ".join(f"{path.removeprefix('params.')} {NEAR_VALUES[path]:g}" for path in free)
    return settings, [f"{reason}: {chosen} m; for a street's values give params.map.voxel_size=1.2."]


def _reach(sequence: Sequence) -> float | None:
    """Return the range within which most points of the first scan that has any lie, m."""
    for scan in sequence.scans(0, _LOOKED_AT):
        ranges = np.linalg.norm(scan.points, axis=1)
        ranges = ranges[np.isfinite(ranges) & (ranges > _OWN_BODY_M)]
        if len(ranges):
            return float(np.percentile(ranges, _SHARE))
    return None
