"""The derivative of what a map holds by the points inserted, forgotten and replaced ones included."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.mapping import point_map
from lio_jax.mapping.voxel_map import FREE, empty_map, insert
from lio_jax.mapping.voxel_tangents import following

SIZE, REACH = jnp.float64(1.0), jnp.float64(40.0)
RNG = np.random.default_rng(3)


class Moved(eqx.Module):
    """Points that move with a few parameters."""

    points: jax.Array
    directions: jax.Array
    parameters: jax.Array

    def __call__(self, rows):
        return (self.points + jnp.tensordot(self.parameters, self.directions, 1))[rows]


def drive(parameters, clouds, anchors, capacity):
    """Return the map after the clouds, each of which moves with the parameters."""
    vmap = empty_map(capacity, jnp.float64)
    for (points, directions), anchor in zip(clouds, anchors, strict=True):
        again = Moved(points, directions, parameters)
        placed = jax.lax.stop_gradient(again(jnp.arange(len(points))))
        mask = jnp.arange(len(points)) % 10 != 0
        after, added = insert(vmap, placed, mask, anchor, SIZE, REACH)
        vmap = following(after, vmap, added.added, placed, mask, again, anchor, SIZE)
    return vmap


def cloud(count):
    return jnp.asarray(RNG.uniform(-6, 6, (count, 3))), jnp.asarray(RNG.normal(size=(2, count, 3)))


# 1500 points take more than one chunk; the last anchor is out of the first one's reach, and the table is so
# small that voxels are overwritten
CLOUDS = [cloud(1500), cloud(700), cloud(900)]
ANCHORS = [jnp.asarray(anchor, jnp.int32) for anchor in ([0, 0, 0], [1, 0, 0], [200, 3, 0])]


def assert_reverse_agrees(function, at, slope, known):
    """Assert that the derivative of a weighted sum, by reverse mode, is the sum of the weighted slopes."""
    weights = jnp.where(known, RNG.normal(size=known.shape), 0.0)
    (backward,) = jax.vjp(function, at)[1](weights)
    expected = np.tensordot(weights, np.where(known[..., None], slope, 0.0), weights.ndim)
    np.testing.assert_allclose(backward, expected, rtol=1e-9)


@pytest.mark.long
def test_the_moments_follow_the_points():
    def moments(parameters):
        return drive(parameters, CLOUDS, ANCHORS, 2048).moments

    at = jnp.asarray([0.01, -0.02])
    slope = jax.jacfwd(moments)(at)
    assert_reverse_agrees(moments, at, slope, np.ones(slope.shape[:-1], bool))
    first, last = (drive(at, CLOUDS[:end], ANCHORS[:end], 2048) for end in (2, 3))
    forgotten = (first.voxel[:, 0] != FREE) & (first.voxel != last.voxel).any(1)
    assert forgotten.sum() > 100
    for component in range(2):
        step = 1e-8 * np.eye(2)[component]
        difference = (moments(at + step) - moments(at - step)) / 2e-8
        np.testing.assert_allclose(slope[..., component], difference, atol=1e-5)


def test_nothing_added_changes_nothing():
    points, directions = cloud(50)
    vmap = empty_map(256, jnp.float64)
    nothing = jnp.zeros(50, bool)

    def moments(parameters):
        again = Moved(points, directions, parameters)
        return following(vmap, vmap, nothing, points, nothing, again, ANCHORS[0], SIZE).moments

    np.testing.assert_array_equal(jax.jacfwd(moments)(jnp.zeros(2)), 0.0)


def point_drive(parameters, clouds, anchors, capacity):
    """Return the map of points after the clouds, its cube moved to each anchor."""
    pmap, half, margin = point_map.empty_map(capacity, jnp.float64), jnp.float64(5.0), jnp.float64(3.0)
    for (points, directions), anchor in zip(clouds, anchors, strict=True):
        moving = Moved(points, directions, parameters)(jnp.arange(len(points)))
        mask = jnp.arange(len(points)) % 10 != 0
        inserted, found = point_map.insert(pmap, moving, mask, anchor, SIZE, half, jnp.float64(0.01))
        cleared = point_map.move_cube(inserted, anchor, half, margin)
        pmap = point_map.following(cleared, pmap, inserted, found.added, moving, anchor, SIZE)
    return pmap


def test_the_points_of_a_map_follow():
    anchors = [jnp.asarray(anchor, jnp.int32) for anchor in ([0, 0, 0], [1, 0, 0], [4, 0, 0])]

    def held(parameters, count=3):
        return point_drive(parameters, CLOUDS[:count], anchors[:count], 512).point

    at = jnp.asarray([0.01, -0.02])
    slope, last = jax.jacfwd(held)(at), np.asarray(held(at))
    known = np.isfinite(last)
    assert_reverse_agrees(held, at, slope, known)
    before = np.asarray(held(at, 2))
    assert (np.isfinite(before) & known & (before != last)).sum() > 50, "points are replaced"
    assert (np.isfinite(before) & ~known).sum() > 100, "points are left behind"
    for component in range(2):
        step = 1e-8 * np.eye(2)[component]
        difference = (held(at + step)[known] - held(at - step)[known]) / 2e-8
        np.testing.assert_allclose(slope[..., component][known], difference, atol=1e-5)
