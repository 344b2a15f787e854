"""Rays that barely meet or miss a surface: float32 cannot decide, yet every range is exact."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.sim.casting import cast_into, world_of

RAYS = 40_000
"""So many that solids are searched for in float32."""


def _brushing(edge):
    """Return offsets (RAYS,) on both sides of ``edge`` m, from 1e-5 down to 1e-10 m off it."""
    gap = np.geomspace(1e-5, 1e-10, RAYS // 2)
    return edge + np.concatenate([gap, -gap])


def _ahead(world, aside, height=0.0):
    """Return the hits of rays along +x that start at y = ``aside``."""
    origins = np.stack([0 * aside, aside, 0 * aside + height], axis=1)
    return cast_into(world, origins, np.tile([1.0, 0.0, 0.0], (len(aside), 1)))


# by the kind: the rows of one that ends at y = 0.3 m, and of a larger one behind that is met at x = 60 m
ROWS = {
    "boxes": ([40, 0, 0, 5, 0.3, 1, 0], [65, 0, 0, 5, 9, 9, 0]),
    "tilted": ([40, 0, 0, 5, 0.3, 1, 0, 0, 0], [65, 0, 0, 5, 9, 9, 0, 0, 0]),
    "moving": ([5, 0.3, 1, 40, 0, 0, 0, 0, 0], [5, 9, 9, 65, 0, 0, 0, 0, 0]),
    "cylinders": ([40, 0, -2, 0.3, 4], [10060, 0, -2, 10000, 4]),
    "spheres": ([40, 0, 0, 0.3], [10060, 0, 0, 10000]),
}


@pytest.mark.parametrize("kind", ROWS)
def test_a_solid_ends_exactly_where_it_ends_and_what_is_behind_is_seen_past_it(kind):
    near, behind = ROWS[kind]
    aside = _brushing(0.3)
    hit = _ahead(world_of(jnp.float64, **{kind: [behind, near, near]}), aside)
    round_ = len(near) < 7
    wall = 40 - np.sqrt(np.maximum(0.3**2 - aside**2, 0)) if round_ else 35
    beyond = 10060 - np.sqrt(1e8 - aside**2) if round_ else 60
    np.testing.assert_allclose(hit.distance, np.where(aside < 0.3, wall, beyond), atol=1e-6)


@pytest.mark.parametrize(
    ("rows", "reflectivity"),
    [({"cylinders": [[40, 0, -2, 0.3, 4]]}, 0.3), ({"spheres": [[40, 0, 0, 0.3]]}, 0.6)],
)
def test_a_brushed_pole_or_ball_is_met_at_its_closed_form(rows, reflectivity):
    # half of the rays pass it by and meet the wall behind
    aside = _brushing(0.3)
    hit = _ahead(world_of(jnp.float64, boxes=[[65, 0, 0, 5, 9, 9, 0]], **rows), aside)
    met = aside < 0.3
    closed = 40 - np.sqrt(np.maximum(0.3**2 - aside**2, 0))
    np.testing.assert_allclose(hit.distance, np.where(met, closed, 60), atol=1e-7)
    np.testing.assert_array_equal(hit.reflectivity, np.where(met, reflectivity, 0.2))


@pytest.mark.parametrize("kind", ["planes", "boxes", "tilted"])
def test_a_wall_is_met_at_its_closed_form_however_flat(kind):
    # a wall on the left, 2 m away, met at up to 0.01 degrees
    rows = {
        "planes": [[0, 2, 0, 0, -1, 0]],
        "boxes": [[0, 7, 0, 90000, 5, 90000, 0], [0, -9, 0, 1, 1, 1, 0]],
        "tilted": [[0, 7, 0, 90000, 5, 90000, 0, 0, 0], [0, -9, 0, 1, 1, 1, 0, 0, 0]],
    }
    angle = np.deg2rad(np.geomspace(0.01, 90, RAYS))
    directions = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    hit = cast_into(world_of(jnp.float64, **{kind: rows[kind]}), [0, 0, 0], directions)
    np.testing.assert_allclose(hit.distance, 2 / np.sin(angle), rtol=1e-11)
