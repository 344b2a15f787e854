"""Scans become padded arrays of a few sizes."""

from dataclasses import replace

import numpy as np
import pytest

from lio_jax.lidar.params import ScanConfig
from lio_jax.run.scan_inputs import bucket_for, padded
from tests.run.small_drive import PERIOD_NS, moving, without_points

CONFIG = ScanConfig(buckets=(100, 8192))


@pytest.mark.parametrize(("count", "size"), [(0, 100), (100, 100), (101, 8192), (8192, 8192), (9000, 8192)])
def test_smallest_bucket_that_holds_the_scan(count, size):
    assert bucket_for(count, CONFIG) == size


def test_every_column_is_copied_and_the_rest_is_masked():
    scan = moving()[0]
    count = len(scan.points)
    arrays = padded(scan, None, CONFIG)
    assert arrays.points.shape == (8192, 3)
    np.testing.assert_array_equal(arrays.mask, np.arange(8192) < count)
    for name in ("points", "time", "ring", "intensity"):
        np.testing.assert_array_equal(getattr(arrays, name)[:count], getattr(scan, name))
        assert not np.any(getattr(arrays, name)[count:])
    assert arrays.duration == np.float32(0.1)


def test_interval_counts_from_end_to_end():
    scan = moving()[0]
    assert padded(scan, None, CONFIG).interval == 0
    assert padded(scan, scan.end_ns - 3 * PERIOD_NS, CONFIG).interval == np.float32(0.3)


def test_stamps_of_today_keep_their_nanoseconds():
    scan = moving()[0]
    assert padded(scan, scan.end_ns - 17, CONFIG).interval == np.float32(17e-9)


def test_too_large_a_scan_is_thinned_over_its_whole_length():
    scan = moving()[0]
    count = len(scan.points)
    many = replace(scan, intensity=np.arange(count, dtype=np.float32))
    arrays = padded(many, None, ScanConfig(buckets=(1000,)))
    assert arrays.mask.all()
    assert arrays.intensity[0] == 0
    assert arrays.intensity[-1] == count - 1
    assert np.diff(arrays.intensity).max() <= np.ceil(count / 1000)


def test_empty_scan_is_all_padding():
    assert not padded(without_points(moving()[0]), None, CONFIG).mask.any()
