"""Ray casting against closed-form ranges and against a brute-force march through scipy-placed shapes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.sim.raycast import Hit, cast
from lio_jax.sim.worlds import Boxes, Cylinders, Planes, World, nearest_part

DTYPES = [(jnp.float64, 1e-9), (jnp.float32, 1e-4)]


def _world(dtype, planes=(), boxes=(), cylinders=()):
    """Rows: plane (point 3, normal 3), box (centre 3, half 3, yaw), cylinder (base 3, radius, height)."""
    p = np.reshape(planes, (-1, 6))
    b = np.reshape(boxes, (-1, 7))
    c = np.reshape(cylinders, (-1, 5))

    def array(values):
        return jnp.asarray(values, dtype)

    return World(
        Planes(array(p[:, :3]), array(p[:, 3:]), array(np.full(len(p), 0.1))),
        Boxes(array(b[:, :3]), array(b[:, 3:6]), array(b[:, 6]), array(np.full(len(b), 0.2))),
        Cylinders(array(c[:, :3]), array(c[:, 3]), array(c[:, 4]), array(np.full(len(c), 0.3))),
    )


def _cast(world, origins, directions) -> Hit:
    dtype = world.planes.point.dtype
    directions = np.asarray(directions, float)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(np.asarray(origins, float), directions.shape)
    return jax.jit(cast)(world, jnp.asarray(origins, dtype), jnp.asarray(directions, dtype))


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
def test_ground_range_is_height_over_sine(dtype, tolerance):
    depression = np.deg2rad([1.0, 5.0, 25.0, 90.0])
    directions = np.stack([np.cos(depression), 0 * depression, -np.sin(depression)], axis=1)
    hit = _cast(_world(dtype, planes=[[3, 4, -1.7, 0, 0, 1]]), [0, 0, 0], directions)
    np.testing.assert_allclose(hit.distance, 1.7 / np.sin(depression), atol=tolerance)
    np.testing.assert_allclose(hit.normal, np.tile([0, 0, 1], (4, 1)), atol=1e-6)


def test_plane_is_seen_from_below_with_its_normal_turned():
    hit = _cast(
        _world(jnp.float64, planes=[[0, 0, 2, 0, 0, 1]]), [0, 0, 0], [[0, 0, 1], [0, 0, -1], [1, 0, 0]]
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
    hit = _cast(_world(dtype, boxes=[[*center, *half, yaw]]), origins, -axes @ turn.T)
    np.testing.assert_allclose(hit.distance, 7, atol=tolerance)
    np.testing.assert_allclose(hit.normal, axes @ turn.T, atol=1e-6)
    np.testing.assert_allclose(hit.reflectivity, 0.2, atol=1e-6)


def test_box_from_inside_and_beside():
    hit = _cast(
        _world(jnp.float64, boxes=[[0, 0, 0, 5, 4, 3, 0]]),
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
    hit = _cast(
        _world(dtype, cylinders=[[distance, 0, -2, radius, 6]]), origins, np.tile([1, 0, 0], (len(aside), 1))
    )
    wall = distance - np.sqrt(np.maximum(radius**2 - aside**2, 0))
    np.testing.assert_allclose(hit.distance, np.where(np.abs(aside) < radius, wall, np.inf), atol=tolerance)


def test_cylinder_wall_in_perspective_and_caps():
    radius, base, height = 0.5, np.array([4.0, 3.0, 1.0]), 2.0
    # through the wall's nearest line, 4.5 m away horizontally
    upwards = np.array([4.0 * 0.9, 3.0 * 0.9, 1.5])
    hit = _cast(
        _world(jnp.float64, cylinders=[[*base, radius, height]]),
        [[0, 0, 0], [4.2, 3, 9], [4.2, 3, 0], [4.6, 3, 9], [4, 3, 2]],
        [upwards, [0, 0, -1], [0, 0, 1], [0, 0, -1], [1, 0, 0]],
    )
    np.testing.assert_allclose(hit.distance, [np.linalg.norm(upwards), 6, 1, np.inf, 0.5], atol=1e-12)
    np.testing.assert_allclose(hit.normal[:3], [[-0.8, -0.6, 0], [0, 0, 1], [0, 0, -1]], atol=1e-12)
    np.testing.assert_allclose(hit.normal[3], 0)


def test_cylinder_is_not_hit_above_or_below():
    hit = _cast(
        _world(jnp.float64, cylinders=[[5, 0, 1, 0.5, 2]]), [0, 0, 0], [[1, 0, 0], [5, 0, 3.5], [5, 0, 2]]
    )
    assert np.isfinite(np.asarray(hit.distance)).tolist() == [False, False, True]


def test_the_nearest_of_all_kinds_wins():
    world = _world(
        jnp.float64,
        planes=[[0, 0, -1, 0, 0, 1], [20, 0, 0, -1, 0, 0]],
        boxes=[[15, 0, 0, 1, 1, 1, 0], [10, 4, 0, 1, 1, 1, 0]],
        cylinders=[[10, 0, -1, 0.5, 3], [10, 4, -1, 0.5, 3]],
    )
    hit = _cast(world, [[0, 0, 0], [0, 4, 0], [0, -4, 0]], np.tile([1, 0, 0], (3, 1)))
    np.testing.assert_allclose(hit.distance, [9.5, 9.0, 20.0])
    np.testing.assert_allclose(hit.reflectivity, [0.3, 0.2, 0.1])


def test_random_rays_agree_with_signed_distances():
    """At the hit the union of shapes has signed distance zero, and nowhere before it is it negative."""
    rng = np.random.default_rng(0)
    boxes = np.column_stack(
        [rng.uniform(-20, 20, (8, 3)), rng.uniform(0.5, 4, (8, 3)), rng.uniform(-3, 3, 8)]
    )
    cylinders = np.column_stack([rng.uniform(-20, 20, (8, 3)), rng.uniform(0.2, 2, 8), rng.uniform(1, 6, 8)])
    origins = rng.uniform(-30, 30, (500, 3))
    directions = rng.normal(size=(500, 3)) - 0.05 * origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    outside = _signed_distance(boxes, cylinders, origins) > 0
    origins, directions = origins[outside], directions[outside]
    hit = _cast(_world(jnp.float64, boxes=boxes, cylinders=cylinders), origins, directions)
    distance = np.asarray(hit.distance)
    met = np.isfinite(distance)
    assert 50 < met.sum() < len(met)
    at_hit = origins[met] + distance[met, None] * directions[met]
    np.testing.assert_allclose(_signed_distance(boxes, cylinders, at_hit), 0, atol=1e-9)
    for share in np.linspace(0, 0.999, 200):
        on_ray = origins + share * np.where(met, distance, 100)[:, None] * directions
        assert np.all(_signed_distance(boxes, cylinders, on_ray) > -1e-9)


def _signed_distance(boxes, cylinders, points):
    nearest = np.full(len(points), np.inf)
    for *center, hx, hy, hz, yaw in boxes:
        local = np.abs(Rotation.from_euler("z", yaw).inv().apply(points - center)) - [hx, hy, hz]
        nearest = np.minimum(nearest, local.max(axis=1))
    for x, y, z, radius, height in cylinders:
        wall = np.hypot(points[:, 0] - x, points[:, 1] - y) - radius
        caps = np.abs(points[:, 2] - z - height / 2) - height / 2
        nearest = np.minimum(nearest, np.maximum(wall, caps))
    return nearest


def test_leaving_far_primitives_out_changes_nothing_within_reach():
    rng = np.random.default_rng(1)
    boxes = np.column_stack([rng.uniform(-60, 60, (60, 2)), np.zeros(60), np.ones((60, 3)), np.zeros(60)])
    cylinders = np.column_stack([rng.uniform(-60, 60, (50, 2)), -np.ones(50), np.ones(50), 2 * np.ones(50)])
    world = _world(jnp.float64, boxes=boxes, cylinders=cylinders)
    position = jnp.array([10.0, -5.0, 0.5])
    azimuth = np.linspace(0, 2 * np.pi, 720)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)
    whole = np.asarray(_cast(world, position, directions).distance)
    part, reach = nearest_part(world, position, 20, 20)
    near = np.asarray(_cast(part, [0, 0, 0], directions).distance)
    assert 20 < reach < 60
    np.testing.assert_allclose(np.where(whole < reach, whole, 0), np.where(near < reach, near, 0), atol=1e-9)
