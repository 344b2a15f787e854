"""Voxel selection against numpy's set of occupied voxels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import chisquare

from lio_jax.lidar.thinning import Selection, select_per_voxel

SELECT = jax.jit(select_per_voxel, static_argnums=3)


def scan_around(count: int, half: float, seed: int = 0) -> np.ndarray:
    """Return (count, 3) float32 points in a cube around the sensor."""
    return np.random.default_rng(seed).uniform(-half, half, (count, 3)).astype(np.float32)


def voxels_of(points: np.ndarray, size: float) -> np.ndarray:
    return np.floor(points / np.float32(size)).astype(int)


def occupied(points: np.ndarray, size: float) -> np.ndarray:
    """Return the voxels that hold a point."""
    return np.unique(voxels_of(points, size), axis=0)


def select(points, mask, size, capacity) -> tuple[np.ndarray, Selection]:
    """Return the chosen indices and the whole answer."""
    answer = SELECT(jnp.asarray(points), jnp.asarray(mask), jnp.float64(size), capacity)
    assert answer.index.shape == answer.mask.shape == (capacity,)
    return np.asarray(answer.index)[np.asarray(answer.mask)], answer


SCENES = {
    "around the sensor": scan_around(60000, 12.0),
    "ahead of the sensor": scan_around(60000, 12.0) + np.float32(13.0),
    "ground": scan_around(60000, 40.0) * np.array([1, 1, 0], np.float32) - np.array([0, 0, 1.8], np.float32),
}


@pytest.mark.parametrize("capacity", [512, 4096, 16384])
@pytest.mark.parametrize("name", SCENES)
def test_never_two_points_of_one_voxel(name, capacity):
    points = SCENES[name]
    index, _ = select(points, np.ones(len(points), bool), 0.7, capacity)
    assert len(np.unique(index)) == len(index)
    assert len(occupied(points[index], 0.7)) == len(index)


@pytest.mark.parametrize("name", SCENES)
def test_most_occupied_voxels_are_represented(name):
    points = SCENES[name]
    there = len(occupied(points, 1.0))
    capacity = int(there * 1.05)
    index, answer = select(points, np.ones(len(points), bool), 1.0, capacity)
    assert len(index) >= 0.85 * there
    assert answer.dropped == 0


def test_a_sparse_scan_is_kept_almost_whole():
    points = scan_around(1000, 50.0)
    index, answer = select(points, np.ones(1000, bool), 0.1, 16384)
    assert len(index) > 970
    assert answer.dropped == 0


def test_overflow_is_reported():
    points = SCENES["ahead of the sensor"]
    there = len(occupied(points, 0.7))
    capacity = there // 4
    index, answer = select(points, np.ones(len(points), bool), 0.7, capacity)
    assert len(index) == capacity
    # cells that share a slot are not told apart, so the count is a lower bound
    assert 0.5 * (there - capacity) < int(answer.dropped) <= there - capacity


@pytest.mark.parametrize("order", ["as drawn", "sorted along x", "octant by octant"])
@pytest.mark.parametrize("overflow", [2, 8])
def test_overflow_thins_every_part_of_space_alike(overflow, order):
    points = SCENES["around the sensor"]
    octant = ((points > 0) * [1, 2, 4]).sum(1)
    if order != "as drawn":
        key = points[:, 0] if order == "sorted along x" else octant
        points = points[np.argsort(key, kind="stable")]
    voxels = occupied(points, 0.7)
    capacity = len(voxels) // overflow
    index, _ = select(points, np.ones(len(points), bool), 0.7, capacity)
    assert len(index) == capacity

    def share(cells):
        """Return cells per octant and per shell of distance."""
        centre = (cells + 0.5) * 0.7
        part = ((centre > 0) * [1, 2, 4]).sum(1) * 3 + np.digitize(np.abs(centre).max(1), [6.0, 9.0])
        return np.bincount(part, minlength=24)

    found = share(voxels_of(points[index], 0.7))
    wanted = share(voxels) * len(index) / len(voxels)
    assert chisquare(found, wanted).pvalue > 1e-4


def test_overflow_takes_early_and_late_points_alike():
    points = SCENES["around the sensor"]
    index, _ = select(points, np.ones(len(points), bool), 0.3, 2048)
    quarters = np.bincount(index * 4 // len(points), minlength=4)
    assert chisquare(quarters).pvalue > 1e-4


def test_the_representative_is_neither_the_first_nor_the_last_by_rule():
    voxel = np.repeat(np.arange(2000), 10)
    points = np.stack([voxel + 0.5, np.full(20000, 0.5), np.full(20000, 0.5)], -1).astype(np.float32)
    index, _ = select(points, np.ones(20000, bool), 1.0, 8192)
    assert len(index) > 1500
    assert np.bincount(index % 10, minlength=10).min() > 0.05 * len(index)


@pytest.mark.parametrize("filler", [0.0, np.nan, np.inf, -np.inf, 1e30])
def test_masked_points_do_no_harm(filler):
    points = scan_around(5000, 10.0)
    alone, _ = select(points, np.ones(5000, bool), 0.5, 4096)
    padded = np.concatenate([points, np.full((3000, 3), filler, np.float32)])
    mask = np.arange(8000) < 5000
    index, answer = select(padded, mask, 0.5, 4096)
    np.testing.assert_array_equal(np.sort(index), np.sort(alone))
    assert np.asarray(answer.index).min() >= 0
    assert np.asarray(answer.index).max() < 8000


def test_mask_is_respected_in_the_middle():
    points = scan_around(5000, 10.0)
    mask = np.random.default_rng(3).random(5000) < 0.3
    index, _ = select(points, mask, 0.5, 4096)
    assert mask[index].all()
    assert len(index) >= 0.85 * len(occupied(points[mask], 0.5))


def test_a_masked_point_does_not_win_its_voxel():
    points = np.full((2, 3), 0.5, np.float32)
    for real in (0, 1):
        index, _ = select(points, np.arange(2) == real, 1.0, 4)
        assert index.tolist() == [real]


def test_equal_input_equal_output():
    points = SCENES["around the sensor"]
    mask = np.ones(len(points), bool)
    first, _ = select(points, mask, 0.5, 4096)
    with jax.disable_jit():
        eager = select_per_voxel(jnp.asarray(points), jnp.asarray(mask), jnp.float64(0.5), 4096)
    np.testing.assert_array_equal(select(points, mask, 0.5, 4096)[0], first)
    np.testing.assert_array_equal(np.asarray(eager.index)[np.asarray(eager.mask)], first)


@pytest.mark.parametrize("count", [0, 1, 100])
def test_nothing_selected_from_nothing(count):
    index, answer = select(np.zeros((count, 3), np.float32), np.zeros(count, bool), 0.5, 64)
    assert len(index) == 0
    assert answer.dropped == 0
    assert (np.asarray(answer.index) == 0).all()


def test_one_voxel_one_point():
    points = np.random.default_rng(0).uniform(0.1, 0.9, (500, 3)).astype(np.float32)
    index, answer = select(points, np.ones(500, bool), 1.0, 64)
    assert len(index) == 1
    assert answer.dropped == 0


def test_voxel_faces_belong_to_the_upper_voxel_also_below_zero():
    points = np.array([[-1.0, 0, 0], [-0.5, 0, 0], [0.0, 0, 0], [0.5, 0, 0]], np.float32)
    index, _ = select(points, np.ones(4, bool), 1.0, 16)
    assert sorted((index // 2).tolist()) == [0, 1]


def test_largest_scan_keeps_its_indices():
    """262,144 points: every index survives the scrambling."""
    count = 262_144
    points = np.zeros((count, 3), np.float32)
    points[:, 0] = np.arange(count) % 512 + 0.5
    points[:, 1] = np.arange(count) // 512 + 0.5
    index, _ = select(points, np.ones(count, bool), 1.0, 65536)
    assert len(np.unique(index)) == len(index) == 65536
    assert index.max() > 0.99 * count
