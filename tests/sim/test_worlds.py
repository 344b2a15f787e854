"""The worlds: routes clear of everything, closed forms, no leaks, and what makes each world what it is."""

from functools import cache, partial
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.sim import tunnel
from lio_jax.sim.open_worlds import BALL, PILLAR, SIZE, START
from lio_jax.sim.raycast import Hit, cast
from lio_jax.sim.sequence import WORLDS, build
from lio_jax.sim.trajectory import motion_along, pose_at
from lio_jax.sim.worlds import counts_along, nearest_part

REACH = 130.0

RAYS = 2000
"""Number of rays in every cast; it is constant so that each world compiles once."""


@cache
def _scene(name, seed=0):
    return build(name, seed)


@cache
def _counts(name, seed=0):
    scene = _scene(name, seed)
    return counts_along(scene.world, jnp.asarray(_along(scene.route, 5.0)), REACH)


def _along(route, step):
    """Points of the polyline, at most ``step`` m apart."""
    ends = np.vstack([route.points, route.points[:1]]) if route.closed else route.points
    pieces = []
    for here, there in pairwise(ends):
        count = max(1, int(np.ceil(np.linalg.norm(there - here) / step)))
        pieces.append(here + np.arange(count)[:, None] / count * (there - here))
    return np.concatenate([*pieces, ends[-1:]])


@partial(jax.jit, static_argnames="counts")
def _shot(world, position, time, offsets, directions, counts):
    part, _ = nearest_part(world, position, time, counts)
    return cast(part, offsets, directions, jnp.zeros(len(offsets), offsets.dtype))


def _look(name, position, directions, *, time=0.0, offset=(0, 0, 0), seed=0) -> Hit:
    """Cast as the sensor models do; ``offset`` (3,) or one for each direction."""
    count = len(directions)
    padded = np.tile(directions[-1:], (RAYS, 1))
    offsets = np.zeros((RAYS, 3))
    padded[:count], offsets[:count] = directions, offset
    hit = _shot(
        _scene(name, seed).world,
        jnp.asarray(position, float),
        jnp.asarray(time, float),
        jnp.asarray(offsets),
        jnp.asarray(padded),
        _counts(name, seed),
    )
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], hit)


def _sphere(count, seed=0):
    directions = np.random.default_rng(seed).normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_the_route_starts_at_the_origin_towards_x(name):
    route = _scene(name).route
    np.testing.assert_array_equal(route.points[0], 0)
    first = route.points[1] - route.points[0]
    assert first[0] > 0
    assert abs(first[1]) < 1e-9
    assert abs(first[2]) < 0.1 * first[0]
    assert np.linalg.norm(np.diff(route.points, axis=0), axis=1).min() > 0.2
    assert route.dynamics == {"field": "drone", "city": "car", "street": "car", "tunnel": "car"}.get(
        name, "handheld"
    )
    assert route.closed == (name != "tunnel")


@cache
def _driven(name):
    """Where the body is in the course of a lap, sway included, and when: a few steps per metre."""
    route = _scene(name).route
    length = np.linalg.norm(np.diff(_along(route, 100.0), axis=0), axis=1).sum()
    duration = 1.4 * length / route.speed
    motion = motion_along(route, duration_s=duration)
    times = np.arange(0, duration, {"car": 0.4, "drone": 1.0}.get(route.dynamics, 0.25))
    return times, np.asarray(jax.jit(jax.vmap(lambda time: pose_at(motion, time).translation()))(times))


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_the_way_keeps_clear_of_all_surfaces(name):
    directions = _sphere(RAYS)
    nearest = min(
        float(_look(name, point, directions, time=time).distance.min())
        for time, point in zip(*_driven(name), strict=True)
    )
    assert nearest > 0.4


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_other_seed_other_world_same_seed_same_world(name):
    first, again, other = build(name, 0), build(name, 0), build(name, 1)
    for here, there in zip(jax.tree.leaves(first.world), jax.tree.leaves(again.world), strict=True):
        np.testing.assert_array_equal(here, there)

    def flat(scene):
        return np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(scene.world)])

    here, there = flat(first), flat(other)
    assert len(here) != len(there) or np.any(here != there)


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_reflectivities_and_sizes_are_possible(name):
    world = _scene(name).world
    solids = world.solids
    for rows in (
        *jax.tree.leaves(solids, is_leaf=lambda leaf: hasattr(leaf, "reflectivity")),
        world.movers.boxes,
    ):
        assert np.all((rows.reflectivity >= 0.05) & (rows.reflectivity <= 1))
    for sizes in (
        solids.boxes.half_size,
        solids.tilted.half_size,
        solids.cylinders.radius,
        solids.cylinders.height,
        solids.spheres.radius,
        solids.grounds.amplitude,
        world.movers.boxes.half_size,
        world.movers.period,
    ):
        assert np.all(np.asarray(sizes) > 0)
    assert all(leaf.dtype in (jnp.float64, jnp.int32) for leaf in jax.tree.leaves(world))


