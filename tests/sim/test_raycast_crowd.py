"""Random rays into a crowd of shapes that scipy and numpy place, against signed distances."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.sim.casting import cast_into, world_of


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
    hit = cast_into(world_of(jnp.float64, **shapes), origins, directions, times)
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


def test_many_rays_at_once_give_the_same_results_as_a_few_at_a_time():
    """A few are held against every solid in full precision; many are searched for in float32 before."""
    world = world_of(jnp.float64, **_crowd())
    rng = np.random.default_rng(8)
    origins, directions = rng.uniform(-1, 1, (16_000, 3)), rng.normal(size=(16_000, 3))
    at_once = cast_into(world, origins, directions)
    pieces = [
        cast_into(world, *rays) for rays in zip(np.split(origins, 8), np.split(directions, 8), strict=True)
    ]
    assert 0.2 < np.isfinite(np.asarray(at_once.distance)).mean() < 1
    for name in ("distance", "normal", "reflectivity"):
        few = np.concatenate([getattr(hit, name) for hit in pieces])
        np.testing.assert_allclose(getattr(at_once, name), few, atol=1e-9)
