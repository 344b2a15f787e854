"""Corrections of the sensor's calibration, against the same in spherical coordinates."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from lio_jax.core.types import Scan
from lio_jax.lidar.features import FeatureCloud, LioSamFeatures, corrected_clouds
from lio_jax.lidar.thinning import thinned
from tests.params import default_params

RINGS = 16
PLAIN = default_params().lidar


def lidar_with(**values):
    dtype = PLAIN.range_scale.dtype
    return dataclasses.replace(PLAIN, **{name: jnp.asarray(value, dtype) for name, value in values.items()})


def some_points(count=500, seed=1):
    random = np.random.default_rng(seed)
    return random.normal(size=(count, 3)) * [15, 15, 4], random.integers(0, RINGS, count).astype(np.int32)


def in_spherical_coordinates(points, elevation, added, scale):
    """Return the points with another elevation and range, by angles."""
    x, y, z = points.T
    azimuth, distance = np.arctan2(y, x), np.linalg.norm(points, axis=1)
    raised = np.arcsin(z / distance) + elevation
    longer = scale * distance + added
    return np.stack(
        [
            longer * np.cos(raised) * np.cos(azimuth),
            longer * np.cos(raised) * np.sin(azimuth),
            longer * np.sin(raised),
        ],
        axis=1,
    )


def test_elevation_and_range_change_and_the_azimuth_stays():
    points, ring = some_points()
    lidar = lidar_with(elevation_offset=0.0036, range_offset=0.05, range_scale=1.002)
    expected = in_spherical_coordinates(points, 0.0036, 0.05, 1.002)
    np.testing.assert_allclose(lidar.corrected(jnp.asarray(points), jnp.asarray(ring)), expected, atol=1e-12)
    # a positive offset raises every point, whatever its elevation
    lifted = lidar_with(elevation_offset=0.0036).corrected(jnp.asarray(points), jnp.asarray(ring))
    assert np.all(np.asarray(lifted)[:, 2] > points[:, 2])


def test_each_ring_has_its_own_numbers_and_rings_beyond_them_have_none():
    points, ring = some_points()
    random = np.random.default_rng(2)
    elevation, added = random.normal(size=RINGS) * 0.002, random.normal(size=RINGS - 4) * 0.02
    ring[:5] = -1
    lidar = lidar_with(
        elevation_offset=-0.001, ring_elevation_offset=elevation, range_offset=0.03, ring_range_offset=added
    )
    own_elevation = np.where(ring >= 0, elevation[ring], 0) - 0.001
    own_range = np.where(ring >= 0, np.append(added, np.zeros(4))[ring], 0) + 0.03
    expected = in_spherical_coordinates(points, own_elevation, own_range, 1.0)
    np.testing.assert_allclose(lidar.corrected(jnp.asarray(points), jnp.asarray(ring)), expected, atol=1e-12)


@pytest.mark.parametrize("rings", [0, RINGS])
def test_without_corrections_points_stay_to_the_last_bit(rings):
    points, ring = some_points(20000)
    points = points.astype(np.float32)
    points[0], points[1] = 0.0, (0.0, 0.0, -3.0)
    lidar = lidar_with(ring_elevation_offset=np.zeros(rings), ring_range_offset=np.zeros(rings))
    same = jax.jit(lambda lidar, points, ring: lidar.corrected(points, ring))(lidar, points, ring)
    assert same.dtype == jnp.float32
    np.testing.assert_array_equal(same, points)


def test_a_point_on_the_axis_keeps_its_direction():
    points = jnp.array([[0.0, 0.0, 4.0], [0.0, 0.0, -4.0], [0.0, 0.0, 0.0]])
    lidar = lidar_with(elevation_offset=0.01, range_offset=0.5)
    moved = lidar.corrected(points, jnp.zeros(3, jnp.int32))
    np.testing.assert_allclose(moved, [[0, 0, 4.5], [0, 0, -4.5], [0, 0, 0]], atol=1e-12)


def test_derivatives_are_finite_at_the_origin_and_on_the_axis():
    points = jnp.array([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [1e-30, 0.0, -2.0], [3.0, -4.0, 1.0]])
    ring = jnp.array([0, 1, -1, 1], jnp.int32)
    for dtype in (jnp.float32, jnp.float64):
        lidar = lidar_with(ring_elevation_offset=np.zeros(2), ring_range_offset=np.zeros(2))
        by_lidar, by_points = jax.jacrev(lambda lidar, points: lidar.corrected(points, ring), (0, 1))(
            lidar, points.astype(dtype)
        )
        for slope in jax.tree.leaves((by_lidar, by_points)):
            assert np.all(np.isfinite(slope))


def test_derivatives_agree_with_central_differences():
    points, ring = some_points(50)

    def corrected(elevation, added, scale, by_ring):
        lidar = lidar_with(
            elevation_offset=elevation,
            range_offset=added,
            range_scale=scale,
            ring_elevation_offset=by_ring[0],
            ring_range_offset=by_ring[1],
        )
        return lidar.corrected(jnp.asarray(points), jnp.asarray(ring))

    at = (jnp.array(0.003), jnp.array(0.02), jnp.array(1.001), jnp.full((2, RINGS), 0.001))
    check_grads(corrected, at, order=1, modes=("fwd", "rev"), rtol=1e-5, eps=1e-5)


def test_a_thinned_scan_is_corrected_and_holds_the_same_rows():
    points, ring = some_points(2000)
    count = len(points)
    scan = Scan(
        points=jnp.asarray(points, jnp.float32),
        time=jnp.zeros(count),
        ring=jnp.asarray(ring),
        intensity=jnp.zeros(count),
        mask=jnp.ones(count, bool),
        duration=jnp.float32(0.1),
        interval=jnp.float32(0.1),
    )
    args = scan, jnp.float32(0.3), jnp.float32(1.0), 1024, 256
    plain = thinned(PLAIN, *args)
    lidar = lidar_with(elevation_offset=0.01, ring_range_offset=np.linspace(-0.1, 0.1, RINGS))
    moved = thinned(lidar, *args)
    np.testing.assert_array_equal(moved.mask, plain.mask)
    np.testing.assert_array_equal(moved.matched.index, plain.matched.index)
    real = np.asarray(plain.mask)
    measured = np.asarray(scan.points)
    chosen = [np.flatnonzero(np.all(measured == row, axis=1))[0] for row in np.asarray(plain.points)[real]]
    expected = lidar.corrected(jnp.asarray(measured[chosen]), jnp.asarray(ring[chosen]))
    np.testing.assert_allclose(np.asarray(moved.points)[real], expected, rtol=1e-6, atol=1e-6)
    assert not np.any(np.asarray(moved.points)[~real])


def test_feature_clouds_are_corrected_by_their_rings():
    points, ring = some_points(60)
    mask = np.arange(60) < 50
    clouds = [
        FeatureCloud(jnp.asarray(points * real[:, None]), jnp.zeros(60), jnp.asarray(ring), jnp.asarray(real))
        for real in (mask & (ring % 2 == 0), mask & (ring % 2 == 1))
    ]
    features = LioSamFeatures(*clouds, jnp.int32(3))
    lidar = lidar_with(elevation_offset=0.01, ring_range_offset=np.linspace(-0.1, 0.1, RINGS))
    moved = corrected_clouds(lidar, features)
    for before, after in zip(clouds, (moved.corner, moved.surface), strict=True):
        np.testing.assert_array_equal(after.points, lidar.corrected(before.points, before.ring))
        np.testing.assert_array_equal(after.mask, before.mask)
    assert moved.dropped == 3
