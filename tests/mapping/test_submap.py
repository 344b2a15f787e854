"""Keyframes in the map: moved there once, each from its own pose."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np

from lio_jax.mapping.feature_map import (
    FeaturePoints,
    Submap,
    empty_feature_map,
    frames_at,
    rebuilt,
    with_scan,
)
from lio_jax.mapping.keyframes import no_keyframes
from lio_jax.mapping.nearest_points import nearest_points
from lio_jax.settings.settings import recipe_settings

PARAMS = recipe_settings("lio_sam").params()
CORNERS, SURFACES = 64, 256
_add = jax.jit(partial(with_scan, map_params=PARAMS.map, point_map=PARAMS.point_map, settings=PARAMS.submap))


def points(seed: int) -> FeaturePoints:
    rng = np.random.default_rng(seed)
    corner, surface = (rng.uniform(-15, 15, (count, 3)) for count in (CORNERS, SURFACES))
    return FeaturePoints(
        jnp.asarray(corner), jnp.asarray(rng.uniform(size=CORNERS) < 0.8),
        jnp.asarray(surface), jnp.asarray(rng.uniform(size=SURFACES) < 0.8),
    )  # fmt: skip


def empty(capacity: int = 32) -> Submap:
    keyframes = no_keyframes(capacity, CORNERS, SURFACES, jnp.dtype(jnp.float64))
    return Submap(keyframes, empty_feature_map(4096))


def pose(x: float) -> jaxlie.SE3:
    turn = jaxlie.SO3.from_rpy_radians(0.1, -0.2, 0.01 * x)
    return jaxlie.SE3.from_rotation_and_translation(turn, jnp.array([x, 0.5 * x, 1.0]))


def in_map(submap: Submap, T: jaxlie.SE3, own: FeaturePoints) -> np.ndarray:
    """Return how far each surface point, placed in world, is from the nearest one in the map, m."""
    frame = frames_at(T.translation(), PARAMS.map).surface
    world = np.asarray(T.apply(own.surface))[np.asarray(own.surface_mask)]
    local = jnp.asarray(world - np.asarray(frame.origin))
    size = PARAMS.map.voxel_size.astype(jnp.float32)
    mask = jnp.ones(len(local), bool)
    found = nearest_points(submap.features.surface, local, mask, frame.anchor, size, 1)
    return np.sqrt(np.asarray(found.squared_distance[0]))


def test_a_keyframes_points_are_where_its_pose_says():
    submap, _, placed, added = _add(empty(), jnp.array(True), points(1), pose(3.0), jnp.asarray(0.0))
    # each is in the map, or the one that its voxel keeps is
    distance = in_map(submap, pose(3.0), points(1))
    assert np.mean(distance < 1e-4) > 0.95
    assert distance.max() < PARAMS.map.voxel_size * 3**0.5
    assert int(added[1].added[:SURFACES].sum()) == int(np.sum(distance < 1e-4))
    assert placed.surface.shape == (SURFACES, 3)


def test_a_scan_that_is_no_keyframe_is_placed_but_not_kept():
    submap, _, placed, added = _add(empty(), jnp.array(False), points(1), pose(3.0), jnp.asarray(0.0))
    assert not added[0].added.any()
    assert not added[1].added.any()
    assert np.isinf(np.asarray(submap.keyframes.time)).all()
    kept = _add(empty(), jnp.array(True), points(1), pose(3.0), jnp.asarray(0.0))
    np.testing.assert_array_equal(placed.surface, kept[2].surface)


def test_a_keyframe_enters_anew_when_the_vehicle_comes_back():
    submap = _add(empty(), jnp.array(True), points(1), pose(0.0), jnp.asarray(0.0))[0]
    # far enough for the box to move on and to drop what was there
    for number, x in enumerate((150.0, 300.0, 450.0)):
        time = jnp.asarray(20.0 * (number + 1))
        submap = _add(submap, jnp.array(True), points(2 + number), pose(x), time)[0]
    assert in_map(submap, pose(0.0), points(1)).min() > 1
    # back: first where the keyframe is too far off, then near it
    submap = _add(submap, jnp.array(False), points(9), pose(60.0), jnp.asarray(90.0))[0]
    assert in_map(submap, pose(0.0), points(1)).min() > 1
    submap = _add(submap, jnp.array(False), points(9), pose(10.0), jnp.asarray(95.0))[0]
    distance = in_map(submap, pose(0.0), points(1))
    assert np.mean(distance < 1e-3) > 0.95


def test_a_map_built_anew_holds_the_keyframes_around_at_their_new_poses():
    submap = empty()
    for number, x in enumerate((0.0, 20.0, 90.0)):
        time = jnp.asarray(20.0 * number)
        submap = _add(submap, jnp.array(True), points(1 + number), pose(x), time)[0]
    sparse = submap.keyframes.sparse.at[submap.keyframes.last].set(False)
    submap = eqx.tree_at(lambda some: some.keyframes.sparse, submap, sparse)
    poses = submap.keyframes.T_world_lidar.wxyz_xyz.at[:, 4:].add(jnp.array([500.0, 7.0, -3.0]))
    moved = [jaxlie.SE3(poses[np.flatnonzero(submap.keyframes.number == number)[0]]) for number in range(3)]
    again = partial(rebuilt, map_params=PARAMS.map, point_map=PARAMS.point_map, settings=PARAMS.submap)
    submap = jax.jit(again)(submap, jaxlie.SE3(poses), moved[2], jnp.asarray(41.0))
    by_number = dict(zip(submap.keyframes.number.tolist(), submap.keyframes.entered.tolist(), strict=True))
    assert by_number == {0: False, 1: False, 2: True, -1: False}
    assert np.mean(in_map(submap, moved[2], points(3)) < 1e-3) > 0.95
    assert in_map(submap, moved[0], points(1)).min() > 1
    submap = jax.jit(again)(submap, jaxlie.SE3(poses), moved[1], jnp.asarray(80.0))
    by_number = dict(zip(submap.keyframes.number.tolist(), submap.keyframes.entered.tolist(), strict=True))
    assert by_number == {0: True, 1: True, 2: False, -1: False}
    held = [np.mean(in_map(submap, moved[number], points(1 + number)) < 1e-3) for number in (0, 1)]
    assert min(held) > 0.8
