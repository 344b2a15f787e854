"""A sweep: closed-form ranges from a moving sensor, and the statistics of noise and dropouts."""

from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.sim.assembly import assembled
from lio_jax.sim.lidar import firing_times_ns, ranging, spinning_lidar, sweep
from lio_jax.sim.open_worlds import BALL, PILLAR, SIZE, START
from lio_jax.sim.sensors import SENSORS
from lio_jax.sim.sequence import EPOCH_NS, SimulatedSequence
from lio_jax.sim.worlds import Counts, nearest_part

DISTANCE, REFLECTIVITY = 20.0, 0.4
SHAPE = 32, 2048
"""Beams and columns of the ideal sensors, all of one compiled program."""


def without_noise(lidar):
    """Return the sensor with exact ranges and without dropouts."""
    model = ranging(0.0, float(lidar.ranging.minimum), float(lidar.ranging.maximum))
    return eqx.tree_at(lambda sensor: sensor.ranging, lidar, model)


def _room_range(origin, direction):
    """Return the range in the room and the cosine of incidence, each (n,), in closed form."""
    half = SIZE / 2
    floor_center = np.array([0, 0, half[2]])
    with np.errstate(divide="ignore"):
        walls = (np.sign(direction) * half - (origin - floor_center)) / direction
    best, wall = walls.min(1), walls.argmin(1)
    cosine = np.abs(np.take_along_axis(direction, wall[:, None], 1)[:, 0])
    for center, radius, axes in (
        (np.array([*PILLAR[:2], 0]), PILLAR[2], 2),
        (np.array(BALL[:3]), BALL[3], 3),
    ):
        offset, along = (origin - center)[:, :axes], direction[:, :axes]
        a, b = np.sum(along**2, 1), np.sum(along * offset, 1)
        root = b**2 - a * (np.sum(offset**2, 1) - radius**2)
        distance = np.where((root > 0) & (b < 0), (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        met = offset + distance.clip(max=100)[:, None] * along
        cosine = np.where(distance < best, np.abs(np.sum(met * along, 1)) / radius, cosine)
        best = np.minimum(best, distance)
    return best, cosine


def _fired(sequence, scan):
    """Return when each of a scan's points was fired, (n,) s, and its ray in the lidar frame, (n, 3)."""
    lidar, start_ns = sequence.lidar, scan.stamp_ns - EPOCH_NS
    fired = firing_times_ns(lidar)
    column = np.searchsorted(fired[:, 0], scan.time.astype(float) * 1e9 + 10, side="right") - 1
    beam = np.argsort(lidar.ring)[scan.ring]
    directions = np.asarray(lidar.directions(lidar.phase(start_ns)))
    return (start_ns + fired[column, beam]) * 1e-9, directions[column, beam]


@pytest.mark.parametrize("name", ["vlp16", "hdl64", "livox"])
def test_ranges_in_the_room_are_the_closed_forms_of_all_beams(name):
    sequence = SimulatedSequence("room", without_noise(SENSORS[name].build()), 12.0, seed=2)
    flattest = 1.0
    for number in (47, 75, 93, 110):
        scan = next(sequence.scans(number, 1))
        times, rays = _fired(sequence, scan)
        poses = sequence.poses(times) @ sequence.info.T_imu_lidar
        assert np.linalg.norm(np.ptp(poses[:, :3, 3], axis=0)) > 0.05  # it moves during the sweep
        ranges = np.linalg.norm(scan.points.astype(float), axis=1)
        direction = np.einsum("nij,nj->ni", poses[:, :3, :3], rays)
        expected, cosine = _room_range(poses[:, :3, 3] + START, direction)
        assert len(ranges) == sequence.lidar.beams * sequence.lidar.columns
        assert set(scan.ring) == set(sequence.lidar.ring)
        # the points are float32: a coordinate of 8 to 16 m is rounded by up to 5e-7 m
        assert np.abs(ranges - expected).max() < 2e-6
        assert np.abs(scan.points - ranges[:, None] * rays).max() < 1e-6
        flattest = min(flattest, cosine.min())
    # some only brush the pillar or the ball
    assert flattest < 0.03


def _wall(lidar, seed=0, reflectivity=REFLECTIVITY):
    """Return a sweep of a wall across +x, and each ray's direction and true range."""
    world = assembled([0, 0, 0], planes=[[DISTANCE, 0, 0, -1, 0, 0, reflectivity]])
    part, _ = nearest_part(world, jnp.zeros(3), jnp.zeros(()), Counts(0, 0, 0, 0))
    still = jaxlie.SE3(jnp.tile(jnp.array([1.0, 0, 0, 0, 0, 0, 0]), (lidar.columns, 1)))
    seen = jax.jit(sweep)(lidar, part, still, jax.random.key(seed))
    directions = np.asarray(lidar.directions(lidar.phase(0)), float)
    with np.errstate(divide="ignore"):
        true = np.where(directions[..., 0] > 0, DISTANCE / directions[..., 0], np.inf)
    return seen, directions, true


def test_range_noise_is_white_with_the_stated_spread():
    seen, directions, true = _wall(spinning_lidar(*SHAPE, range_sigma=0.03, max_range=60.0))
    error = (np.sum(np.asarray(seen.points, float) * directions, axis=-1) - true)[np.asarray(seen.mask)]
    assert error.size > 20_000
    assert abs(error.mean()) < 5 * 0.03 / np.sqrt(error.size)
    assert error.std() == pytest.approx(0.03, rel=0.02)
    assert np.mean((error / 0.03) ** 4) == pytest.approx(3.0, rel=0.1)
    neighbours = np.corrcoef(error[:-1], error[1:])[0, 1]
    assert abs(neighbours) < 0.03


def test_dropouts_follow_range_incidence_and_reflectivity():
    half_range = 45.0
    lidar = eqx.tree_at(
        lambda sensor: sensor.ranging, spinning_lidar(*SHAPE), ranging(0.02, 0.5, 200.0, half_range)
    )
    seen, directions, true = _wall(lidar)
    ahead = directions[..., 0] > 0.12
    signal = REFLECTIVITY * directions[..., 0] * (half_range / true) ** 2
    chance = (1 - 0.5**signal)[ahead]
    answered = np.asarray(seen.mask)[ahead]
    assert chance.min() < 0.01
    assert chance.max() > 0.7
    edges = np.quantile(chance, np.linspace(0, 1, 9))
    for low, high in pairwise(edges):
        rays = (chance >= low) & (chance <= high)
        expected, spread = (
            chance[rays].mean(),
            np.sqrt(np.mean(chance[rays] * (1 - chance[rays])) / rays.sum()),
        )
        assert abs(answered[rays].mean() - expected) < 4.5 * spread + 1e-6


def test_half_range_is_where_every_second_ray_on_a_white_wall_answers():
    lidar = eqx.tree_at(
        lambda sensor: sensor.ranging,
        spinning_lidar(*SHAPE, elevation_deg=(-1.0, 1.0)),
        ranging(0.0, 0.5, 200.0, DISTANCE),
    )
    seen, directions, _ = _wall(lidar, reflectivity=1.0)
    head_on = directions[..., 0] > 0.999
    assert np.asarray(seen.mask)[head_on].mean() == pytest.approx(0.5, abs=0.06)


def test_an_ideal_sensor_misses_nothing_within_its_limits():
    seen, _, true = _wall(spinning_lidar(*SHAPE, min_range=20.5, max_range=50.0))
    np.testing.assert_array_equal(np.asarray(seen.mask), (true >= 20.5) & (true <= 50.0))


def test_intensity_is_reflectivity_times_cosine_in_whole_steps():
    seen, directions, _ = _wall(spinning_lidar(*SHAPE))
    mask = np.asarray(seen.mask)
    intensity = np.asarray(seen.intensity)
    assert np.abs(intensity - 255 * REFLECTIVITY * directions[..., 0])[mask].max() <= 0.5 + 1e-3
    np.testing.assert_array_equal(intensity, np.round(intensity))
    assert np.all(intensity[~mask] == 0)
    assert np.all(np.asarray(seen.points)[~mask] == 0)


def test_other_key_other_noise():
    lidar = spinning_lidar(*SHAPE)
    first, second, again = (np.asarray(_wall(lidar, seed)[0].points) for seed in (0, 1, 0))
    assert np.any(first != second)
    np.testing.assert_array_equal(first, again)


def test_beams_of_one_column_are_cast_from_where_the_sensor_is_when_each_fires():
    lidar = eqx.tree_at(lambda sensor: sensor.ranging, SENSORS["vlp16"].build(), ranging(0.0))
    speed = 2000.0  # so fast that 35 us inside a column are 7 cm
    times = np.arange(lidar.columns) * lidar.period / lidar.columns
    poses = np.zeros((lidar.columns, 7))
    poses[:, 0], poses[:, 4] = 1, speed * (times - times[900])
    world = assembled([0, 0, 0], planes=[[DISTANCE, 0, 0, -1, 0, 0, REFLECTIVITY]])
    part, _ = nearest_part(world, jnp.zeros(3), jnp.zeros(()), Counts(0, 0, 0, 0))
    seen = jax.jit(sweep)(lidar, part, jaxlie.SE3(jnp.asarray(poses)), jax.random.key(0))
    column = np.asarray(seen.points, float)[900]  # straight ahead
    delay = np.array(lidar.delay_ns) * 1e-9
    # column times are whole nanoseconds: half a nanosecond is a micrometre here
    np.testing.assert_allclose(column[:, 0], DISTANCE - speed * delay, atol=1e-4)
