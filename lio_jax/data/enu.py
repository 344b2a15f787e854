"""Geodetic coordinates to a local east-north-up frame, through earth-centred coordinates (WGS 84)."""

import numpy as np
from numpy.typing import NDArray

_SEMI_MAJOR = 6_378_137.0
_FLATTENING = 1.0 / 298.257223563
_ECCENTRICITY_SQUARED = _FLATTENING * (2.0 - _FLATTENING)


def geodetic_to_ecef(geodetic: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 3) earth-centred earth-fixed positions in m.

    Args:
        geodetic: (n, 3) latitude deg, longitude deg, height above the ellipsoid m.
    """
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    height = geodetic[:, 2]
    prime_vertical = _SEMI_MAJOR / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    return np.stack(
        [
            (prime_vertical + height) * np.cos(latitude) * np.cos(longitude),
            (prime_vertical + height) * np.cos(latitude) * np.sin(longitude),
            (prime_vertical * (1.0 - _ECCENTRICITY_SQUARED) + height) * np.sin(latitude),
        ],
        axis=1,
    )


def geodetic_to_enu(geodetic: NDArray[np.float64], origin: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return (n, 3) east, north, up in m from ``origin``.

    Args:
        geodetic: (n, 3) latitude deg, longitude deg, height m.
        origin: latitude deg, longitude deg, height m of the frame's origin.
    """
    latitude, longitude = np.radians(origin[:2])
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    offset = geodetic_to_ecef(geodetic) - geodetic_to_ecef(np.array([origin]))
    return offset @ np.stack([east, np.cross(up, east), up], axis=1)
