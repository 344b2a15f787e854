"""A table of fixed size on a long drive: near voxels stay, far ones are replaced, overflow is reported."""

import jax
import numpy as np
import pytest

from lio_jax.mapping.voxel_map import empty_map, find_slots
from tests.mapping.test_voxel_map import VOXEL, ask, assert_holds, distributions, extended, put

_find_slots = jax.jit(find_slots)


def centres(voxels) -> np.ndarray:
    """Return one point in each voxel, off its centre."""
    return VOXEL * np.asarray(voxels) + VOXEL * np.array([0.4, 0.55, 0.6])


def line_of_voxels(count: int) -> np.ndarray:
    return np.stack([np.arange(count), np.zeros(count, int), np.zeros(count, int)], -1)


def held(vmap, voxels) -> np.ndarray:
    """Return which voxels (world coordinates) the map holds."""
    slots = _find_slots(vmap, extended(np.asarray(voxels, np.int32)))
    return np.asarray(slots)[: len(voxels)] >= 0


def test_voxels_beyond_reach_give_way_and_are_then_gone():
    old = line_of_voxels(12)
    vmap, _ = put(empty_map(16), centres(old), reach=30.0)
    before = held(vmap, old)
    assert before.sum() > 6
    anchor = np.array([1000, 0, 0])
    for seed in range(5):
        new = np.unique(np.random.default_rng(seed).integers(-5, 5, (40, 3)), axis=0)
        vmap, report = put(vmap, centres(new), anchor, reach=30.0)
        assert report.added.any() or seed
    gone = before & ~held(vmap, old)
    assert gone.sum() >= 0.9 * before.sum()
    valid, _, _ = ask(vmap, centres(old[gone]))
    neighbours_held = held(vmap, old)
    assert valid.sum() <= 2 * neighbours_held.sum()


def test_a_claimed_slot_keeps_nothing_of_the_voxel_before():
    rng = np.random.default_rng(0)
    vmap = empty_map(2)
    for drive in range(6):
        anchor = np.array([500 * drive, -300 * drive, 0])
        points = rng.uniform(0.05, 1.15, (30, 3))
        vmap, report = put(vmap, points, anchor, reach=20.0)
        added = report.added
        assert added.sum() > 15
        assert_holds(vmap, points[added], anchor)


def test_nothing_is_forgotten_while_there_is_room():
    old = np.random.default_rng(1).integers(-8, 8, (60, 3))
    vmap, _ = put(empty_map(65536), centres(old), reach=10.0)
    before = held(vmap, old)
    vmap, _ = put(vmap, centres(old), (5000, 0, 0), reach=10.0)
    assert held(vmap, old)[before].mean() > 0.95


def test_voxels_within_reach_are_never_lost():
    """More voxels than slots, all within reach: the first stay, later ones find no room; it is reported."""
    rng = np.random.default_rng(2)
    vmap = empty_map(128)
    mine = np.unique(rng.integers(-6, 6, (90, 3)), axis=0)
    vmap, _ = put(vmap, centres(mine))
    kept = mine[held(vmap, mine)]
    before = ask(vmap, centres(kept))
    for seed in range(4):
        others = np.unique(np.random.default_rng(10 + seed).integers(-20, 20, (300, 3)), axis=0)
        others = others[~(others[:, None] == kept).all(-1).any(1)]
        vmap, report = put(vmap, centres(others))
        assert held(vmap, kept).all()
        assert report.dropped == (~held(vmap, others)).sum() > 0
        assert not report.added[~held(vmap, others)].any()
    after = ask(vmap, centres(kept), min_points=1.0)
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)


def test_overflow_keeps_the_table_in_order():
    rng = np.random.default_rng(3)
    points = rng.uniform(-12, 12, (4000, 3))
    vmap, report = put(empty_map(64), points)
    added = report.added
    assert 0 < added.sum() < 1000
    assert int(report.dropped) > 2000
    assert int(report.dropped) + added.sum() <= 4000
    assert_holds(vmap, points[added])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(vmap))


