"""The elevations of a scan confirm or contradict the number of beams that is assumed."""

import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.data.reconstruct import check_beams, elevation_levels

LAYOUTS = {
    "VLP-16": np.arange(-15.0, 15.1, 2.0),
    "HDL-32E": np.arange(32) * 4 / 3 - 92 / 3,
    "HDL-64E": np.concatenate([2.0 - np.arange(32) / 3, -8.83 - np.arange(32) / 2]),
    "of 8": np.linspace(-10.0, 10.0, 8),
    "of 128": np.linspace(-22.5, 22.5, 128),
}


def scan(layout: str, columns: int = 400, jitter_deg: float = 0.0) -> np.ndarray:
    """Return points at random ranges along the beams."""
    rng = np.random.default_rng(0)
    elevation, azimuth = np.meshgrid(np.deg2rad(LAYOUTS[layout]), np.linspace(-3.1, 3.1, columns))
    elevation = elevation + np.deg2rad(rng.normal(0, jitter_deg, elevation.shape))
    distance = rng.uniform(3, 60, elevation.shape)
    level = distance * np.cos(elevation)
    points = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)], -1)
    return points.reshape(-1, 3).astype(np.float32)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_levels_are_the_beams(layout):
    levels = elevation_levels(scan(layout, jitter_deg=0.01))
    np.testing.assert_allclose(levels, np.sort(LAYOUTS[layout]), atol=0.08)


def test_no_points_have_no_levels_and_say_nothing():
    nothing = np.zeros((0, 3), np.float32)
    assert len(elevation_levels(nothing)) == 0
    assert check_beams(nothing, 16, True, "bag") == ()


@pytest.mark.parametrize(("layout", "beams"), [("VLP-16", 16), ("HDL-32E", 32), ("HDL-64E", 64)])
def test_the_right_number_of_beams_gives_no_message(layout, beams):
    assert check_beams(scan(layout), beams, True, "bag") == ()
    # the highest beams see only sky
    seen = scan(layout)
    assert check_beams(seen[seen[:, 2] < 0], beams, True, "bag") == ()


@pytest.mark.parametrize(
    ("layout", "beams", "right"),
    [("VLP-16", 64, 16), ("HDL-32E", 16, 32), ("HDL-32E", 64, 32), ("HDL-64E", 16, 64), ("HDL-64E", 32, 64)],
)
def test_a_wrong_number_is_refused_with_what_the_elevations_suggest(layout, beams, right):
    with pytest.raises(UsageError, match=rf"^bag: config.data.beams={beams} .* in {right} levels, suggest "):
        check_beams(scan(layout), beams, True, "bag")
    (sentence,) = check_beams(scan(layout), beams, False, "bag")
    assert sentence.endswith(f"suggest config.data.beams={right}")


@pytest.mark.parametrize(("layout", "beams"), [("of 8", 64), ("of 128", 64), ("of 128", 32)])
def test_a_sensor_without_a_known_layout_is_called_so(layout, beams):
    (sentence,) = check_beams(scan(layout), beams, False, "bag")
    assert f"a sensor of about {len(LAYOUTS[layout])} beams whose layout is not known" in sentence
    assert "record the field ring" in sentence
