"""Nearest points ring by ring against scipy's k-d tree, on simulated and on real scans."""

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.lidar.features import loam_features
from lio_jax.lidar.params import LoamRingConfig
from lio_jax.registration.ring_index import Queries, nearest_by_ring, ring_index
from lio_jax.run.scan_inputs import padded
from lio_jax.settings.settings import recipe_settings
from lio_jax.sim.sequence import SimulatedSequence
from tests.params import Config

_index = jax.jit(ring_index, static_argnums=3)
_nearest = jax.jit(nearest_by_ring, static_argnums=3)
KITTI = Path(__file__).resolve().parents[2].parent / "shared/data/kitti_odometry/sequences/04"


def searched(points, ring, mask, queries, query_mask, rings, *, radius=5.0, apart=2.5, lowest=0, clouds=1):
    """Return the index's points and rings, and the places found."""
    index = _index(
        jnp.asarray(points, jnp.float32),
        jnp.asarray(ring, jnp.int32),
        jnp.asarray(mask),
        clouds * rings,
    )
    x, y, z = jnp.asarray(queries, jnp.float32).T
    asked = Queries(x, y, z, jnp.full(len(queries), lowest, jnp.int32))
    found = _nearest(index, asked, jnp.asarray(query_mask), rings, jnp.float32(radius), jnp.float32(apart))
    held = np.stack([index.x, index.y, index.z], 1).astype(float)
    return held, np.asarray(index.ring), jax.tree.map(np.asarray, found)


def by_hand(points, ring, queries, radius=5.0, apart=2.5):
    """Return the distances to nearest, next of the same ring, nearest of another, infinite without one."""
    nearest, which = cKDTree(points).query(queries, distance_upper_bound=radius)
    rows = np.full((3, len(queries)), np.inf)
    rows[0] = nearest
    trees = {number: cKDTree(points[ring == number]) for number in set(ring)}
    for k in np.flatnonzero(np.isfinite(nearest)):
        own = ring[which[k]]
        for number, tree in trees.items():
            if number == own:
                distance = tree.query(queries[k], 2)[0][1]
                rows[1, k] = distance if distance < radius else np.inf
            elif abs(number - own) < apart:
                distance = tree.query(queries[k])[0]
                rows[2, k] = min(rows[2, k], distance if distance < radius else np.inf)
    return rows


def distances(held, found, queries):
    """Return the distances of what was found, as ``by_hand``."""
    return np.stack(
        [
            np.where(place >= 0, np.linalg.norm(held[np.maximum(place, 0)] - queries, axis=1), np.inf)
            for place in (found.nearest, found.same_ring, found.other_ring)
        ]
    )


