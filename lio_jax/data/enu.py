"""Positions on the earth as local east, north and up coordinates."""

import numpy as np
from numpy.typing import NDArray

MERCATOR_RADIUS = 6_378_137.0
"""Earth radius that the devkit's convertOxtsToPose uses, m."""


def mercator_positions(geodetic: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (n, 3) east, north, up in m by the devkit's Mercator projection.

    x = s r pi lon / 180, y = s r ln tan(pi (90 + lat) / 360), z = alt, with s = cos(pi lat_0 / 180) of the
    first fix. The positions are not relative to any origin.

    Args:
        geodetic: (n, 3) latitude deg, longitude deg, altitude m.
    """
    latitude, longitude = np.radians(geodetic[:, 0]), np.radians(geodetic[:, 1])
    radius = np.cos(latitude[0]) * MERCATOR_RADIUS
    return np.stack(
        [radius * longitude, radius * np.log(np.tan(np.pi / 4 + latitude / 2)), geodetic[:, 2]], axis=1
    )


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
    offset = geodetic_to_ecef(geodetic) - geodetic_to_ecef(np.array([origin]))
    return offset @ _axes(origin)


def enu_to_geodetic(position: NDArray[np.float64], origin: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return (n, 3) latitude deg, longitude deg, height m of local positions.

    This is the inverse of :func:`geodetic_to_enu`, away from the poles. The latitude comes from a fixed-point
    iteration, which gains more than two digits in each round.

    Args:
        position: (n, 3) east, north, up in m from ``origin``.
        origin: latitude deg, longitude deg, height m of the frame's origin.
    """
    x, y, z = (geodetic_to_ecef(np.array([origin])) + position @ _axes(origin).T).T
    level = np.hypot(x, y)
    latitude = np.arctan2(z, level * (1.0 - _ECCENTRICITY_SQUARED))
    for _ in range(8):
        sine = np.sin(latitude)
        prime_vertical = _SEMI_MAJOR / np.sqrt(1.0 - _ECCENTRICITY_SQUARED * sine**2)
        latitude = np.arctan2(z + _ECCENTRICITY_SQUARED * prime_vertical * sine, level)
    height = level / np.cos(latitude) - _SEMI_MAJOR / np.sqrt(
        1.0 - _ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    )
    return np.stack([np.degrees(latitude), np.degrees(np.arctan2(y, x)), height], axis=1)


def _axes(origin: tuple[float, float, float]) -> NDArray[np.float64]:
    """Return the unit vectors east, north and up at ``origin``, earth-centred, as the columns of a matrix."""
    latitude, longitude = np.radians(origin[:2])
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    return np.stack([east, np.cross(up, east), up], axis=1)
