"""A scan against the one before it: matches pass through points of the right rings, known motions return."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.core.types import CONVERGED, LOST
from lio_jax.lidar.features import loam_features
from lio_jax.lidar.params import LoamRingConfig
from lio_jax.mapping.feature_map import FeaturePoints
from lio_jax.registration.gauss_newton import gauss_newton
from lio_jax.registration.scan_match import FixedPoints
from lio_jax.registration.scan_to_scan import ScanToScan, empty_scan, last_scan
from lio_jax.settings.settings import recipe_settings, with_overrides
from tests.params import Config
from tests.recipes.drive import BEAMS, COLUMNS, lidar_pose, scan

SETTINGS = with_overrides(recipe_settings("loam"), ["params.lidar.min_range=0.5"])
PARAMS = SETTINGS.params()
CONFIG = Config(features=LoamRingConfig(rings=BEAMS, columns=COLUMNS + 64, surface_points=4096))
SLOW = np.array([1.5, 0.3, 0.1, 0.02, -0.03, 0.3])
"""Twist: m/s, then rad/s."""
_features = jax.jit(partial(loam_features, CONFIG))


def identity() -> jaxlie.SE3:
    return jaxlie.SE3(jnp.array([1.0, 0, 0, 0, 0, 0, 0], jnp.float64))


def prepared(number: int):
    """Return the features of a compensated scan of the hall."""
    return _features(PARAMS, scan(number, twist=SLOW, still=True))


def picks(features) -> FeaturePoints:
    return FeaturePoints(features.sharp.points, features.sharp.mask, features.flat.points, features.flat.mask)


def target(features):
    clouds = features.less_sharp, features.less_flat
    return last_scan(*clouds, *(cloud.points for cloud in clouds), BEAMS)


def match(last, points, prediction, params) -> ScanToScan:
    return ScanToScan(
        points_at=FixedPoints(points),
        T_predicted=prediction,
        registration=params.registration,
        lidar=params.lidar,
        last=last,
        limits=params.scan_to_scan,
    )


@partial(jax.jit, static_argnums=(3, 4))
def _matched(last, points, prediction, rounds=2, iterations=4, params=PARAMS):
    return gauss_newton(match(last, points, prediction, params), rounds, iterations)


@jax.jit
def _associated(last, points, T):
    return match(last, points, T, PARAMS).associate(points, T)


def test_lines_and_planes_pass_through_points_of_the_right_rings():
    last, now = prepared(0), prepared(1)
    matches = _associated(target(last), picks(now), identity())

    def on(planes, cloud) -> list[set[int]]:
        """Return, for each plane, the rings of the cloud's points on it that are near the query."""
        mask = np.asarray(cloud.mask)
        points, ring = np.asarray(cloud.points, float)[mask], np.asarray(cloud.ring)[mask]
        distance = points @ np.asarray(planes.normal, float).T + np.asarray(planes.offset, float)
        return [set(ring[np.abs(distance[:, k]) < 2e-4]) for k in range(distance.shape[1])]

    lines, planes = matches.lines, matches.planes
    assert int(np.asarray(lines.first.valid).sum()) > 50
    assert int(np.asarray(planes.valid).sum()) > 200
    for first, second, valid in zip(
        on(lines.first, last.less_sharp),
        on(lines.second, last.less_sharp),
        np.asarray(lines.first.valid),
        strict=True,
    ):
        assert not valid or len(first & second) >= 2
    assert all(
        len(rings) >= 2
        for rings, valid in zip(on(planes, last.less_flat), planes.valid, strict=True)
        if valid
    )
    np.testing.assert_allclose(
        np.sum(np.asarray(lines.first.normal) * np.asarray(lines.second.normal), 1), 0, atol=1e-5
    )


@pytest.mark.parametrize("guess_off", [0.0, 0.1])
def test_the_motion_between_two_scans_comes_back(guess_off):
    moved = np.linalg.inv(lidar_pose(0.1, SLOW)) @ lidar_pose(0.2, SLOW)
    start = jaxlie.SE3.from_matrix(jnp.asarray(moved)) @ jaxlie.SE3.exp(
        guess_off * jnp.array([1.0, -0.5, 0.2, 0.05, 0.03, -0.1])
    )
    result = _matched(target(prepared(0)), picks(prepared(1)), start, 6, 10)
    off = np.asarray((jaxlie.SE3.from_matrix(jnp.asarray(moved)).inverse() @ result.T_world_lidar).log())
    assert result.status == CONVERGED
    assert np.linalg.norm(off[:3]) < 0.03
    assert np.linalg.norm(off[3:]) < 0.005
    assert not result.degenerate.any()


def test_without_corners_planes_alone_are_matched():
    now = prepared(1)
    points = picks(now)
    flat_only = FeaturePoints(
        points.corner, jnp.zeros_like(points.corner_mask), points.surface, points.surface_mask
    )
    result = _matched(target(prepared(0)), flat_only, identity(), 6, 10)
    moved = np.linalg.inv(lidar_pose(0.1, SLOW)) @ lidar_pose(0.2, SLOW)
    assert result.status == CONVERGED
    assert np.linalg.norm(np.asarray(result.T_world_lidar.translation()) - moved[:3, 3]) < 0.05


def test_nothing_to_match_with_leaves_the_prediction():
    guess = jaxlie.SE3.exp(jnp.array([0.3, 0.1, 0.0, 0.0, 0.01, 0.1]))
    features = CONFIG.features
    nothing = empty_scan(
        features.corners * features.sectors * features.rings, features.surface_points, features.rings
    )
    result = _matched(nothing, picks(prepared(1)), guess)
    assert result.status == LOST
    np.testing.assert_array_equal(result.T_world_lidar.wxyz_xyz, guess.wxyz_xyz)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result))