def share_alike(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return for each row the share that agrees to a thousandth."""
    both = np.isfinite(one) & np.isfinite(other)
    close = (
        np.abs(np.where(both, one, 0) - np.where(both, other, 0)) <= 1e-3 * np.where(both, other, 0) + 1e-5
    )
    return np.mean(np.where(both, close, np.isfinite(one) == np.isfinite(other)), axis=1)


def spinning(rings: int, columns: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return points of rings whose ranges jump, and their rings."""
    rng = np.random.default_rng(seed)
    elevation = np.deg2rad(np.linspace(-20, 15, rings))[:, None]
    azimuth = np.linspace(-np.pi, np.pi, columns, endpoint=False)[None]
    steps = np.repeat(rng.uniform(2, 40, (rings // 4, columns // 16)), 16, 1).repeat(4, 0)
    distance = steps + rng.normal(0, 0.02, (rings, columns))
    points = np.stack(
        [
            distance * np.cos(elevation) * np.cos(azimuth),
            distance * np.cos(elevation) * np.sin(azimuth),
            distance * np.sin(elevation) * np.ones_like(azimuth),
        ],
        -1,
    )
    order = rng.permutation(rings * columns)
    return points.reshape(-1, 3)[order], np.repeat(np.arange(rings), columns)[order]


@pytest.mark.parametrize(("rings", "columns"), [(16, 512), (64, 256), (8, 32), (16, 4096), (128, 2048)])
@pytest.mark.parametrize("moved", [0.05, 1.5])
def test_all_three_are_those_of_a_k_d_tree(rings, columns, moved):
    points, ring = spinning(rings, columns, seed=rings)
    rng = np.random.default_rng(1)
    queries = points[rng.choice(len(points), 400)] + rng.normal(0, moved, (400, 3))
    queries = queries.astype(np.float32).astype(float)
    held, _, found = searched(points, ring, np.ones(len(points), bool), queries, np.ones(400, bool), rings)
    expected = by_hand(points.astype(np.float32).astype(float), ring, queries)
    assert np.isfinite(expected).mean() > 0.5
    assert share_alike(distances(held, found, queries), expected).min() >= 0.999


def test_points_and_queries_that_are_masked_do_not_count():
    points, ring = spinning(16, 128, seed=2)
    rng = np.random.default_rng(3)
    mask, query_mask = rng.random(len(points)) > 0.5, np.arange(300) % 4 > 0
    queries = points[rng.choice(len(points), 300)] + 0.1
    held, _, found = searched(np.where(mask[:, None], points, np.nan), ring, mask, queries, query_mask, 16)
    expected = by_hand(points[mask], ring[mask], queries)
    alike = share_alike(distances(held, found, queries)[:, query_mask], expected[:, query_mask])
    assert alike.min() >= 0.999
    for place in jax.tree.leaves(found):
        assert (place[~query_mask] == -1).all()


def test_clouds_of_one_index_do_not_mix():
    points, ring = spinning(16, 128, seed=4)
    second = (np.arange(len(points)) % 2).astype(bool)
    queries = points[:200] + 0.05
    both = np.ones(len(points), bool), queries, np.ones(200, bool)
    for number in (0, 1):
        held, rings, found = searched(points, ring + 16 * second, *both, 16, lowest=16 * number, clouds=2)
        expected = by_hand(points[second == number], ring[second == number], queries)
        assert share_alike(distances(held, found, queries), expected).min() >= 0.999
        assert (rings[found.nearest] // 16 == number).all()


def test_a_cloud_without_points_has_no_nearest():
    points, ring = spinning(16, 64, seed=5)
    _, _, found = searched(points, ring, np.zeros(len(points), bool), points[:50], np.ones(50, bool), 16)
    assert all((place == -1).all() for place in jax.tree.leaves(found))


def test_rings_up_to_the_given_distance_are_searched():
    points, ring = spinning(16, 128, seed=6)
    queries, everything = points[:200] + 0.05, np.ones(len(points), bool)
    for apart in (1.5, 2.5):
        held, _, found = searched(points, ring, everything, queries, everything[:200], 16, apart=apart)
        expected = by_hand(points, ring, queries, apart=apart)
        assert share_alike(distances(held, found, queries), expected).min() >= 0.999


def scans_of(name: str):
    if name == "kitti":
        if not KITTI.is_dir():
            pytest.skip(f"{KITTI} is not there")
        return list(open_sequence(KITTI, DataConfig()).scans(3, 2)), 64, 2304
    return list(SimulatedSequence("city", "vlp16", 1.0).scans(4, 2)), 16, 2048


@pytest.mark.parametrize("name", ["kitti", pytest.param("city", marks=pytest.mark.long)])
def test_recall_on_consecutive_scans(name):
    scans, rings, columns = scans_of(name)
    config = Config(features=LoamRingConfig(rings=rings, columns=columns))
    features = jax.jit(partial(loam_features, config))
    params = recipe_settings("loam").params()
    last, now = (
        features(params, jax.tree.map(jnp.asarray, padded(scan, None, config.lidar))) for scan in scans
    )
    for target, picked in ((last.less_sharp, now.sharp), (last.less_flat, now.flat)):
        mask, query_mask = np.asarray(target.mask), np.asarray(picked.mask)
        points, ring = np.asarray(target.points, float), np.asarray(target.ring)
        queries = np.asarray(picked.points, float)
        held, _, found = searched(points, ring, mask, queries, query_mask, rings)
        expected = by_hand(points[mask], ring[mask], queries[query_mask])
        alike = share_alike(distances(held, found, queries)[:, query_mask], expected)
        assert alike.min() >= 0.999, alike
        assert np.isfinite(expected[0]).mean() > 0.95
