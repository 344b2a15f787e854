"""The selection on all rings at once against the sequential rule, place by place."""

from functools import partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.lidar.picking import Ring, pick, reach, sector_bounds
from tests.lidar.sequential import A_LOAM, LIO_SAM, Rule, pick_ring, sector_ends

RINGS, PLACES = 8, 260


def random_rings(seed: int) -> dict[str, np.ndarray]:
    """Return smoothness with ties, points that may not be picked, gaps, and rings of all lengths."""
    rng = np.random.default_rng(seed)
    shape = (PLACES, RINGS)
    smoothness = np.exp(rng.normal(-1.5, 2.0, shape))
    if seed % 3 == 0:  # ranges are often read off in whole steps: many equal values, many zeros
        smoothness = np.round(smoothness * 4) / 4
    if seed % 5 == 0:  # a slope: the longest chains of points that wait for each other
        smoothness = np.sort(smoothness, 0) if seed % 2 else np.sort(smoothness, 0)[::-1]
    count = rng.integers(0, PLACES + 1, RINGS)
    count[: RINGS // 2] = rng.integers(200, PLACES + 1, RINGS // 2)
    count[-1] = rng.choice([0, 1, 10, 11, 13, 17])
    there = np.arange(PLACES)[:, None] < count
    connected = (rng.uniform(size=shape) < rng.choice([0.0, 0.5, 0.95, 1.0])) & there
    connected[:-1] &= there[1:]
    connected[-1] = False
    return {
        "smoothness": np.where(there, smoothness, np.nan).astype(np.float32),
        "open": there & (rng.uniform(size=shape) < rng.choice([0.6, 0.9, 1.0])),
        "connected": connected,
        "count": count.astype(np.int32),
    }


@partial(jax.jit, static_argnames=("corners", "flats", "sectors", "neighbours"))
def picked(smoothness, open_, connected, count, corner_threshold, flat_threshold, neighbours, sectors, **n):
    ring = Ring(smoothness, open_, *reach(connected, neighbours), neighbours)
    bounds = sector_bounds(count, sectors, neighbours)
    return pick(ring, bounds, corner_threshold=corner_threshold, flat_threshold=flat_threshold, **n)


def picks_of(rings: dict[str, np.ndarray], rule: Rule):
    """Return what our selection picks."""
    return picked(
        *(jnp.asarray(rings[name]) for name in ("smoothness", "open", "connected", "count")),
        jnp.float32(rule.corner_threshold),
        jnp.float32(rule.flat_threshold),
        corners=rule.corners,
        flats=rule.flats,
        sectors=rule.sectors,
        neighbours=rule.neighbours,
    )


def assert_as_in_sequence(found, rings: dict[str, np.ndarray], rule: Rule) -> int:
    """Compare all picks and their order; return how many there were."""
    corners, flats = np.asarray(found.corners), np.asarray(found.flats)
    total = 0
    for number in range(rings["count"].size):
        wanted = pick_ring(
            *(rings[name][:, number] for name in ("smoothness", "open", "connected")),
            int(rings["count"][number]),
            rule,
        )
        for kind, (places, lists) in enumerate(zip((corners, flats), wanted, strict=True)):
            for sector, expected in enumerate(lists):
                got = places[:, sector, number]
                assert got[: len(expected)].tolist() == expected, (number, sector, kind)
                assert (got[len(expected) :] == -1).all(), (number, sector, kind)
                total += len(expected)
    return total


RULES = {
    "A-LOAM": A_LOAM,
    "LIO-SAM": LIO_SAM,
    "thresholds overlap": Rule(corner_threshold=0.05, flat_threshold=0.4, corners=3, flats=2),
    "nothing in between": Rule(corner_threshold=1e6, flat_threshold=1e-6),
}


@pytest.mark.parametrize("rule", RULES)
def test_the_picks_are_those_of_the_sequential_rule_on_random_images(rule):
    total = 0
    for seed in range(100):
        rings = random_rings(seed)
        total += assert_as_in_sequence(picks_of(rings, RULES[rule]), rings, RULES[rule])
    assert total > {"nothing in between": -1}.get(rule, 10_000)


@pytest.mark.parametrize(("sectors", "neighbours"), [(1, 5), (4, 2), (6, 1), (9, 7)])
def test_numbers_of_sectors_and_neighbours_may_be_others(sectors, neighbours):
    rule = Rule(sectors=sectors, neighbours=neighbours, flats=None)
    for seed in range(5):
        rings = random_rings(seed)
        assert assert_as_in_sequence(picks_of(rings, rule), rings, rule) > 100


def flat_ring(values: np.ndarray) -> dict[str, np.ndarray]:
    shape = (len(values), 1)
    connected = np.ones(shape, bool)
    connected[-1] = False
    return {
        "smoothness": values.astype(np.float32).reshape(shape),
        "open": np.ones(shape, bool),
        "connected": connected,
        "count": np.array([len(values)], np.int32),
    }


def test_of_equal_values_the_last_is_the_first_corner_and_the_first_is_the_first_flat_point():
    corners = picks_of(flat_ring(np.full(70, 5.0)), A_LOAM).corners[:, 0, 0]
    flats = picks_of(flat_ring(np.zeros(70)), A_LOAM).flats[:, 0, 0]
    # the sector holds places 5 to 14
    assert corners[:3].tolist() == [14, 8, -1]
    assert flats[:3].tolist() == [5, 11, -1]


def test_a_pick_suppresses_beyond_its_sectors_end():
    values = np.full(70, 1.0)
    values[14], values[19], values[20] = 9.0, 8.0, 7.0
    corners = picks_of(flat_ring(values), A_LOAM).corners
    assert corners[0, 0, 0] == 14
    assert corners[0, 1, 0] == 20  # 19 is suppressed by 14 although it is sharper


def test_flat_points_suppress_corners_of_the_next_sector():
    values = np.full(70, 0.5)
    values[13], values[16] = 0.0, 3.0
    rings = flat_ring(values)
    assert picks_of(rings, LIO_SAM).corners[0, 1, 0] == -1
    rings["open"][13] = False
    assert picks_of(rings, LIO_SAM).corners[0, 1, 0] == 16


def test_a_gap_ends_the_suppression():
    values = np.full(70, 0.5)
    values[8], values[10] = 9.0, 8.0
    rings = flat_ring(values)
    assert picks_of(rings, A_LOAM).corners[:2, 0, 0].tolist() == [8, 14]
    rings["connected"][9] = False
    assert picks_of(rings, A_LOAM).corners[:2, 0, 0].tolist() == [8, 10]


@pytest.mark.parametrize("count", [0, 1, 9, 10, 11, 15, 16, 69, 70, 71, 260])
def test_sectors_cover_the_ring_without_its_ends(count):
    bounds = np.asarray(sector_bounds(jnp.array([count], jnp.int32), 6, 5))[:, 0]
    assert list(zip(bounds[:-1].tolist(), bounds[1:].tolist(), strict=True)) == sector_ends(count, A_LOAM)
    if count > 10:
        assert bounds[0] == 5
        assert bounds[-1] == count - 5
    lengths = np.diff(bounds)
    assert (lengths >= 0).all()
    assert lengths.max() - lengths.min() <= 1


def test_no_two_picks_are_connected_neighbours():
    for seed in range(10):
        rings = random_rings(seed)
        found = picks_of(rings, A_LOAM)
        for ring in range(RINGS):
            places = [np.asarray(kind)[..., ring].ravel() for kind in (found.corners, found.flats)]
            places = np.sort(np.concatenate(places))
            for one, other in pairwise(places[places >= 0]):
                assert other - one > 5 or not rings["connected"][one:other, ring].all()


def test_thresholds_batch():
    rings = random_rings(1)
    arrays = [jnp.asarray(rings[name]) for name in ("smoothness", "open", "connected", "count")]
    keywords = {"corners": 20, "flats": 4, "sectors": 6, "neighbours": 5}
    limits = jnp.array([0.05, 0.3, 2.0], jnp.float32)
    batch = jax.vmap(lambda limit: picked(*arrays, limit, limit, **keywords))(limits)
    for row, limit in enumerate(limits):
        alone = picked(*arrays, limit, limit, **keywords)
        np.testing.assert_array_equal(batch.corners[row], alone.corners)
        np.testing.assert_array_equal(batch.flats[row], alone.flats)
