"""The plan view follows what stands upright, and not the scan lines on the ground."""

import numpy as np
import pytest

from lio_jax.lidar.plan_view import displacement, plan_view, refined, turn

REACH = 4.5


def ground(height=1.7):
    """Return the scan lines of a turning sensor on flat ground: the same wherever the sensor is."""
    radius, angle = np.meshgrid(np.arange(4.0, 40.0, 0.8), np.linspace(0, 2 * np.pi, 720, endpoint=False))
    rings = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full_like(radius, -height)], axis=-1)
    return rings.reshape(-1, 3)


def poles(seed, count=60):
    rng = np.random.default_rng(seed)
    return rng.uniform(-40, 40, (count, 2))


def seen(places, at):
    """Return what a sensor sees of poles of 3 m height, and of the ground."""
    height = np.linspace(-1.5, 1.5, 7)
    level = (places - at).repeat(len(height), axis=0)
    upright = np.column_stack([level, np.tile(height, len(places))])
    return np.concatenate([upright, ground()]).astype(np.float32)


@pytest.mark.parametrize("moved", [(0.0, 0.0), (1.8, 0.1), (-0.6, 3.4), (3.5, -2.0)])
def test_the_displacement_is_that_of_the_poles(moved):
    places = poles(1)
    first, second = plan_view(seen(places, (0, 0))), plan_view(seen(places, moved))
    found = displacement(first, second.centers, REACH)
    assert found.is_certain
    np.testing.assert_allclose(found.shift, moved, atol=0.3)
    np.testing.assert_allclose(refined(first, second.points, found.shift), moved, atol=0.03)


def test_ground_alone_shows_no_displacement():
    view = plan_view(ground().astype(np.float32))
    assert len(view.centers) == 0
    assert not displacement(view, view.centers, REACH).is_certain


def test_a_wall_along_the_way_shows_no_displacement():
    along, height = np.meshgrid(np.arange(-60, 60, 0.1), np.linspace(-1, 2, 7))
    wall = np.stack([along, np.full_like(along, 6.0), height], axis=-1).reshape(-1, 3).astype(np.float32)
    view = plan_view(wall)
    assert len(view.centers) > 100
    assert not displacement(view, view.centers, REACH).is_certain


def test_a_dozen_poles_suffice():
    places = poles(3, 12)
    first, second = plan_view(seen(places, (0, 0))), plan_view(seen(places, (0.5, 0.0)))
    found = displacement(first, second.centers, REACH)
    assert found.is_certain
    np.testing.assert_allclose(refined(first, second.points, found.shift), [0.5, 0.0], atol=0.03)


def test_different_poles_show_no_displacement():
    for seed in range(20):
        first, second = (plan_view(seen(poles(one), (0, 0))) for one in (seed, seed + 100))
        assert not displacement(first, second.centers, REACH).is_certain


def test_a_view_is_turned_about_the_vertical():
    angle = 0.3
    places = poles(2)
    first = plan_view(seen(places, (0, 0)))
    back = plan_view(seen(places @ turn(-angle), (0, 0)))
    found = displacement(first, back.centers @ turn(angle), REACH)
    assert found.is_certain
    np.testing.assert_allclose(refined(first, back.points @ turn(angle), found.shift), 0.0, atol=0.05)


def test_an_empty_scan_has_an_empty_view():
    assert not plan_view(np.zeros((0, 3), np.float32)).occupied.any()


def test_far_poles_behind_a_long_way_are_met():
    # the grid has room for the longest displacement of the farthest point, and for its correction
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    places = 59.9 * np.column_stack([np.cos(angle), np.sin(angle)])
    first = plan_view(seen(places, (-20, 0)))
    second = plan_view(seen(places, (0, 0)))
    assert np.isfinite(refined(first, second.points, np.array([20.0, 0.0]))).all()
