"""Local east-north-up against published values and the ellipsoid's own geometry."""

import numpy as np
import pytest

from lio_jax.data.enu import enu_to_geodetic, geodetic_to_ecef, geodetic_to_enu


def test_earth_centred_positions() -> None:
    # The point at 42 deg, -82 deg, 200 m is the one of pymap3d's tests.
    points = np.array([[0.0, 0.0, 0.0], [0.0, 90.0, 10.0], [90.0, 0.0, 0.0], [42.0, -82.0, 200.0]])
    expected = [
        [6378137.0, 0.0, 0.0],
        [0.0, 6378147.0, 0.0],
        [0.0, 0.0, 6356752.314245],
        [660675.2518247, -4700948.68316, 4245737.66222],
    ]
    np.testing.assert_allclose(geodetic_to_ecef(points), expected, atol=1e-3)


def test_a_target_at_known_azimuth_elevation_and_range() -> None:
    # 1000 m away at azimuth 33 deg, elevation 70 deg (same source); its coordinates are given to 1e-6 deg.
    target = np.array([[42.002582, -81.997752, 1139.7]])
    azimuth, elevation = np.radians([33.0, 70.0])
    expected = 1000.0 * np.array(
        [np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth), np.sin(elevation)]
    )
    np.testing.assert_allclose(geodetic_to_enu(target, (42.0, -82.0, 200.0))[0], expected, atol=0.15)


@pytest.mark.parametrize("latitude", [-60.0, 0.0, 49.0])
def test_small_steps_follow_the_radii_of_curvature(latitude: float) -> None:
    a, e2 = 6378137.0, 0.00669437999014
    sine = np.sin(np.radians(latitude))
    meridian, normal = a * (1 - e2) / (1 - e2 * sine**2) ** 1.5, a / np.sqrt(1 - e2 * sine**2)
    step = 1e-5
    origin = (latitude, 8.0, 120.0)
    moved = np.array([[latitude + step, 8.0, 120.0], [latitude, 8.0 + step, 120.0], [latitude, 8.0, 121.0]])
    enu = geodetic_to_enu(moved, origin)
    north = (meridian + 120.0) * np.radians(step)
    east = (normal + 120.0) * np.cos(np.radians(latitude)) * np.radians(step)
    np.testing.assert_allclose(enu, [[0, north, 0], [east, 0, 0], [0, 0, 1]], atol=1e-5)


def test_nothing_is_lost_over_fifty_kilometres() -> None:
    """Distances are those between earth-centred positions, and the way back leads to the same place."""
    random = np.random.default_rng(1)
    for _ in range(20):
        origin = (random.uniform(-85, 85), random.uniform(-180, 180), random.uniform(-100, 3000))
        position = random.uniform(-1, 1, (50, 3)) * [50e3, 50e3, 2e3]
        geodetic = enu_to_geodetic(position, origin)
        np.testing.assert_allclose(geodetic_to_enu(geodetic, origin), position, atol=1e-7)
        apart = np.linalg.norm(np.diff(geodetic_to_ecef(geodetic), axis=0), axis=1)
        np.testing.assert_allclose(apart, np.linalg.norm(np.diff(position, axis=0), axis=1), atol=1e-7)


def test_geodetic_round_trip_over_the_globe() -> None:
    random = np.random.default_rng(0)
    for _ in range(50):
        origin = (random.uniform(-89, 89), random.uniform(-180, 180), random.uniform(-100, 5000))
        position = random.normal(size=(8, 3)) * [5000, 5000, 500]
        back = geodetic_to_enu(enu_to_geodetic(position, origin), origin)
        np.testing.assert_allclose(back, position, atol=1e-6)
