"""The part of a world near a position: nothing within its reach is left out."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from lio_jax.sim.worlds import Counts, counts_along, nearest_part
from tests.sim.casting import HILLS, cast_into, world_of


@partial(jax.jit, static_argnames="counts")
def _reach(world, position, counts):
    return nearest_part(world, position, jnp.zeros(()), counts)[1]


def test_leaving_far_primitives_out_changes_nothing_within_reach():
    rng = np.random.default_rng(1)
    place = rng.uniform(-60, 60, (160, 2))
    flat, ones = np.zeros(60), np.ones((60, 3))
    world = world_of(
        jnp.float64,
        boxes=np.column_stack([place[:60], flat, ones, flat]),
        cylinders=np.column_stack([place[60:110], -ones[:50, 0], ones[:50, 0], 2 * ones[:50, 0]]),
        spheres=np.column_stack([place[110:135], flat[:25], ones[:25, 0]]),
        tilted=np.column_stack([place[135:], flat[:25], ones[:25], rng.uniform(-3, 3, (25, 3))]),
        ground=HILLS,
        moving=[[1, 1, 1, 30, 0, 0, 3, 0, 0]],
    )
    position = jnp.array([10.0, -5.0, 0.5])
    azimuth = np.linspace(0, 2 * np.pi, 720)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), 0.01 * np.sin(7 * azimuth)], axis=1)
    whole = np.asarray(cast_into(world, position, directions).distance)
    counts = Counts(boxes=20, tilted=10, cylinders=20, spheres=10)
    reach = _reach(world, position, counts)
    near = np.asarray(cast_into(world, [0, 0, 0], directions, position=position, counts=counts).distance)
    assert 20 < reach < 60
    np.testing.assert_allclose(np.where(whole < reach, whole, 0), np.where(near < reach, near, 0), atol=1e-9)


def test_counts_along_cover_the_radius_everywhere():
    rng = np.random.default_rng(3)
    rows = np.column_stack([rng.uniform(-60, 60, (80, 2)), np.zeros(80), np.ones((80, 3)), np.zeros(80)])
    world = world_of(jnp.float64, boxes=rows, spheres=np.column_stack([rows[:40, 1::-1], np.ones((40, 2))]))
    positions = jnp.asarray(rng.uniform(-40, 40, (12, 3)))
    counts = counts_along(world, positions, 25.0)
    assert 0 < counts.boxes < 80
    assert 0 < counts.spheres < 40
    assert counts.cylinders == counts.tilted == 0
    for position in positions:
        assert _reach(world, position, counts) >= 25.0
