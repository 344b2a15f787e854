"""Smoothness against its formula in double precision; masks against loops over the points."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.lidar.picking import (
    occluded,
    parallel_to_beam,
    point_smoothness,
    range_smoothness,
    reach,
)


def by_formula(values: np.ndarray, neighbours: int) -> tuple[np.ndarray, np.ndarray]:
    """Return sum of neighbours - 2 n v along the first axis in float64, and the sum of absolute differences.

    Only for rows that have all neighbours.
    """
    values = values.astype(float)
    inner = values[neighbours : len(values) - neighbours]
    shifted = [
        values[neighbours + step : len(values) - neighbours + step]
        for step in range(-neighbours, neighbours + 1)
        if step
    ]
    return sum(shifted) - 2 * neighbours * inner, sum(np.abs(other - inner) for other in shifted)


def world(seed: int = 0, places: int = 400, rings: int = 5) -> np.ndarray:
    """Return points of walls, corners and steps along rings, (places, rings, 3) m, up to 120 m away."""
    rng = np.random.default_rng(seed)
    azimuth = np.linspace(0, 6, places)[:, None] + np.zeros(rings)
    distance = 40 + 35 * np.sign(np.sin(7 * azimuth)) + 40 * np.abs(np.cos(2 * azimuth))
    distance = distance + rng.normal(0, 0.02, distance.shape)
    height = distance * np.linspace(-0.3, 0.1, rings)
    return np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), height], -1).astype(np.float32)


@pytest.mark.parametrize("neighbours", [1, 5, 8])
def test_point_smoothness_is_the_squared_length_of_the_sum(neighbours):
    points = world()
    found = jax.jit(point_smoothness, static_argnums=1)(tuple(jnp.moveaxis(points, -1, 0)), neighbours)
    bend, size = by_formula(points, neighbours)
    inner = np.asarray(found, float)[neighbours:-neighbours]
    # each of the sums is rounded to 24 bits of its terms
    assert (np.abs(inner - (bend**2).sum(-1)) <= 3e-6 * (size**2).sum(-1)).all()
    assert found.dtype == jnp.float32


@pytest.mark.parametrize("neighbours", [1, 5, 8])
def test_range_smoothness_is_the_squared_sum(neighbours):
    ranges = np.linalg.norm(world(1), axis=-1)
    found = jax.jit(range_smoothness, static_argnums=1)(jnp.asarray(ranges), neighbours)
    bend, size = by_formula(ranges, neighbours)
    inner = np.asarray(found, float)[neighbours:-neighbours]
    assert (np.abs(inner - bend**2) <= 3e-6 * size**2).all()


def test_a_straight_line_of_even_steps_is_perfectly_smooth():
    steps = np.arange(40, dtype=np.float32)[:, None]
    xyz = (jnp.asarray(100 + 0.25 * steps), jnp.asarray(-0.5 * steps), jnp.asarray(0 * steps))
    assert not np.asarray(point_smoothness(xyz, 5))[5:-5].any()
    bent = (xyz[0] + jnp.maximum(steps - 20, 0), *xyz[1:])
    assert (np.asarray(point_smoothness(bent, 5))[16:25] > 0).all()


def ranges_with_steps(seed: int) -> dict[str, np.ndarray]:
    """Return ranges, columns with gaps and a mask along three rings, the last of them short."""
    rng = np.random.default_rng(seed)
    places = 200
    levels = np.repeat(rng.uniform(2, 60, (places // 8, 3)), 8, axis=0)
    ranges = levels + rng.choice([0.0, 0.0, 0.0, 0.2, 0.35, 2.0], levels.shape)
    column = np.cumsum(rng.choice([1, 1, 1, 1, 2, 9, 10, 11, 30], levels.shape), axis=0)
    mask = np.arange(places)[:, None] < np.array([places, places - 1, 37])
    return {
        "ranges": np.where(mask, ranges, 0).astype(np.float32),
        "column": np.where(mask, column, 0).astype(np.int32),
        "mask": mask,
    }


@pytest.mark.parametrize("seed", range(5))
def test_the_far_side_of_an_edge_is_hidden(seed):
    rings = ranges_with_steps(seed)
    found = jax.jit(partial(occluded, neighbours=5))(
        *map(jnp.asarray, rings.values()), step=jnp.float32(0.3), columns_apart=jnp.float32(10)
    )
    wanted = np.zeros(rings["mask"].shape, bool)
    for ring, count in enumerate(rings["mask"].sum(0)):
        r, column = rings["ranges"][:, ring], rings["column"][:, ring]
        for i in range(count - 1):
            if abs(int(column[i + 1]) - int(column[i])) < 10:
                if r[i] - r[i + 1] > np.float32(0.3):
                    wanted[max(i - 5, 0) : i + 1, ring] = True
                elif r[i + 1] - r[i] > np.float32(0.3):
                    wanted[i + 1 : i + 7, ring] = True
    np.testing.assert_array_equal(np.asarray(found)[rings["mask"]], wanted[rings["mask"]])
    assert 0.1 < wanted.mean() < 0.9


@pytest.mark.parametrize("seed", range(5))
def test_a_point_apart_from_both_neighbours_lies_along_the_beam(seed):
    rings = ranges_with_steps(seed)
    found = np.asarray(jax.jit(parallel_to_beam)(jnp.asarray(rings["ranges"]), jnp.float32(0.02)))
    for ring, count in enumerate(rings["mask"].sum(0)):
        r = rings["ranges"][:, ring]
        for i in range(1, count - 1):
            limit = np.float32(0.02) * r[i]
            assert found[i, ring] == (abs(r[i - 1] - r[i]) > limit and abs(r[i + 1] - r[i]) > limit)


def test_a_smooth_wall_is_neither_hidden_nor_along_the_beam():
    azimuth = np.linspace(-0.7, 0.7, 300)[:, None]
    ranges = jnp.asarray(8 / np.cos(azimuth), jnp.float32)
    column, mask = jnp.arange(300, dtype=jnp.int32)[:, None], jnp.ones((300, 1), bool)
    hidden = occluded(
        ranges, column, mask, step=jnp.float32(0.3), columns_apart=jnp.float32(10), neighbours=5
    )
    assert not np.asarray(hidden).any()
    assert not np.asarray(parallel_to_beam(ranges, jnp.float32(0.02)))[1:-1].any()


@pytest.mark.parametrize("neighbours", [1, 5, 7])
def test_reach_counts_points_up_to_the_first_gap(neighbours):
    connected = np.random.default_rng(neighbours).uniform(size=(90, 4)) < 0.8
    connected[-1] = False
    before, after = reach(jnp.asarray(connected), neighbours)
    for ring in range(4):
        for i in range(90):
            ahead = behind = 0
            while ahead < neighbours and connected[i + ahead, ring]:
                ahead += 1
            while behind < neighbours and i - behind > 0 and connected[i - behind - 1, ring]:
                behind += 1
            assert (before[i, ring], after[i, ring]) == (behind, ahead)
