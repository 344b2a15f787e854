"""Ray casting against closed-form ranges, one shape after another."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.sim.casting import DTYPES, cast_into, world_of


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
def test_ground_range_is_height_over_sine(dtype, tolerance):
    depression = np.deg2rad([1.0, 5.0, 25.0, 90.0])
    directions = np.stack([np.cos(depression), 0 * depression, -np.sin(depression)], axis=1)
    hit = cast_into(world_of(dtype, planes=[[3, 4, -1.7, 0, 0, 1]]), [0, 0, 0], directions)
    np.testing.assert_allclose(hit.distance, 1.7 / np.sin(depression), atol=tolerance)
    np.testing.assert_allclose(hit.normal, np.tile([0, 0, 1], (4, 1)), atol=1e-6)


def test_plane_is_seen_from_below_with_its_normal_turned():
    hit = cast_into(
        world_of(jnp.float64, planes=[[0, 0, 2, 0, 0, 1]]), [0, 0, 0], [[0, 0, 1], [0, 0, -1], [1, 0, 0]]
    )
    np.testing.assert_allclose(hit.distance, [2, np.inf, np.inf])
    np.testing.assert_allclose(hit.normal[0], [0, 0, -1])


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
def test_box_faces_of_a_turned_box(dtype, tolerance):
    yaw = 0.4
    turn = Rotation.from_euler("z", yaw).as_matrix()
    half = np.array([2.0, 1.0, 1.5])
    center = np.array([12.0, -3.0, 0.5])
    # straight at a point of every face from 7 m in front of it
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    on_face = axes * half + 0.3 * half * (axes == 0)
    origins = (on_face + 7 * axes) @ turn.T + center
    hit = cast_into(world_of(dtype, boxes=[[*center, *half, yaw]]), origins, -axes @ turn.T)
    np.testing.assert_allclose(hit.distance, 7, atol=tolerance)
    np.testing.assert_allclose(hit.normal, axes @ turn.T, atol=1e-6)
    np.testing.assert_allclose(hit.reflectivity, 0.2, atol=1e-6)


def test_box_from_inside_and_beside():
    hit = cast_into(
        world_of(jnp.float64, boxes=[[0, 0, 0, 5, 4, 3, 0]]),
        [[1, 0, 0], [0, 0, 0], [0, 4.001, 0], [-9, 0, 0]],
        [[1, 0, 0], [0, 0, -1], [1, 0, 0], [-1, 0, 0]],
    )
    np.testing.assert_allclose(hit.distance, [4, 3, np.inf, np.inf])


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
def test_thin_pole_far_away(dtype, tolerance):
    # a horizontal ray that passes the axis at distance d meets the wall at D - sqrt(r^2 - d^2)
    radius, distance = 0.05, 80.0
    aside = np.array([0.0, 0.02, -0.04, 0.049, 0.051])
    origins = np.stack([0 * aside, aside, 0 * aside], axis=1)
    hit = cast_into(
        world_of(dtype, cylinders=[[distance, 0, -2, radius, 6]]),
        origins,
        np.tile([1, 0, 0], (len(aside), 1)),
    )
    wall = distance - np.sqrt(np.maximum(radius**2 - aside**2, 0))
    np.testing.assert_allclose(hit.distance, np.where(np.abs(aside) < radius, wall, np.inf), atol=tolerance)


def test_cylinder_wall_in_perspective_and_caps():
    radius, base, height = 0.5, np.array([4.0, 3.0, 1.0]), 2.0
    # through the wall's nearest line, 4.5 m away horizontally
    upwards = np.array([4.0 * 0.9, 3.0 * 0.9, 1.5])
    hit = cast_into(
        world_of(jnp.float64, cylinders=[[*base, radius, height]]),
        [[0, 0, 0], [4.2, 3, 9], [4.2, 3, 0], [4.6, 3, 9], [4, 3, 2]],
        [upwards, [0, 0, -1], [0, 0, 1], [0, 0, -1], [1, 0, 0]],
    )
    np.testing.assert_allclose(hit.distance, [np.linalg.norm(upwards), 6, 1, np.inf, 0.5], atol=1e-12)
    np.testing.assert_allclose(hit.normal[:3], [[-0.8, -0.6, 0], [0, 0, 1], [0, 0, -1]], atol=1e-12)
    np.testing.assert_allclose(hit.normal[3], 0)


def test_cylinder_is_not_hit_above_or_below():
    hit = cast_into(
        world_of(jnp.float64, cylinders=[[5, 0, 1, 0.5, 2]]), [0, 0, 0], [[1, 0, 0], [5, 0, 3.5], [5, 0, 2]]
    )
    assert np.isfinite(np.asarray(hit.distance)).tolist() == [False, False, True]


def test_the_nearest_of_all_kinds_wins():
    world = world_of(
        jnp.float64,
        planes=[[0, 0, -1, 0, 0, 1], [20, 0, 0, -1, 0, 0]],
        boxes=[[15, 0, 0, 1, 1, 1, 0], [10, 4, 0, 1, 1, 1, 0]],
        cylinders=[[10, 0, -1, 0.5, 3], [10, 4, -1, 0.5, 3]],
    )
    hit = cast_into(world, [[0, 0, 0], [0, 4, 0], [0, -4, 0]], np.tile([1, 0, 0], (3, 1)))
    np.testing.assert_allclose(hit.distance, [9.5, 9.0, 20.0])
    np.testing.assert_allclose(hit.reflectivity, [0.3, 0.2, 0.1])


def test_sphere_from_outside_inside_and_beside():
    hit = cast_into(
        world_of(jnp.float64, spheres=[[10, 0, 0, 2]]),
        [[0, 0, 0], [10.5, 0, 0], [0, 0, 2.001], [20, 0, 0], [0, 1, 0]],
        np.tile([1, 0, 0], (5, 1)),
    )
    np.testing.assert_allclose(hit.distance, [8, 1.5, np.inf, np.inf, 10 - np.sqrt(3)], atol=1e-12)
    np.testing.assert_allclose(hit.normal[:2], [[-1, 0, 0], [-1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(hit.normal[4], [-np.sqrt(3) / 2, 0.5, 0], atol=1e-12)


def test_small_sphere_far_away_in_single_precision():
    aside = np.array([0.0, 0.05, -0.09])
    origins = np.stack([0 * aside, aside, 0 * aside], axis=1)
    hit = cast_into(world_of(jnp.float32, spheres=[[90, 0, 0, 0.1]]), origins, np.tile([1, 0, 0], (3, 1)))
    np.testing.assert_allclose(hit.distance, 90 - np.sqrt(0.01 - aside**2), atol=5e-5)


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
def test_tilted_box_faces(dtype, tolerance):
    angles = [0.3, -0.5, 1.1]
    turn = Rotation.from_euler("xyz", angles).as_matrix()
    half, center = np.array([2.0, 1.0, 0.5]), np.array([5.0, -3.0, 1.0])
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    on_face = axes * half + 0.3 * half * (axes == 0)
    origins = (on_face + 7 * axes) @ turn.T + center
    hit = cast_into(world_of(dtype, tilted=[[*center, *half, *angles]]), origins, -axes @ turn.T)
    np.testing.assert_allclose(hit.distance, 7, atol=tolerance)
    np.testing.assert_allclose(hit.normal, axes @ turn.T, atol=1e-6)


def test_moving_box_is_met_where_it_is_when_the_ray_is_sent():
    world = world_of(jnp.float64, moving=[[1, 1, 1, 10, 0, 0, -2, 0, 0]])
    times = np.array([0.0, 0.05, 1.0])
    hit = cast_into(world, [0, 0, 0], np.tile([1, 0, 0], (3, 1)), times)
    np.testing.assert_allclose(hit.distance, 9 - 2 * times, atol=1e-12)
    np.testing.assert_allclose(hit.normal, np.tile([-1, 0, 0], (3, 1)), atol=1e-12)