def test_unknown_world_names_those_that_exist():
    with pytest.raises(
        UsageError, match="'moon' is unknown; choose one of: city, field, office, room, stairs"
    ):
        build("moon", 0)


def _room_range(origins, directions):
    """The room's closed form in float64, from the builder's sizes alone."""
    origins = origins + START
    low, high = np.array([-SIZE[0] / 2, -SIZE[1] / 2, 0]), np.array([SIZE[0] / 2, SIZE[1] / 2, SIZE[2]])
    with np.errstate(divide="ignore"):
        walls = np.where(directions > 0, (high - origins) / directions, (low - origins) / directions)
    found = np.where(directions == 0, np.inf, walls).min(axis=1)
    for center, radius, axes in ((PILLAR[:2], PILLAR[2], 2), (BALL[:3], BALL[3], 3)):
        offset, way = origins[:axes] - center, directions[:, :axes]
        a, b, c = np.sum(way**2, axis=1), way @ offset, offset @ offset - radius**2
        distance = (-b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
        closer = (b**2 > a * c) & (distance > 0) & (distance < found)
        found = np.where(closer, distance, found)
    return found


def test_room_ranges_have_the_closed_form():
    # the sensor moves within a sweep: origins off the part's own
    directions = _sphere(RAYS)
    seen = set()
    for number, point in enumerate(_along(_scene("room").route, 1.5)):
        offset = np.array([0.05 * np.sin(number), 0.1, -0.02 * (number % 5)])
        hit = _look("room", point, directions, offset=offset)
        np.testing.assert_allclose(hit.distance, _room_range(point + offset, directions), atol=1e-9)
        seen |= set(np.asarray(hit.reflectivity).tolist())
    assert len(seen) == 3


@pytest.mark.parametrize("name", ["office", "room", "stairs"])
def test_indoors_every_ray_meets_something_of_the_building(name):
    for point in _along(_scene(name).route, 3.0):
        assert float(_look(name, point, _sphere(RAYS)).distance.max()) < 45


@pytest.mark.parametrize("name", ["city", "field", "tunnel", "street"])
def test_outdoors_no_ray_that_points_down_is_lost(name):
    """A leak shows as a ray into the void; grounds fall off by no more than their slope."""
    directions = _sphere(RAYS)
    directions = directions[directions[:, 2] < -0.15]
    for point in _along(_scene(name).route, 40.0):
        assert np.all(np.isfinite(_look(name, point, directions).distance))


@pytest.mark.parametrize("name", ["city", "field"])
def test_points_on_the_ground_lie_on_it(name):
    grounds = _scene(name).world.solids.grounds
    grounds = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), grounds)
    unit = _sphere(RAYS)
    seen = 0
    for point in _along(_scene(name).route, 60.0):
        hit = _look(name, point, unit)
        ground = (np.asarray(hit.reflectivity) == grounds.reflectivity[0]) & (np.asarray(hit.distance) < 100)
        met = point + np.asarray(hit.distance)[ground, None] * unit[ground]
        angle = met[:, :2] @ grounds.wave[0].T + grounds.phase[0]
        gap = met[:, 2] - grounds.height[0] - np.sin(angle) @ grounds.amplitude[0]
        assert np.abs(gap).max() < 1e-9
        seen += int(ground.sum())
    assert seen > 1000


