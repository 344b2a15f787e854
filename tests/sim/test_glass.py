"""Panes of glass: rays pass, are mirrored, meet the pane head-on, or never come back."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.sim.assembly import assembled
from lio_jax.sim.glass import seen_through
from lio_jax.sim.raycast import cast
from lio_jax.sim.worlds import Counts, nearest_part

RAYS = 4000


def reported(mirror, missing, slant):
    """Return distances of rays from the origin to a pane at x = 4 m and walls at x = 10 m and x = -3 m.

    The rays are turned by ``slant`` rad from the pane's normal.
    """
    with jax.enable_x64(True):
        walls = [[10.0, 0, 0, -1, 0, 0, 0.5], [-3.0, 0, 0, 1, 0, 0, 0.5]]
        world = assembled(np.zeros(3), planes=walls, glass=[[4, 0, 0, 0, 30, 0, 0, 0, 30, mirror, missing]])
        part, _ = nearest_part(world, jnp.zeros(3), jnp.float64(0.0), Counts(0, 0, 0, 0))
        origins = jnp.zeros((RAYS, 3))
        rays = jnp.tile(jnp.array([np.cos(slant), np.sin(slant), 0.0]), (RAYS, 1))
        met = partial(cast, part, time=jnp.zeros(RAYS))
        hit = seen_through(part.glass, met, origins, rays, met(origins, rays), jax.random.key(1))
        return np.asarray(hit.distance), np.asarray(-jnp.sum(hit.normal * rays, axis=1))


def test_a_ray_meets_what_is_behind_the_pane_or_the_mirror_image_of_what_is_before_it():
    slant = np.deg2rad(40)
    distance, cosine = reported(mirror=0.3, missing=0.0, slant=slant)
    # the mirror image of the wall at -3 m lies 4 + 4 + 3 m ahead
    behind, image = 10 / np.cos(slant), 11 / np.cos(slant)
    mirrored = np.isclose(distance, image, atol=1e-5)
    assert np.all(mirrored | np.isclose(distance, behind, atol=1e-9))
    # Schlick's approximation of Fresnel's equations
    share = 0.3 + 0.7 * (1 - np.cos(slant)) ** 5
    assert mirrored.mean() == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / RAYS))
    np.testing.assert_allclose(cosine, np.cos(slant), atol=1e-6)


def test_a_share_of_the_rays_never_comes_back():
    distance, _ = reported(mirror=0.0, missing=0.25, slant=np.deg2rad(20))
    assert np.isinf(distance).mean() == pytest.approx(0.25, abs=0.03)


def test_a_pane_that_is_met_head_on_answers_itself():
    distance, cosine = reported(mirror=0.1, missing=0.5, slant=np.deg2rad(1))
    np.testing.assert_allclose(distance, 4 / np.cos(np.deg2rad(1)))
    assert np.all(cosine > 0.99)


def test_what_stands_before_a_pane_hides_it():
    with jax.enable_x64(True):
        glass = [[4, 0, 0, 0, 30, 0, 0, 0, 30, 0.5, 0.5]]
        world = assembled(np.zeros(3), planes=[[2.0, 0, 0, -1, 0, 0, 0.5]], glass=glass)
        part, _ = nearest_part(world, jnp.zeros(3), jnp.float64(0.0), Counts(0, 0, 0, 0))
        rays = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (100, 1))
        met = partial(cast, part, time=jnp.zeros(100))
        direct = met(jnp.zeros((100, 3)), rays)
        hit = seen_through(part.glass, met, jnp.zeros((100, 3)), rays, direct, jax.random.key(0))
        np.testing.assert_array_equal(hit.distance, 2.0)
