"""The Mercator projection in which KITTI's devkit states ground truth."""

import numpy as np
from numpy.typing import NDArray

MERCATOR_RADIUS = 6_378_137.0
"""Earth radius of the devkit's convertOxtsToPose, m."""


def mercator_positions(geodetic: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 3) east, north, up in m by the devkit's Mercator projection.

    x = s r pi lon / 180, y = s r ln tan(pi (90 + lat) / 360), z = alt, with s = cos(pi lat_0 / 180) of the
    first fix; not relative to any origin.

    Args:
        geodetic: (n, 3) latitude deg, longitude deg, altitude m.
    """
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    radius = np.cos(latitude[0]) * MERCATOR_RADIUS
    return np.stack(
        [radius * longitude, radius * np.log(np.tan(np.pi / 4 + latitude / 2)), geodetic[:, 2]], axis=1
    )
