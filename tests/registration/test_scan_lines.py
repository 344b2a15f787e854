"""Planes through single scan lines: they hide a turn of the sensor, and a voxel of few points is none."""

from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.mapping.voxel_map import VoxelMap
from lio_jax.registration.gauss_newton import gauss_newton
from lio_jax.registration.voxel_planes import Matches, ScanToVoxels
from tests.registration.scenes import beams, map_of, params_with

PARAMS = params_with()
NOISE, PITCH, POINTS = 0.02, 4e-3, 8500
HERE = jaxlie.SE3.identity()


def sweep(pitch: float, seed: int) -> np.ndarray:
    """Return what 32 beams see between two walls, 16 m apart and 8 m high; the noise lies along the beams."""
    rng = np.random.default_rng(seed)
    beam = beams(np.linspace(-25.0, 15.0, 32), 1200)
    seen = beam @ Rotation.from_euler("y", pitch).as_matrix().T
    with np.errstate(divide="ignore"):
        to_ground = np.where(seen[:, 2] < 0, -1.8 / seen[:, 2], np.inf)
        to_wall = 8.0 / np.abs(seen[:, 1])
    reach = np.minimum(to_ground, to_wall)
    met = (reach < 60) & (reach * seen[:, 2] < 6.2)
    return beam[met] * (reach + rng.normal(0, NOISE, len(reach)))[met, None]


def match_of(vmap: VoxelMap, points: jax.Array, plane_points: float | None) -> ScanToVoxels:
    return ScanToVoxels(
        points_at=lambda _: points,
        T_predicted=HERE,
        registration=PARAMS.registration,
        map=vmap,
        mask=jnp.ones(len(points), bool),
        prediction_error=jnp.float64(0.1),
        map_params=PARAMS.map,
        lidar=PARAMS.lidar,
        plane_points=None if plane_points is None else jnp.float64(plane_points),
    )


@partial(jax.jit, static_argnums=2)
def associated(vmap: VoxelMap, points: jax.Array, plane_points: float | None) -> Matches:
    return match_of(vmap, points, plane_points).associate(points, HERE)


@partial(jax.jit, static_argnums=2)
def turned(vmap: VoxelMap, points: jax.Array, plane_points: float | None) -> jax.Array:
    return gauss_newton(match_of(vmap, points, plane_points), 60).T_world_lidar.rotation().log()[1]


def thinned(points: np.ndarray, spacing: float) -> np.ndarray:
    """Return one point per cube."""
    _, kept = np.unique(np.floor(points / spacing).astype(int), axis=0, return_index=True)
    return points[kept]


def first_two(seed: int) -> tuple[VoxelMap, jax.Array]:
    """Return a map of one scan, and the next scan, seen after the sensor has pitched."""
    held = thinned(sweep(0.0, 2 * seed), 0.25)
    seen = thinned(sweep(PITCH, 2 * seed + 1), 0.4)[:POINTS]
    return map_of(held, PARAMS), jnp.asarray(seen, jnp.float32)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_planes_through_single_scan_lines_hide_a_part_of_the_first_pitch(seed):
    vmap, points = first_two(seed)
    assert turned(vmap, points, None) < 0.8 * PITCH
    assert turned(vmap, points, 6.0) == pytest.approx(PITCH, rel=0.15)


def test_voxels_of_few_points_are_left_out_unless_hardly_any_is_left():
    vmap, points = first_two(0)
    everywhere = associated(vmap, points, None)
    few = everywhere.used & (everywhere.count < 6)
    assert jnp.sum(few) > 100
    some = associated(vmap, points, 6.0)
    assert jnp.min(jnp.where(some.used, some.count, jnp.inf)) == 6
    assert jnp.sum(some.used) > len(points) / 2
    # the richest voxels hold less than half of the points
    richest = jnp.sort(everywhere.count)[-len(points) // 10] + 1
    jax.tree.map(np.testing.assert_array_equal, associated(vmap, points, float(richest)), everywhere)
