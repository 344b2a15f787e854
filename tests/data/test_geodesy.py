import math

import numpy as np

from lio_jax.data.enu import geodetic_to_enu, mercator_positions


def test_positions_are_the_devkits() -> None:
    """The devkit's latlonToMercator, written out for two fixes."""
    fixes = [(49.011212804408, 8.4228850417969, 112.83), (49.0120, 8.4241, 113.5)]
    scale = math.cos(fixes[0][0] * math.pi / 180.0)
    er = 6378137
    expected = [
        (
            scale * longitude * math.pi * er / 180,
            scale * er * math.log(math.tan((90 + latitude) * math.pi / 360)),
            altitude,
        )
        for latitude, longitude, altitude in fixes
    ]
    np.testing.assert_allclose(mercator_positions(np.array(fixes)), expected, rtol=0, atol=1e-6)


def test_offsets_agree_with_the_ellipsoid_within_its_flattening() -> None:
    """Mercator here takes the earth as a sphere: up to 0.6 % off, no more."""
    fixes = np.array([[49.0, 8.4, 110.0], [49.001, 8.401, 112.0], [48.999, 8.402, 108.0]])
    offsets = mercator_positions(fixes) - mercator_positions(fixes)[0]
    enu = geodetic_to_enu(fixes, (49.0, 8.4, 110.0))
    np.testing.assert_allclose(offsets, enu, rtol=6e-3, atol=0.01)
