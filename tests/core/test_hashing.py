"""Voxel hashes fill their slots as random numbers would."""

import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.hashing import voxel_hash


def _grid(side: int, origin: tuple[int, int, int]) -> np.ndarray:
    axes = np.arange(side)
    return np.stack(np.meshgrid(axes, axes, axes, indexing="ij"), -1).reshape(-1, 3) + origin


SCENES = {
    "cube": _grid(40, (0, 0, 0)),
    "around the origin": _grid(40, (-20, -20, -20)),
    "negative and far": _grid(40, (-20000, -30000, -500)),
    "even coordinates": 2 * _grid(40, (0, 0, 0)),
    "multiples of 16": 16 * _grid(40, (-20, -20, -20)),
    "ground": np.stack(
        np.meshgrid(np.arange(-130, 130), np.arange(-130, 130), [0], indexing="ij"), -1
    ).reshape(-1, 3),
}


@pytest.mark.parametrize("bits", [8, 12, 16])
@pytest.mark.parametrize("name", SCENES)
def test_low_bits_fill_slots_evenly(name, bits):
    voxel = SCENES[name]
    slots = np.asarray(voxel_hash(jnp.asarray(voxel, jnp.int32))) & ((1 << bits) - 1)
    occupied = len(np.unique(slots))
    by_chance = (1 << bits) * (1 - np.exp(-len(voxel) / (1 << bits)))
    assert occupied > 0.97 * by_chance


@pytest.mark.parametrize("name", SCENES)
def test_hardly_any_two_voxels_share_all_32_bits(name):
    hashes = np.asarray(voxel_hash(jnp.asarray(SCENES[name], jnp.int32)))
    by_chance = len(hashes) ** 2 / 2**33
    assert len(hashes) - len(np.unique(hashes)) <= 10 + 10 * by_chance


def test_voxels_opposite_the_origin_do_not_share_a_hash():
    """A scan's voxels lie around the sensor, so mirrored coordinates occur together all the time."""
    rng = np.random.default_rng(2)
    voxel = rng.integers(1, 300, (5000, 3))
    hashes = np.asarray(voxel_hash(jnp.asarray(voxel, jnp.int32)))
    for signs in [(-1, -1, 1), (-1, 1, -1), (1, -1, -1), (-1, 1, 1), (-1, -1, -1)]:
        mirrored = np.asarray(voxel_hash(jnp.asarray(voxel * np.array(signs), jnp.int32)))
        assert (hashes == mirrored).mean() < 0.001, f"signs {signs}"


def test_batch_shape_does_not_change_the_hash():
    voxel = jnp.asarray([[-1, 0, 1], [0, 0, 0], [-7, 3, 2]], jnp.int32)
    one_by_one = [int(voxel_hash(row)) for row in voxel]
    assert np.asarray(voxel_hash(voxel)).tolist() == one_by_one
    assert voxel_hash(voxel[None, :, None]).shape == (1, 3, 1)
    assert voxel_hash(voxel).dtype == jnp.uint32


def test_each_axis_flips_about_half_of_the_low_bits():
    rng = np.random.default_rng(1)
    voxel = rng.integers(-1000, 1000, (2000, 3))
    base = np.asarray(voxel_hash(jnp.asarray(voxel, jnp.int32)))
    for axis in range(3):
        moved = voxel + np.eye(3, dtype=int)[axis]
        flipped = np.asarray(voxel_hash(jnp.asarray(moved, jnp.int32))) ^ base
        share = [(flipped >> bit & 1).mean() for bit in range(16)]
        # two xor-shift rounds do not mix perfectly; a bit that never follows an axis would show as 0 or 1
        assert 0.3 < min(share) <= max(share) < 0.8, f"axis {axis}"
