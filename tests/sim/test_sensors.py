"""The sensors' geometry against their data sheets and against the ring formulas the field uses."""

import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.data.reconstruct import ring_from_elevation
from lio_jax.sim.lidar import SpinningLidar, firing_times_ns
from lio_jax.sim.sensors import SENSORS, find_sensor

SPINNING = [name for name in SENSORS if name != "livox"]


@pytest.fixture(scope="module")
def lidars():
    return {name: sensor.build() for name, sensor in SENSORS.items()}


@pytest.mark.parametrize(
    ("name", "beams", "columns", "lowest", "highest"),
    [
        ("generic32", 32, 1024, -25.0, 15.0),
        ("vlp16", 16, 1800, -15.0, 15.0),
        ("hdl32", 32, 2170, -30.667, 10.667),
        ("hdl64", 64, 2083, -24.33, 2.0),
        ("os1_64", 64, 1024, -22.5, 22.5),
        ("os1_128", 128, 1024, -22.5, 22.5),
    ],
)
def test_beams_columns_and_field_of_view(lidars, name, beams, columns, lowest, highest):
    lidar = lidars[name]
    assert (lidar.beams, lidar.columns, lidar.period) == (beams, columns, 0.1)
    elevation = np.rad2deg(lidar.elevation)
    np.testing.assert_allclose([elevation.min(), elevation.max()], [lowest, highest], atol=1e-3)
    assert sorted(lidar.ring) == list(range(beams))


@pytest.mark.parametrize(("name", "beams"), [("vlp16", 16), ("hdl32", 32), ("hdl64", 64)])
def test_rings_are_those_that_a_loam_reconstructs_from_elevation(lidars, name, beams):
    lidar: SpinningLidar = lidars[name]
    elevation = np.asarray(lidar.elevation, float)
    points = 20 * np.stack([np.cos(elevation), 0 * elevation, np.sin(elevation)], axis=1)
    points[:, 2] += 1e-4  # off the seam between two rings
    ring = ring_from_elevation(points, beams)
    known = ring >= 0
    assert known.sum() >= min(beams, 51) - 1  # A-LOAM leaves the HDL-64E's lowest beams out
    np.testing.assert_array_equal(ring[known], np.array(lidar.ring)[known])


def test_hdl64_has_two_blocks_of_different_spacing(lidars):
    elevation = np.sort(np.rad2deg(np.asarray(lidars["hdl64"].elevation, float)))[::-1]
    np.testing.assert_allclose(np.diff(elevation[:32]), -1 / 3, atol=1e-9)
    np.testing.assert_allclose(np.diff(elevation[32:]), -1 / 2, atol=1e-9)
    np.testing.assert_allclose(elevation[32], -8.83, atol=1e-9)


def test_vlp16_fires_low_and_high_beams_in_turn(lidars):
    lidar = lidars["vlp16"]
    expected = [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]
    np.testing.assert_allclose(np.rad2deg(lidar.elevation), expected, atol=1e-9)
    np.testing.assert_array_equal(np.diff(lidar.delay_ns), 2304)


def test_ouster_rings_count_from_the_top(lidars):
    elevation = np.asarray(lidars["os1_64"].elevation)[np.argsort(lidars["os1_64"].ring)]
    assert np.all(np.diff(elevation) < 0)


@pytest.mark.parametrize("name", SENSORS)
def test_rays_are_fired_one_after_another_within_the_sweep(lidars, name):
    times = firing_times_ns(lidars[name])
    assert times.shape == (lidars[name].columns, lidars[name].beams)
    assert np.all(np.diff(times.ravel()) >= 0)
    assert times.min() == 0
    assert 0.99 * lidars[name].period_ns < times.max() < lidars[name].period_ns


@pytest.mark.parametrize("name", SENSORS)
def test_times_survive_being_written_as_whole_nanoseconds(lidars, name):
    seconds = (firing_times_ns(lidars[name]) * 1e-9).astype(np.float32)
    written = np.round(seconds.astype(np.float64) * 1e9).astype(np.uint32)
    np.testing.assert_array_equal((written * 1e-9).astype(np.float32), seconds)


@pytest.mark.parametrize("name", SPINNING)
def test_the_head_turns_clockwise_once_between_all_rays(lidars, name):
    lidar = lidars[name]
    directions = np.asarray(lidar.directions(lidar.phase(0)), float)
    assert directions.shape == (lidar.columns, lidar.beams, 3)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(
        directions[..., 2], np.sin(lidar.elevation)[None].repeat(lidar.columns, 0), atol=1e-12
    )
    turned = 2 * np.pi * firing_times_ns(lidar) / lidar.period_ns
    azimuth = np.pi - turned + np.asarray(lidar.azimuth)
    found = np.arctan2(directions[..., 1], directions[..., 0])
    assert np.abs(np.angle(np.exp(1j * (found - azimuth)))).max() < 1e-12


def test_layouts():
    assert {name: sensor.layout for name, sensor in SENSORS.items()} == {
        "generic32": "velodyne",
        "vlp16": "velodyne",
        "hdl32": "velodyne",
        "hdl64": "velodyne",
        "os1_64": "ouster",
        "os1_128": "ouster",
        "livox": "livox",
    }


def test_unknown_sensor_names_those_that_exist():
    with pytest.raises(UsageError, match=r"'vlp32' is unknown; choose one of: generic32, vlp16, .*livox"):
        find_sensor("vlp32")