def test_city_slopes_and_has_kerbs():
    scene = _scene("city")
    heights = scene.route.points[:, 2]
    assert np.ptp(heights) > 1.0
    # how far down ground and pavement are under a line across the street beside the start
    across = np.linspace(-9, 9, 721)
    down = np.tile([0.0, 0.0, -1.0], (len(across), 1))
    over = np.stack([0 * across, across, 0 * across + 0.2], axis=1)
    hit = _look("city", [0, 0, 0], down, offset=over)
    step = -np.diff(np.asarray(hit.distance))
    kerbs = (np.abs(step) > 0.08) & (np.abs(step) < 0.2)
    assert kerbs.sum() >= 1


def _gap_to_route(name):
    """Smallest horizontal distance from any mover's path to the way."""
    path = np.asarray(_scene(name).world.movers.path).reshape(-1, 3)[:, :2]
    return min(np.linalg.norm(path - point, axis=1).min() for point in _driven(name)[1][:, :2])


@pytest.mark.parametrize(("name", "bodies", "gap"), [("city", 10, 2.4), ("office", 2, 0.9)])
def test_movers_never_cross_the_route(name, bodies, gap):
    movers = _scene(name).world.movers
    assert len(np.unique(movers.body)) == bodies
    assert _gap_to_route(name) > gap


def test_city_traffic_passes_the_start_in_the_other_lane():
    directions = _sphere(RAYS)
    looks = np.array(
        [_look("city", [0, 0, 0], directions, time=time).distance for time in np.arange(0, 40, 1.0)]
    )
    changed = np.ptp(np.minimum(looks, 100), axis=0) > 0.5
    assert changed.sum() > 20
    assert looks.min() > 1.0


def test_tunnel_looks_the_same_all_along_its_middle():
    """The axis cannot be observed by a sensor that sees 100 m far."""
    directions = _sphere(RAYS, seed=1)
    start = tunnel.FURNISHED + 100 + 60
    places = start + np.array([0.0, 3.7, 55.0, 239.0])
    looks = [np.asarray(_look("tunnel", [place, 0, 0], directions).distance) for place in places]
    assert places[-1] - places[0] > 200
    near = looks[0] < 99
    assert near.mean() > 0.99
    for look in looks[1:]:
        np.testing.assert_allclose(look[near], looks[0][near], atol=2e-4)


def test_tunnel_ends_are_not_the_same():
    directions = _sphere(RAYS, seed=1)
    first, second = (
        np.asarray(_look("tunnel", [place, 0, 0], directions).distance) for place in (60 + 25.0, 60 + 28.7)
    )
    changed = np.abs(np.minimum(first, 99) - np.minimum(second, 99)) > 0.1
    assert changed.mean() > 0.01


def test_no_ground_is_seen_through_the_tunnels_lining():
    hit = _look("tunnel", [300.0, 0, 0], _sphere(RAYS))
    met = np.asarray(hit.distance)[:, None] * _sphere(RAYS)
    inside = np.abs(met[:, 0]) < 200
    assert np.abs(met[inside, 1]).max() < 7.0
    assert met[inside, 2].max() < 5.0


def test_stairs_climb_three_storeys_and_return():
    points = _scene("stairs").route.points
    assert np.ptp(points[:, 2]) == pytest.approx(3 * 3.4)
    heights = np.unique(np.round(points[:, 2], 6))
    np.testing.assert_allclose(heights, 1.7 * np.arange(7), atol=1e-6)


def test_stairs_have_the_treads_that_are_walked_on():
    route = _scene("stairs").route
    down = np.array([[0.0, 0.0, -1.0]])
    for point in _along(route, 0.15):
        # the hand is carried at 1.35 m above the slope that joins the treads' middles
        assert float(_look("stairs", point, down).distance[0]) == pytest.approx(1.35, abs=0.12)


def test_office_rooms_are_seen_through_their_doors_alone():
    level = np.linspace(-np.pi, np.pi, RAYS, endpoint=False)
    directions = np.stack([np.cos(level), np.sin(level), 0 * level], axis=1)
    beyond = []
    for x in np.arange(0, 16, 0.5):
        distance = np.asarray(_look("office", [x, 0, 0], directions).distance)
        side = np.abs(distance * directions[:, 1])
        beyond.append(np.mean(side > 1.2))
    # some of what is seen lies outside the corridor, most does not
    assert 0.005 < np.mean(beyond) < 0.4
