"""Ray casting against a brute-force march over a hilly ground."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.sim.casting import HILLS, cast_into, world_of


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
    hit = cast_into(world_of(jnp.float64, ground=HILLS), origins, directions)
    distance = np.asarray(hit.distance)
    assert 0.5 < np.isfinite(expected).mean() < 1
    crossed = np.isfinite(expected)
    np.testing.assert_allclose(distance[crossed], expected[crossed], atol=1e-6)
    assert np.all(distance[~crossed] > 150)


def test_hills_in_single_precision_have_their_points_on_them(hill_rays):
    _, directions, _ = hill_rays
    world = world_of(jnp.float32, ground=HILLS)
    for position in ([0.0, 0.0, 1.0], [80.0, -60.0, 3.0]):
        near = np.array([*position[:2], position[2] + _height(np.array(position[:2]))], np.float32).astype(
            float
        )
        hit = cast_into(world, [0, 0, 0], directions, position=near)
        distance = np.asarray(hit.distance, float)
        met = np.isfinite(distance) & (distance < 150)
        assert met.mean() > 0.5
        unit = np.asarray(directions, np.float32).astype(float)
        points = near + distance[met, None] * unit[met]
        gap = np.abs(points[:, 2] - _height(points[:, :2]))
        assert gap[distance[met] < 20].max() < 1e-5
        assert gap.max() < 1e-4
        exact = np.asarray(cast_into(world_of(jnp.float64, ground=HILLS), near, directions).distance)
        # none is lost but such as graze a crest
        assert np.sum((exact < 150) & ~met) <= 2


def test_hills_from_below():
    world = world_of(jnp.float64, ground=HILLS)
    hit = cast_into(world, [3, 4, -20], [[0, 0, 1], [0, 0, -1]])
    np.testing.assert_allclose(hit.distance, [_height(np.array([3.0, 4.0])) + 20, np.inf])


def test_normals_of_hills_are_gradients(hill_rays):
    origins, directions, _ = hill_rays
    hit = cast_into(world_of(jnp.float64, ground=HILLS), origins, directions)
    met = np.isfinite(np.asarray(hit.distance))
    plan = (origins + np.where(met, hit.distance, 0)[:, None] * directions)[met, :2]
    slope = [(_height(plan + move) - _height(plan - move)) / 2e-5 for move in 1e-5 * np.eye(2)]
    expected = np.stack([-slope[0], -slope[1], np.ones(len(plan))], axis=1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(hit.normal[met], expected, atol=1e-7)