@pytest.mark.parametrize("capacity", [2, 64, 1024])
def test_capacity_is_fixed(capacity):
    vmap = empty_map(capacity)
    shapes = [leaf.shape for leaf in jax.tree.leaves(vmap)]
    for seed in range(3):
        points = np.random.default_rng(seed).uniform(-30, 30, (3000, 3))
        vmap, _ = put(vmap, points)
    assert [leaf.shape for leaf in jax.tree.leaves(vmap)] == shapes
    assert {shape[0] for shape in shapes} == {capacity}


def test_a_table_filled_to_an_eighth_houses_nearly_every_voxel():
    voxels = np.unique(np.random.default_rng(4).integers(-12, 12, (2000, 3)), axis=0)
    vmap, report = put(empty_map(16384), centres(voxels))
    assert report.dropped == (~held(vmap, voxels)).sum()
    assert int(report.dropped) < 0.02 * len(voxels)


def test_reach_is_a_distance_from_the_anchor_in_metres():
    near, far = np.array([[9, 0, 0]]), np.array([[11, 0, 0]])
    crowd = np.unique(np.random.default_rng(5).integers(-3, 3, (200, 3)), axis=0)
    for voxel, survives in ((near, True), (far, False)):
        vmap, _ = put(empty_map(2), centres(voxel), reach=10 * VOXEL)
        for _ in range(4):
            vmap, _ = put(vmap, centres(crowd), reach=10 * VOXEL)
        assert held(vmap, voxel).all() == survives


def test_a_voxel_overwritten_by_the_scan_that_returns_to_it_is_left_out_once():
    """Points of an old, far voxel and of the voxel that claims its slot in the same scan never mix."""
    rng = np.random.default_rng(6)
    for trial in range(30):
        vmap = empty_map(4)
        old = rng.integers(100, 110, (3, 3))
        vmap, _ = put(vmap, centres(old), reach=20.0)
        new = np.concatenate([old, np.unique(rng.integers(-3, 3, (6, 3)), axis=0)])
        rng.shuffle(new)
        points = centres(new) + rng.uniform(-0.05, 0.05, new.shape)
        vmap, report = put(vmap, points, reach=20.0)
        added = report.added
        assert held(vmap, new)[added].all()
        valid, mean, _ = ask(vmap, points[added])
        assert valid.all()
        # the old point of a voxel lies within 0.1 m of the new one, another voxel's more than 0.5 m away
        assert np.abs(mean - points[added]).max() < 0.2, f"trial {trial}"


def test_a_long_drive_agrees_with_a_model_that_forgets_the_same_voxels():
    rng = np.random.default_rng(7)
    vmap = empty_map(512)
    reach_voxels, model = 6.3, {}
    for step in range(60):
        anchor = np.array([step, step // 2, 0])
        points = rng.uniform(-3.4, 3.4, (60, 3)).astype(np.float32)
        vmap, report = put(vmap, points, anchor, reach=reach_voxels * VOXEL)
        added = points[report.added].astype(float)
        for point in added:
            voxel = np.floor(np.float32(point) / np.float32(VOXEL)).astype(int) + anchor
            model.setdefault(tuple(voxel.tolist()), []).append(point + anchor * VOXEL)
        there = held(vmap, np.array(list(model)))
        for key, stays in zip(list(model), there, strict=True):
            if not stays:
                assert np.linalg.norm(np.array(key) - anchor) > reach_voxels, "a voxel within reach was lost"
                del model[key]
    assert len(model) > 150
    local = np.concatenate(list(model.values())) - anchor * VOXEL
    expected = {
        key: (np.mean(mine, 0) - anchor * VOXEL, np.cov(np.transpose(mine), bias=True).reshape(3, 3))
        for key, mine in model.items()
    }
    assert len(distributions(local)) == len(model)
    valid, mean, covariance = ask(vmap, [m for m, _ in expected.values()], anchor)
    assert valid.all()
    np.testing.assert_allclose(mean, [m for m, _ in expected.values()], atol=2e-5)
    np.testing.assert_allclose(covariance, [c for _, c in expected.values()], atol=2e-6)
