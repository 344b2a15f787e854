"""Scan lines around corners: planes that contain the beams show nothing of the motion."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from lio_jax.mapping.voxel_map import VoxelMap, anchor_of, empty_map, insert
from lio_jax.registration.voxel_planes import Matches, PointNoise, ScanToVoxels, point_noise
from tests.registration.scenes import beams, params_with, pose

PARAMS = params_with()
NOISE, HEIGHT, FORWARD = 0.01, 1.8, 1.2
STEP = 0.7
CORNERS = [-60.0, *np.arange(18.0, 46.0, 4.0)]
WALLS = [9.5 - STEP * number for number in range(len(CORNERS))]
"""Where the houses begin along the street, and how far each stands from its middle, m."""
HERE, THERE = jaxlie.SE3.identity(), pose([FORWARD, 0, 0], [0, 0, 0])


def sweep(x: float, seed: int) -> np.ndarray:
    """Return what 16 beams see of a street whose houses stand nearer and nearer to its middle, from x, m."""
    rng = np.random.default_rng(seed)
    beam = beams(np.arange(-15.0, 16.0, 2.0), 1800)
    with np.errstate(divide="ignore", invalid="ignore"):
        reaches = [np.where(beam[:, 2] < 0, -HEIGHT / beam[:, 2], np.inf)]
        # walls along the street recede at the corners; walls across it face the sensor there
        for begin, end, along in zip(CORNERS, [*CORNERS[1:], 60.0], WALLS, strict=True):
            reach = along / np.abs(beam[:, 1])
            met = x + reach * beam[:, 0]
            reaches.append(np.where((met >= begin) & (met < end), reach, np.inf))
            reach = np.where(beam[:, 0] > 0, (begin - x) / beam[:, 0], np.inf)
            met = np.abs(reach * beam[:, 1])
            reaches.append(np.where((met >= along) & (met < along + STEP), reach, np.inf))
    reach = np.min(reaches, 0)
    seen = (reach < 60) & (reach * beam[:, 2] < 12)
    return beam[seen] * (reach + rng.normal(0, NOISE, len(reach)))[seen, None]


@partial(jax.jit, static_argnums=1)
def map_of_standing(scans: jax.Array, known: bool) -> VoxelMap:
    """Return the map of a sensor that stands at the origin, whose position the map is given or not."""
    anchor, corner = anchor_of(jnp.zeros(3), PARAMS.map.voxel_size)
    vmap, size = empty_map(65536), PARAMS.map.voxel_size.astype(jnp.float32)
    for points in scans:
        mask = jnp.any(points != 0, axis=1)
        placed = points - corner.astype(jnp.float32)
        vmap, _ = insert(vmap, placed, mask, anchor, size, jnp.float32(100), -corner if known else None)
    return vmap


def match_of(vmap: VoxelMap, points: jax.Array, T_predicted: jaxlie.SE3) -> ScanToVoxels:
    return ScanToVoxels(
        points_at=lambda _: points,
        T_predicted=T_predicted,
        registration=PARAMS.registration,
        map=vmap,
        mask=jnp.any(points != 0, axis=1),
        prediction_error=jnp.float64(0.1),
        map_params=PARAMS.map,
        lidar=PARAMS.lidar,
        least_width=0.18,
    )


@jax.jit
def associated(vmap: VoxelMap, points: jax.Array, T: jaxlie.SE3) -> tuple[Matches, PointNoise]:
    """Return what the points lie on at a pose, and their distances."""
    match = match_of(vmap, points, T)
    found = match.associate(points, T)
    return found, point_noise(found, points, T, match.frame(), PARAMS.lidar)


def scans_of(x: float, seeds: range) -> jax.Array:
    scans = np.zeros((len(seeds), 28800, 3), np.float32)
    for row, seed in zip(scans, seeds, strict=True):
        points = sweep(x, seed)
        row[: len(points)] = points
    return jnp.asarray(scans)


def test_far_corners_tell_nothing_of_the_height():
    moved = scans_of(FORWARD, range(90, 91))[0]
    far = np.linalg.norm(moved, axis=1) > 18

    def information(known: bool) -> np.ndarray:
        """Return the information that far points give on the height, 1/m^2, and the wrong part of it."""
        sums = np.zeros(2)
        for first in (0, 10, 20, 30):
            vmap = map_of_standing(scans_of(0.0, range(first, first + 5)), known)
            found, noise = associated(vmap, moved, THERE)
            each = np.where(far, noise.precision * found.normal[:, 2] ** 2, 0.0)
            sums += each.sum(), each[np.abs(noise.distance) > 5 * NOISE].sum()
        return sums

    given, wrong = information(False)
    assert wrong > 0.3 * given
    assert information(True)[0] < 0.05 * given


def test_planes_of_beams_have_no_match_unless_there_is_hardly_any_other():
    scans = scans_of(0.0, range(3))
    every, _ = associated(map_of_standing(scans, False), scans[0], HERE)
    some, _ = associated(map_of_standing(scans, True), scans[0], HERE)
    left_out = np.asarray(every.used & ~some.used)
    beam = np.asarray(scans[0]) / np.maximum(np.linalg.norm(scans[0], axis=1), 1e-6)[:, None]
    sine = np.abs(np.sum(beam * np.asarray(every.normal), axis=1))
    assert left_out.sum() > 500
    assert np.median(sine[left_out]) < 0.05
    assert np.mean(left_out[np.asarray(every.used) & (sine > 0.15)]) < 0.03
    # far points alone lie in voxels of one scan line each
    far = jnp.where(jnp.linalg.norm(scans[0], axis=1, keepdims=True) > 22, scans[0], 0)
    alone = far[None]
    (every, _), (some, _) = (associated(map_of_standing(alone, known), far, HERE) for known in (False, True))
    np.testing.assert_array_equal(every.used, some.used)
