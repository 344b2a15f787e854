"""Features of whole scans, made up and real, against the sequential rule and numpy's groups."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial import cKDTree

from lio_jax.lidar.features import lio_sam_features, lio_sam_rings, loam_features, loam_rings
from lio_jax.run.scan_inputs import padded
from tests.lidar.ring_scans import (
    LIO_SAM_PARAMS,
    LOAM_PARAMS,
    RECORDINGS,
    config_of,
    on_device,
    random_scan,
    real_scans,
    scan_of,
)
from tests.lidar.sequential import A_LOAM, LIO_SAM, Rule, pick_ring
from tests.lidar.test_ring_voxel_mean import groups
from tests.shared_data import needs_shared


@partial(jax.jit, static_argnums=0)
def loam(config, params, scan):
    """Return the rings and the features of one program: rounding is the same in both."""
    return loam_rings(config, params, scan), loam_features(config, params, scan)


@partial(jax.jit, static_argnums=0)
def lio_sam(config, params, scan):
    return lio_sam_rings(config, params, scan), lio_sam_features(config, params, scan)


def features_of(features, config, params, scan):
    """Return the features only, by a program that other tests have compiled."""
    return (loam if features is loam_features else lio_sam)(config, params, scan)[1]


def arrays(rings) -> dict[str, np.ndarray]:
    """Return what is known along the rings, as numpy arrays."""
    return {
        "smoothness": np.asarray(rings.ring.smoothness),
        "open": np.asarray(rings.ring.open),
        # a point reaches the next one if they are connected
        "connected": np.asarray(rings.ring.after) > 0,
        "count": np.asarray(rings.image.count),
        "xyz": np.stack([np.asarray(axis) for axis in rings.xyz], -1),
        "time": np.asarray(rings.time),
    }


def sequential_picks(known: dict[str, np.ndarray], rule: Rule) -> dict[str, list[tuple[int, int]]]:
    """Return (place, ring) of all picks, sharpest corners and all corners and flat points apart."""
    wanted: dict[str, list[tuple[int, int]]] = {"sharp": [], "corners": [], "flats": []}
    for ring, count in enumerate(known["count"].tolist()):
        corners, flats = pick_ring(
            *(known[name][:, ring] for name in ("smoothness", "open", "connected")), count, rule
        )
        wanted["sharp"] += [(place, ring) for sector in corners for place in sector[:2]]
        wanted["corners"] += [(place, ring) for sector in corners for place in sector]
        wanted["flats"] += [(place, ring) for sector in flats for place in sector]
    return wanted


def assert_cloud_is(cloud, places: list[tuple[int, int]], known: dict[str, np.ndarray]) -> None:
    """Compare a cloud with the points at places along the rings."""
    mask = np.asarray(cloud.mask)
    found = np.c_[cloud.ring, cloud.time, cloud.points][mask]
    place, ring = np.array(places or np.zeros((0, 2)), int).T
    wanted = np.c_[ring, known["time"][place, ring], known["xyz"][place, ring]]
    np.testing.assert_array_equal(found[np.lexsort(found.T)], wanted[np.lexsort(wanted.T)])
    assert not np.asarray(cloud.points)[~mask].any()


def assert_surface_is_the_rest(
    cloud, corners: list[tuple[int, int]], known: dict[str, np.ndarray], size: float
) -> None:
    """Compare the surface cloud with the means of all points that are no corners."""
    rest = np.zeros(known["smoothness"].shape, bool)
    for ring, count in enumerate(known["count"].tolist()):
        rest[5 : max(count - 5, 5), ring] = True
    if corners:
        rest[tuple(np.array(corners).T)] = False
    wanted = groups(known["xyz"], known["time"], rest, np.float32(size))
    mask = np.asarray(cloud.mask)
    assert mask.sum() == len(wanted)
    # rings and times count as far apart as metres, so that each row's nearest is its own
    scale = np.array([1e3, 1, 1, 1, 1e2])
    wanted_rows = scale * [[key[0], *row] for key, row in wanted.items()]
    found_rows = scale * np.c_[cloud.ring, cloud.points, cloud.time][mask].astype(float)
    distance, row = cKDTree(wanted_rows).query(found_rows)
    assert len(np.unique(row)) == len(wanted)
    assert distance.max() < 5e-5


def assert_loam_as_in_sequence(config, scan, surface: bool = True) -> dict[str, list]:
    rings, found = loam(config, LOAM_PARAMS, scan)
    known = arrays(rings)
    picks = sequential_picks(known, A_LOAM)
    assert_cloud_is(found.sharp, picks["sharp"], known)
    assert_cloud_is(found.less_sharp, picks["corners"], known)
    assert_cloud_is(found.flat, picks["flats"], known)
    if surface:
        assert_surface_is_the_rest(found.less_flat, picks["corners"], known, 0.2)
    assert int(found.dropped) == 0
    return picks


def assert_lio_sam_as_in_sequence(config, scan, surface: bool = True) -> dict[str, list]:
    rings, found = lio_sam(config, LIO_SAM_PARAMS, scan)
    known = arrays(rings)
    picks = sequential_picks(known, LIO_SAM)
    assert_cloud_is(found.corner, picks["corners"], known)
    if surface:
        assert_surface_is_the_rest(found.surface, picks["corners"], known, 0.4)
    assert int(found.dropped) == 0
    return picks


SIZE = 131072
"""All real scans are padded to this, so that they share a program."""

SMALL = {"rings": 8, "columns": 500, "surface_points": 4096}


@pytest.mark.parametrize("seed", range(5))
def test_loam_on_scans_with_holes(seed):
    picks = assert_loam_as_in_sequence(config_of(**SMALL), random_scan(seed))
    assert min(len(kind) for kind in picks.values()) > 20


@pytest.mark.parametrize("order", ["arrival", "azimuth"])
@pytest.mark.parametrize("seed", range(3))
def test_lio_sam_on_scans_with_holes(seed, order):
    config = config_of(**SMALL, order=order)
    picks = assert_lio_sam_as_in_sequence(config, random_scan(seed))
    assert len(picks["corners"]) > 20


@needs_shared
@pytest.mark.parametrize("name", RECORDINGS)
def test_loam_on_every_real_scan(name):
    for number, (scan, beams) in enumerate(real_scans(name)):
        config = config_of(rings=beams, columns=2304 if beams == 64 else 1024, surface_points=65536)
        padded_scan = on_device(padded(scan, None, config.lidar, SIZE))
        picks = assert_loam_as_in_sequence(config, padded_scan, surface=number == 0)
        assert len(picks["corners"]) > 500
        assert len(picks["flats"]) > 200


@needs_shared
@pytest.mark.parametrize("name", RECORDINGS)
def test_lio_sam_on_every_real_scan(name):
    for number, (scan, beams) in enumerate(real_scans(name)):
        config = config_of(rings=beams, columns=1800 if beams == 64 else 1024, order="azimuth")
        padded_scan = on_device(padded(scan, None, config.lidar, SIZE))
        picks = assert_lio_sam_as_in_sequence(config, padded_scan, surface=number == 0)
        assert len(picks["corners"]) > 100


@needs_shared
def test_what_is_known_along_the_rings_of_a_real_scan_is_that_of_the_formulas():
    scan, beams = next(real_scans("kitti_odometry_04"))
    on_device_scan = on_device(padded(scan, None, config_of().lidar))
    known = arrays(loam(config_of(rings=beams), LOAM_PARAMS, on_device_scan)[0])
    for ring in range(beams):
        count = known["count"][ring]
        p = known["xyz"][:count, ring].astype(float)
        np.testing.assert_array_equal(known["xyz"][:count, ring], scan.points[scan.ring == ring])
        window = np.lib.stride_tricks.sliding_window_view(p, 11, axis=0)
        bend = window.sum(-1) - 11 * p[5:-5]
        size = np.abs(window - p[5:-5, :, None]).sum(-1)
        off = known["smoothness"][5 : count - 5, ring] - (bend**2).sum(-1)
        assert (np.abs(off) <= 3e-6 * (size**2).sum(-1)).all()
        gap = (np.diff(p, axis=0) ** 2).sum(-1)
        wrong = known["connected"][: count - 1, ring] != (gap <= 0.05)
        assert (np.abs(gap[wrong] - 0.05) < 1e-8).all()
        # beyond the ring the next "point" is the origin, farther away than any gap
        assert not known["connected"][count - 1, ring]


def test_a_corner_of_two_walls_is_the_sharpest_point_and_walls_are_flat():
    azimuth = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    half = 6.0  # a square room, the sensor in its middle
    distance = half / np.maximum(np.abs(np.cos(azimuth)), np.abs(np.sin(azimuth)))
    level = np.repeat([0.0, 0.4], 720)
    points = np.c_[np.tile(distance * np.cos(azimuth), 2), np.tile(distance * np.sin(azimuth), 2), level]
    scan = scan_of(points, np.repeat([0, 1], 720))
    found = loam(config_of(rings=2, columns=720), LOAM_PARAMS, scan)[1]
    sharp = np.asarray(found.sharp.points)[np.asarray(found.sharp.mask)]
    assert len(sharp) >= 8
    np.testing.assert_allclose(np.abs(sharp[:, :2]), half, atol=0.06)
    flat = np.asarray(found.flat.points)[np.asarray(found.flat.mask)]
    assert len(flat) == 2 * 6 * 4
    assert (np.abs(flat[:, :2]).min(1) < half - 0.5).all()


@pytest.mark.parametrize("features", [loam_features, lio_sam_features])
def test_a_scan_without_points_has_no_features(features):
    scan = scan_of(np.full((40, 3), np.nan), np.zeros(40))
    found = features_of(features, config_of(**SMALL), LOAM_PARAMS, scan)
    for leaf in jax.tree.leaves(found):
        assert not np.asarray(leaf).any()


@pytest.mark.parametrize("features", [loam_features, lio_sam_features])
def test_points_beyond_the_capacity_are_counted(features):
    config = config_of(**SMALL | {"rings": 6, "surface_points": 100})
    found = features_of(features, config, LOAM_PARAMS, random_scan(0))
    surface = found.less_flat if features is loam_features else found.surface
    whole = features_of(features, config_of(**SMALL), LOAM_PARAMS, random_scan(0))
    assert int(whole.dropped) == 0
    assert int(surface.mask.sum()) == pytest.approx(100, abs=2)
    assert int(found.dropped) > 500


@pytest.mark.parametrize("features", [loam_features, lio_sam_features])
def test_changing_any_threshold_recompiles_nothing_and_changes_the_features(features):
    config, scan = config_of(**SMALL, order="azimuth"), random_scan(1)
    step = jax.jit(lambda params, scan: features(config, params, scan))
    before = step(LIO_SAM_PARAMS, scan)
    changed = jax.tree.map(lambda leaf: leaf * 0.5, LIO_SAM_PARAMS.features)
    after = step(type(LIO_SAM_PARAMS)(**{**vars(LIO_SAM_PARAMS), "features": changed}), scan)
    assert step._cache_size() == 1
    for kind in ("less_sharp", "less_flat") if features is loam_features else ("corner", "surface"):
        assert not np.array_equal(getattr(before, kind).points, getattr(after, kind).points)


@pytest.mark.parametrize("features", [loam_features, lio_sam_features])
def test_thresholds_batch(features):
    config, scan = config_of(**SMALL), random_scan(2)
    scales = jnp.array([0.5, 1.0, 3.0])
    scaled = [jax.tree.map(lambda leaf, s=s: leaf * s, LOAM_PARAMS.features) for s in scales]
    params = [type(LOAM_PARAMS)(**{**vars(LOAM_PARAMS), "features": one}) for one in scaled]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *params)
    together = jax.jit(jax.vmap(lambda p: features(config, p, scan)))(batch)
    for row, one in enumerate(params):
        alone = features_of(features, config, one, scan)
        for some, other in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(some[row], other, atol=1e-6)


@pytest.mark.parametrize("features", [loam_features, lio_sam_features])
def test_features_have_the_gradient_of_their_points(features):
    """Every feature is a point or a mean of points: moving the scan moves all of them as much."""
    config, scan = config_of(**SMALL), random_scan(3)

    def moved(shift):
        points = jnp.where(scan.mask[:, None], scan.points + shift, scan.points)
        found = features(config, LOAM_PARAMS, type(scan)(**{**vars(scan), "points": points}))
        return [getattr(found, kind).points for kind in vars(found) if kind != "dropped"]

    found = features_of(features, config, LOAM_PARAMS, scan)
    masks = [getattr(found, kind).mask for kind in vars(found) if kind != "dropped"]
    shift = jnp.array([1.0, -2.0, 0.5], jnp.float32)
    _, slopes = jax.jit(lambda along: jax.jvp(moved, (jnp.zeros(3, jnp.float32),), (along,)))(shift)
    for slope, mask in zip(slopes, masks, strict=True):
        np.testing.assert_allclose(slope, np.where(np.asarray(mask)[:, None], shift, 0.0), atol=2e-6)
