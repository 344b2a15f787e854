"""Which point lies where, against numpy's sorts."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.lidar.params import LoamRingConfig
from lio_jax.lidar.range_image import azimuth_column, range_image, rank_within_ring
from tests.lidar.ring_scans import LOAM_PARAMS, on_device, params_of, random_scan, scan_of

IMAGE = jax.jit(range_image, static_argnums=0)


def kept_points(scan, params=LOAM_PARAMS) -> np.ndarray:
    """Return which points of a scan lie within the range limits."""
    with np.errstate(invalid="ignore", over="ignore"):
        distance = np.linalg.norm(np.asarray(scan.points, float), axis=1)
        near, far = float(params.lidar.min_range), float(params.lidar.max_range)
        return np.asarray(scan.mask) & (distance > near) & (distance < far)


def rings_of(image) -> list[list[int]]:
    """Return the scan's rows along each ring, after a check of what lies beyond."""
    index, mask, count = (np.asarray(a) for a in (image.index, image.mask, image.count))
    np.testing.assert_array_equal(mask.sum(0), count)
    assert (index[~mask] == 0).all()
    return [index[: count[ring], ring].tolist() for ring in range(len(count))]


@pytest.mark.parametrize("order", ["firing", "rings"])
@pytest.mark.parametrize("seed", range(4))
def test_rings_hold_their_points_in_order_of_arrival(seed, order):
    scan = random_scan(seed, order=order)
    image = IMAGE(LoamRingConfig(rings=8, columns=500), LOAM_PARAMS.lidar, scan)
    kept, ring = kept_points(scan), np.asarray(scan.ring)
    assert rings_of(image) == [np.flatnonzero(kept & (ring == r)).tolist() for r in range(8)]
    assert int(image.count[3]) == 0
    assert int(image.dropped) == 0
    np.testing.assert_array_equal(image.column, np.tile(np.arange(500)[:, None], (1, 8)))


@pytest.mark.parametrize("seed", range(4))
def test_the_first_point_of_a_column_takes_it(seed):
    scan = random_scan(seed)
    columns = 120  # 375 firings a turn: three fall into each
    image = IMAGE(LoamRingConfig(rings=8, columns=columns, order="azimuth"), LOAM_PARAMS.lidar, scan)
    column = np.asarray(azimuth_column(scan.points, columns))
    wanted = [dict[int, int]() for _ in range(8)]
    for row in np.flatnonzero(kept_points(scan)):
        wanted[int(scan.ring[row])].setdefault(int(column[row]), int(row))
    found = rings_of(image)
    for ring, cells in enumerate(wanted):
        assert found[ring] == [cells[c] for c in sorted(cells)]
        assert np.asarray(image.column)[: len(cells), ring].tolist() == sorted(cells)
    assert int(image.dropped) == 0


@pytest.mark.parametrize("columns", [1800, 1024, 2048, 7])
def test_columns_are_those_of_lio_sam(columns):
    rng = np.random.default_rng(columns)
    xy = rng.normal(size=(20000, 2)) * rng.uniform(0.01, 300, (20000, 1))
    points = np.c_[xy, rng.normal(size=20000)].astype(np.float32)
    x, y = points[:, 0].astype(float), points[:, 1].astype(float)
    # its own words: the angle from the y axis, a rounded step, half a turn, wrapped
    exact = -(np.degrees(np.arctan2(x, y)) - 90.0) / (360.0 / columns)
    wanted = (np.rint(exact) + columns // 2).astype(int)
    wanted = np.where(wanted >= columns, wanted - columns, wanted)
    found = np.asarray(azimuth_column(jnp.asarray(points), columns))
    assert found.min() >= 0
    assert found.max() < columns
    off = found != wanted
    # float32 rounds an azimuth to 2e-7 rad
    assert (np.abs(np.abs(exact - np.rint(exact)) - 0.5)[off] < 4e-7 * columns).all()
    assert off.mean() < 1e-3


def test_columns_in_the_axes_directions():
    ahead, left, behind, right, still_behind = [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [-1, -1e-9, 0]
    points = jnp.array([ahead, left, behind, right, still_behind, [0, 0, 1]], jnp.float32)
    np.testing.assert_array_equal(azimuth_column(points, 360), [180, 270, 0, 90, 0, 180])


def test_the_position_in_its_ring_is_a_running_count():
    rng = np.random.default_rng(0)
    for n in (1, 31, 32, 33, 5000):
        ring, mask = rng.integers(0, 5, n).astype(np.int32), rng.uniform(size=n) < 0.7
        rank, count = jax.jit(partial(rank_within_ring, rings=5))(jnp.asarray(ring), jnp.asarray(mask))
        for number in range(5):
            here = mask & (ring == number)
            np.testing.assert_array_equal(np.asarray(rank)[here], np.arange(here.sum()))
            assert count[number] == here.sum()


def test_a_ring_that_is_too_long_is_thinned_evenly_and_its_loss_counted():
    azimuth = np.linspace(0, 6, 1000)
    points = 10 * np.c_[np.cos(azimuth), np.sin(azimuth), np.zeros(1000)]
    scan = scan_of(np.r_[points, points[:50]], np.r_[np.zeros(1000), np.ones(50)])
    image = IMAGE(LoamRingConfig(rings=2, columns=300), LOAM_PARAMS.lidar, scan)
    assert image.count.tolist() == [300, 50]
    assert int(image.dropped) == 700
    long, short = rings_of(image)
    assert short == list(range(1000, 1050))
    assert set(np.diff(long).tolist()) <= {3, 4}
    assert long[0] < 4
    assert long[-1] > 990


def test_points_of_rings_beyond_the_configured_ones_are_counted_as_dropped():
    scan = random_scan(1)
    image = IMAGE(LoamRingConfig(rings=6, columns=500), LOAM_PARAMS.lidar, scan)
    assert int(image.dropped) == (kept_points(scan) & (np.asarray(scan.ring) >= 6)).sum() > 0


def test_rings_without_a_number_and_rings_in_between_are_left_out():
    scan = random_scan(2)
    unknown = np.where(np.arange(scan.ring.size) % 7 == 0, -1, np.asarray(scan.ring)).astype(np.int32)
    scan = on_device(type(scan)(**{**vars(scan), "ring": unknown}))
    image = IMAGE(LoamRingConfig(rings=8, columns=500, ring_step=2), LOAM_PARAMS.lidar, scan)
    kept = kept_points(scan) & (unknown % 2 == 0) & (unknown >= 0)
    assert rings_of(image) == [np.flatnonzero(kept & (unknown == r)).tolist() for r in range(8)]
    assert int(image.dropped) == 0


@pytest.mark.parametrize("order", ["arrival", "azimuth"])
def test_a_scan_without_points_has_empty_rings(order):
    scan = scan_of(np.full((40, 3), np.nan), np.zeros(40))
    image = IMAGE(LoamRingConfig(rings=4, columns=64, order=order), LOAM_PARAMS.lidar, scan)
    assert rings_of(image) == [[], [], [], []]
    assert int(image.dropped) == 0


def test_range_limits_are_traced():
    scan = random_scan(3)
    batch = jax.tree.map(
        lambda *leaves: jnp.stack(leaves), *(params_of(lidar__max_range=far) for far in (8.0, 12.0, 50.0))
    )
    config = LoamRingConfig(rings=8, columns=500)
    images = jax.jit(jax.vmap(lambda params: range_image(config, params.lidar, scan)))(batch)
    for row, far in enumerate((8.0, 12.0, 50.0)):
        assert images.count[row].sum() == kept_points(scan, params_of(lidar__max_range=far)).sum()
