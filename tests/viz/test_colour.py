import numpy as np

from lio_jax.viz.recording import colour_by_height


def channels(packed):
    return np.stack([(packed >> shift) & 255 for shift in (24, 16, 8, 0)], axis=1)


def test_ends_are_dark_blue_and_yellow_and_opaque():
    colours = channels(colour_by_height(np.array([-9.0, 0.0, 10.0, 99.0]), 0.0, 10.0))
    np.testing.assert_array_equal(colours[[0, 1]], [[68, 1, 84, 255]] * 2)
    np.testing.assert_array_equal(colours[[2, 3]], [[253, 231, 37, 255]] * 2)


def test_lightness_rises_with_height():
    colours = channels(colour_by_height(np.linspace(0.0, 1.0, 100), 0.0, 1.0))
    lightness = colours[:, :3] @ np.array([0.2126, 0.7152, 0.0722])
    assert np.all(np.diff(lightness) > 0)


def test_flat_cloud_has_one_colour():
    assert len(np.unique(colour_by_height(np.zeros(5), 0.0, 0.0))) == 1
