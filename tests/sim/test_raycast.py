"""Ray casting against closed-form ranges and against a brute-force march through scipy-placed shapes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lio_jax.sim.movers import Movers
from lio_jax.sim.primitives import Boxes, Cylinders, Grounds, Planes, Spheres, TiltedBoxes
from lio_jax.sim.raycast import Hit, cast
from lio_jax.sim.worlds import Counts, Solids, World, counts_along, nearest_part

DTYPES = [(jnp.float64, 1e-9), (jnp.float32, 1e-4)]


def _world(dtype, planes=(), boxes=(), cylinders=(), spheres=(), tilted=(), ground=None, moving=()):
    """Return a world from rows.

    Plane (point 3, normal 3), box (centre 3, half 3, yaw), cylinder (base 3, radius, height), sphere
    (centre 3, radius), tilted (centre 3, half 3, Euler angles xyz 3), ground rows of waves (amplitude,
    wave 2, phase) about z = 0, moving (half 3, start 3, velocity 3): a straight path of 100 s.
    """

    def rows(values, width):
        return np.reshape(np.asarray(values, float), (-1, width))

    def array(values):
        return jnp.asarray(values, dtype)

    def reflectivity(values, value):
        return array(np.full(len(values), value))

    p, b, c, s = rows(planes, 6), rows(boxes, 7), rows(cylinders, 5), rows(spheres, 4)
    t, m = rows(tilted, 9), rows(moving, 9)
    turns = Rotation.from_euler("xyz", t[:, 6:]).as_matrix() if len(t) else np.zeros((0, 3, 3))
    waves = np.zeros((0, 1, 4)) if ground is None else np.asarray(ground, float)[None]
    path = m[:, None, 3:6] + 10.0 * np.arange(10)[None, :, None] * m[:, None, 6:]
    return World(
        Solids(
            Planes(array(p[:, :3]), array(p[:, 3:]), reflectivity(p, 0.1)),
            Grounds(
                array(np.zeros(len(waves))),
                array(waves[..., 0]),
                array(waves[..., 1:3]),
                array(waves[..., 3]),
                reflectivity(waves, 0.5),
            ),
            Boxes(array(b[:, :3]), array(b[:, 3:6]), array(b[:, 6]), reflectivity(b, 0.2)),
            TiltedBoxes(array(t[:, :3]), array(t[:, 3:6]), array(turns), reflectivity(t, 0.4)),
            Cylinders(array(c[:, :3]), array(c[:, 3]), array(c[:, 4]), reflectivity(c, 0.3)),
            Spheres(array(s[:, :3]), array(s[:, 3]), reflectivity(s, 0.6)),
        ),
        Movers(
            array(path if len(m) else np.zeros((1, 10, 3))),
            array(np.zeros((max(1, len(m)), 10))),
            array(np.full(max(1, len(m)), 100.0)),
            jnp.arange(len(m), dtype=jnp.int32),
            Boxes(
                array(np.zeros((len(m), 3))), array(m[:, :3]), array(np.zeros(len(m))), reflectivity(m, 0.7)
            ),
        ),
    )


def _everything(world):
    solids = world.solids
    return Counts(
        *(len(rows.reflectivity) for rows in (solids.boxes, solids.tilted, solids.cylinders, solids.spheres))
    )


def _cast(world, origins, directions, times=0.0, position=(0, 0, 0), counts=None) -> Hit:
    dtype = world.solids.planes.point.dtype
    directions = np.asarray(directions, float)
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(np.asarray(origins, float), directions.shape)
    times = np.broadcast_to(times, len(directions))
    arrays = (jnp.asarray(values, dtype) for values in (position, origins, directions, times))
    return _shot(world, *arrays, counts or _everything(world))


@partial(jax.jit, static_argnames="counts")
def _shot(world, position, origins, directions, times, counts):
    part, _ = nearest_part(world, position, jnp.zeros((), position.dtype), counts)
    return cast(part, origins, directions, times)


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


def test_sphere_from_outside_inside_and_beside():
    hit = _cast(
        _world(jnp.float64, spheres=[[10, 0, 0, 2]]),
        [[0, 0, 0], [10.5, 0, 0], [0, 0, 2.001], [20, 0, 0], [0, 1, 0]],
        np.tile([1, 0, 0], (5, 1)),
    )
    np.testing.assert_allclose(hit.distance, [8, 1.5, np.inf, np.inf, 10 - np.sqrt(3)], atol=1e-12)
    np.testing.assert_allclose(hit.normal[:2], [[-1, 0, 0], [-1, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(hit.normal[4], [-np.sqrt(3) / 2, 0.5, 0], atol=1e-12)


def test_small_sphere_far_away_in_single_precision():
    aside = np.array([0.0, 0.05, -0.09])
    origins = np.stack([0 * aside, aside, 0 * aside], axis=1)
    hit = _cast(_world(jnp.float32, spheres=[[90, 0, 0, 0.1]]), origins, np.tile([1, 0, 0], (3, 1)))
    np.testing.assert_allclose(hit.distance, 90 - np.sqrt(0.01 - aside**2), atol=5e-5)


@pytest.mark.parametrize(("dtype", "tolerance"), DTYPES)
def test_tilted_box_faces(dtype, tolerance):
    angles = [0.3, -0.5, 1.1]
    turn = Rotation.from_euler("xyz", angles).as_matrix()
    half, center = np.array([2.0, 1.0, 0.5]), np.array([5.0, -3.0, 1.0])
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    on_face = axes * half + 0.3 * half * (axes == 0)
    origins = (on_face + 7 * axes) @ turn.T + center
    hit = _cast(_world(dtype, tilted=[[*center, *half, *angles]]), origins, -axes @ turn.T)
    np.testing.assert_allclose(hit.distance, 7, atol=tolerance)
    np.testing.assert_allclose(hit.normal, axes @ turn.T, atol=1e-6)


def test_moving_box_is_met_where_it_is_when_the_ray_is_sent():
    world = _world(jnp.float64, moving=[[1, 1, 1, 10, 0, 0, -2, 0, 0]])
    times = np.array([0.0, 0.05, 1.0])
    hit = _cast(world, [0, 0, 0], np.tile([1, 0, 0], (3, 1)), times)
    np.testing.assert_allclose(hit.distance, 9 - 2 * times, atol=1e-12)
    np.testing.assert_allclose(hit.normal, np.tile([-1, 0, 0], (3, 1)), atol=1e-12)


HILLS = np.array([[1.5, 0.03, 0.01, 0.4], [0.6, -0.02, 0.05, 2.0], [0.15, 0.1, 0.08, 1.0]])


def _height(points):
    return np.sum(HILLS[:, 0] * np.sin(points @ HILLS[:, 1:3].T + HILLS[:, 3]), axis=-1)


def _first_crossing(origins, directions, reach):
    """March at 2 cm, then bisect: the first distance at which a ray is below the hills, inf if none."""
    found = np.full(len(origins), np.inf)
    low = np.zeros(len(origins))
    for begin in np.arange(0, reach, 2.0):
        steps = begin + np.arange(0, 2.0, 0.02) + 0.02
        points = origins[:, None] + steps[:, None] * directions[:, None]
        below = points[..., 2] < _height(points[..., :2])
        first = np.argmax(below, axis=1)
        fresh = below.any(axis=1) & np.isinf(found)
        found[fresh], low[fresh] = steps[first[fresh]], steps[first[fresh]] - 0.02
    high = found.copy()
    for _ in range(40):
        middle = np.where(np.isinf(high), 0, (low + high) / 2)
        points = origins + middle[:, None] * directions
        below = points[:, 2] < _height(points[:, :2])
        high, low = np.where(below & np.isfinite(high), middle, high), np.where(below, low, middle)
    return high


@pytest.fixture(scope="module")
def hill_rays():
    rng = np.random.default_rng(2)
    origins = np.column_stack([rng.uniform(-100, 100, (1500, 2)), np.zeros(1500)])
    origins[:, 2] = _height(origins[:, :2]) + rng.uniform(0.5, 4, 1500)
    azimuth, dip = rng.uniform(0, 2 * np.pi, 1500), rng.uniform(-0.02, 0.5, 1500) ** 2 * 2
    directions = np.stack(
        [np.cos(azimuth) * np.cos(dip), np.sin(azimuth) * np.cos(dip), -np.sin(dip)], axis=1
    )
    return origins, directions, _first_crossing(origins, directions, 150.0)


def test_hills_are_met_at_their_first_crossing(hill_rays):
    origins, directions, expected = hill_rays
    hit = _cast(_world(jnp.float64, ground=HILLS), origins, directions)
    distance = np.asarray(hit.distance)
    assert 0.5 < np.isfinite(expected).mean() < 1
    crossed = np.isfinite(expected)
    np.testing.assert_allclose(distance[crossed], expected[crossed], atol=1e-6)
    assert np.all(distance[~crossed] > 150)


def test_hills_in_single_precision_have_their_points_on_them(hill_rays):
    _, directions, _ = hill_rays
    world = _world(jnp.float32, ground=HILLS)
    for position in ([0.0, 0.0, 1.0], [80.0, -60.0, 3.0]):
        near = np.array([*position[:2], position[2] + _height(np.array(position[:2]))], np.float32).astype(
            float
        )
        hit = _cast(world, [0, 0, 0], directions, position=near)
        distance = np.asarray(hit.distance, float)
        met = np.isfinite(distance) & (distance < 150)
        assert met.mean() > 0.5
        unit = np.asarray(directions, np.float32).astype(float)
        points = near + distance[met, None] * unit[met]
        gap = np.abs(points[:, 2] - _height(points[:, :2]))
        assert gap[distance[met] < 20].max() < 1e-5
        assert gap.max() < 1e-4
        exact = np.asarray(_cast(_world(jnp.float64, ground=HILLS), near, directions).distance)
        # none is lost but such as graze a crest
        assert np.sum((exact < 150) & ~met) <= 2


def test_hills_from_below():
    world = _world(jnp.float64, ground=HILLS)
    hit = _cast(world, [3, 4, -20], [[0, 0, 1], [0, 0, -1]])
    np.testing.assert_allclose(hit.distance, [_height(np.array([3.0, 4.0])) + 20, np.inf])


def _crowd():
    rng = np.random.default_rng(0)
    place = rng.uniform(-20, 20, (40, 3))
    return {
        "boxes": np.column_stack([place[:8], rng.uniform(0.5, 4, (8, 3)), rng.uniform(-3, 3, 8)]),
        "tilted": np.column_stack([place[8:14], rng.uniform(0.5, 4, (6, 3)), rng.uniform(-3, 3, (6, 3))]),
        "cylinders": np.column_stack([place[14:22], rng.uniform(0.2, 2, 8), rng.uniform(1, 6, 8)]),
        "spheres": np.column_stack([place[22:28], rng.uniform(0.3, 3, 6)]),
        "moving": np.column_stack([rng.uniform(0.5, 3, (6, 3)), place[28:34], rng.uniform(-8, 8, (6, 3))]),
    }


def _signed_distance(shapes, points, times):
    """Zero on surfaces, negative inside, with a unit gradient at faces; not Euclidean elsewhere."""
    nearest = np.full(len(points), np.inf)
    for *center, hx, hy, hz, yaw in shapes["boxes"]:
        local = np.abs(Rotation.from_euler("z", yaw).inv().apply(points - center)) - [hx, hy, hz]
        nearest = np.minimum(nearest, local.max(axis=1))
    for row in shapes["tilted"]:
        local = np.abs(Rotation.from_euler("xyz", row[6:]).inv().apply(points - row[:3])) - row[3:6]
        nearest = np.minimum(nearest, local.max(axis=1))
    for x, y, z, radius, height in shapes["cylinders"]:
        wall = np.hypot(points[:, 0] - x, points[:, 1] - y) - radius
        caps = np.abs(points[:, 2] - z - height / 2) - height / 2
        nearest = np.minimum(nearest, np.maximum(wall, caps))
    for *center, radius in shapes["spheres"]:
        nearest = np.minimum(nearest, np.linalg.norm(points - center, axis=1) - radius)
    for row in shapes["moving"]:
        local = np.abs(points - row[3:6] - times[:, None] * row[6:]) - row[:3]
        nearest = np.minimum(nearest, local.max(axis=1))
    return nearest


@pytest.fixture(scope="module")
def crowd_rays():
    shapes = _crowd()
    rng = np.random.default_rng(5)
    origins = rng.uniform(-30, 30, (600, 3))
    directions = rng.normal(size=(600, 3)) - 0.05 * origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    times = rng.uniform(0, 0.1, 600)
    outside = _signed_distance(shapes, origins, times) > 0
    origins, directions, times = origins[outside], directions[outside], times[outside]
    hit = _cast(_world(jnp.float64, **shapes), origins, directions, times)
    return shapes, origins, directions, times, hit


def test_random_rays_agree_with_signed_distances(crowd_rays):
    """At the hit the union of shapes has signed distance zero, and nowhere before it is it negative."""
    shapes, origins, directions, times, hit = crowd_rays
    distance = np.asarray(hit.distance)
    met = np.isfinite(distance)
    assert 50 < met.sum() < len(met)
    np.testing.assert_allclose(np.unique(hit.reflectivity[met]), [0.2, 0.3, 0.4, 0.6, 0.7])
    at_hit = origins[met] + distance[met, None] * directions[met]
    np.testing.assert_allclose(_signed_distance(shapes, at_hit, times[met]), 0, atol=1e-9)
    for share in np.linspace(0, 0.999, 200):
        on_ray = origins + share * np.where(met, distance, 100)[:, None] * directions
        assert np.all(_signed_distance(shapes, on_ray, times) > -1e-9)


def test_normals_are_gradients_of_the_signed_distance(crowd_rays):
    shapes, origins, directions, times, hit = crowd_rays
    distance = np.asarray(hit.distance)
    met = np.isfinite(distance)
    at_hit, when, step = origins[met] + distance[met, None] * directions[met], times[met], 1e-6
    gradient = np.stack(
        [
            (_signed_distance(shapes, at_hit + move, when) - _signed_distance(shapes, at_hit - move, when))
            / (2 * step)
            for move in step * np.eye(3)
        ],
        axis=1,
    )
    np.testing.assert_allclose(hit.normal[met], gradient, atol=1e-5)


def test_normals_of_hills_are_gradients(hill_rays):
    origins, directions, _ = hill_rays
    hit = _cast(_world(jnp.float64, ground=HILLS), origins, directions)
    met = np.isfinite(np.asarray(hit.distance))
    plan = (origins + np.where(met, hit.distance, 0)[:, None] * directions)[met, :2]
    slope = [(_height(plan + move) - _height(plan - move)) / 2e-5 for move in 1e-5 * np.eye(2)]
    expected = np.stack([-slope[0], -slope[1], np.ones(len(plan))], axis=1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(hit.normal[met], expected, atol=1e-7)


@partial(jax.jit, static_argnames="counts")
def _reach(world, position, counts):
    return nearest_part(world, position, jnp.zeros(()), counts)[1]


def test_leaving_far_primitives_out_changes_nothing_within_reach():
    rng = np.random.default_rng(1)
    place = rng.uniform(-60, 60, (160, 2))
    flat, ones = np.zeros(60), np.ones((60, 3))
    world = _world(
        jnp.float64,
        boxes=np.column_stack([place[:60], flat, ones, flat]),
        cylinders=np.column_stack([place[60:110], -ones[:50, 0], ones[:50, 0], 2 * ones[:50, 0]]),
        spheres=np.column_stack([place[110:135], flat[:25], ones[:25, 0]]),
        tilted=np.column_stack([place[135:], flat[:25], ones[:25], rng.uniform(-3, 3, (25, 3))]),
        ground=HILLS,
        moving=[[1, 1, 1, 30, 0, 0, 3, 0, 0]],
    )
    position = jnp.array([10.0, -5.0, 0.5])
    azimuth = np.linspace(0, 2 * np.pi, 720)
    directions = np.stack([np.cos(azimuth), np.sin(azimuth), 0.01 * np.sin(7 * azimuth)], axis=1)
    whole = np.asarray(_cast(world, position, directions).distance)
    counts = Counts(boxes=20, tilted=10, cylinders=20, spheres=10)
    reach = _reach(world, position, counts)
    near = np.asarray(_cast(world, [0, 0, 0], directions, position=position, counts=counts).distance)
    assert 20 < reach < 60
    np.testing.assert_allclose(np.where(whole < reach, whole, 0), np.where(near < reach, near, 0), atol=1e-9)


def test_counts_along_cover_the_radius_everywhere():
    rng = np.random.default_rng(3)
    rows = np.column_stack([rng.uniform(-60, 60, (80, 2)), np.zeros(80), np.ones((80, 3)), np.zeros(80)])
    world = _world(jnp.float64, boxes=rows, spheres=np.column_stack([rows[:40, 1::-1], np.ones((40, 2))]))
    positions = jnp.asarray(rng.uniform(-40, 40, (12, 3)))
    counts = counts_along(world, positions, 25.0)
    assert 0 < counts.boxes < 80
    assert 0 < counts.spheres < 40
    assert counts.cylinders == counts.tilted == 0
    for position in positions:
        assert _reach(world, position, counts) >= 25.0
