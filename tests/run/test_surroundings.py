"""Finer voxels where the surroundings are near, and the noise that the samples show, where nobody chose."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from lio_jax.data.sequence import ImuData, LidarScan
from lio_jax.recipes import RECIPES
from lio_jax.recipes.default import Default
from lio_jax.run.fitted_settings import (
    fitted_to_surroundings,
    with_inertial_noise,
    with_range_noise,
)
from lio_jax.settings.settings import Settings, recipe_settings, with_overrides
from lio_jax.sim.lidar import spinning_lidar
from lio_jax.sim.sequence import SimulatedSequence
from tests.run.small_drive import Replay, moving


class Seeing(Replay):
    """A drive on which every scan but the first few, which are empty, sees the same points."""

    def __init__(self, points, empty=0):
        super().__init__(moving())
        self.points, self.empty = np.asarray(points, np.float32), empty

    def scans(self, start=0, count=None):
        for number, scan in enumerate(super().scans(start, count)):
            count_here = 0 if number < self.empty else len(self.points)
            none = np.zeros(count_here, np.float32)
            yield replace(
                scan,
                points=self.points[:count_here],
                time=none,
                ring=none.astype(np.int32),
                intensity=none,
            )


def around(within):
    """Return points in all directions, nine tenths of them within so many metres, and one that is none."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges = within * rng.uniform(0.3, 1.0, (2000, 1)) / np.percentile(rng.uniform(0.3, 1.0, 2000), 90)
    points = ranges * directions
    points[0] = np.nan
    return points


def open_ground(height, elevations):
    """Return what a sensor sees of a plain."""
    down = np.deg2rad([angle for angle in elevations if angle < 0])
    azimuth = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    level = height / np.tan(-down)[:, None]
    points = np.stack(np.broadcast_arrays(level * np.cos(azimuth), level * np.sin(azimuth), -height), -1)
    points = points.reshape(-1, 3)
    return points[np.linalg.norm(points, axis=1) < 100]


def values(settings):
    params = settings.params()
    paths = (path.split(".")[1:] for path in Default.near_values)
    return [float(getattr(getattr(params, section), name)) for section, name in paths]


@pytest.mark.parametrize(("within", "near"), [(2.0, True), (9.0, True), (11.0, False), (40.0, False)])
def test_voxels_are_fine_where_the_surroundings_are_near(within, near):
    settings = recipe_settings("default")
    fitted, notes = fitted_to_surroundings(Seeing(around(within)), settings)
    assert values(fitted) == pytest.approx(list(Default.near_values.values()) if near else values(settings))
    assert len(notes) == near
    if near:
        assert "90 % of the points within" in notes[0]


@pytest.mark.parametrize(
    ("height", "elevations"),
    [(0.5, np.arange(-15, 16, 2)), (0.9, np.linspace(-22.5, 22.5, 64)), (1.8, np.linspace(-45, 45, 128))],
    ids=["VLP-16 on a small robot", "OS1-64 on a cart", "OS0-128 on a car"],
)
def test_open_ground_next_to_a_low_sensor_is_no_room(height, elevations):
    plain = Seeing(open_ground(height, elevations))
    assert not fitted_to_surroundings(plain, recipe_settings("default"))[1]


def test_an_empty_first_scan_does_not_decide():
    assert fitted_to_surroundings(Seeing(around(2.0), empty=2), recipe_settings("default"))[1]
    assert not fitted_to_surroundings(Seeing(around(2.0), empty=3), recipe_settings("default"))[1]


def test_what_was_given_stays():
    given = with_overrides(recipe_settings("default"), ("params.map.voxel_size=0.8",))
    fitted, notes = fitted_to_surroundings(Seeing(around(2.0)), given)
    assert float(fitted.params().map.voxel_size) == pytest.approx(0.8)
    # the spacings are a street's, too, to go with it
    assert float(fitted.params().map.point_spacing) == pytest.approx(0.25)
    assert float(fitted.params().lidar.min_range) == pytest.approx(0.5)
    assert "voxel_size 0.4" not in notes[0]


@pytest.mark.parametrize("recipe", RECIPES)
def test_every_recipe_has_sizes_for_near_surroundings(recipe):
    settings = recipe_settings(recipe)
    fitted, notes = fitted_to_surroundings(Seeing(around(2.0)), settings)
    assert len(notes) == 1
    size = fitted.values["map"]["voxel_size"]
    assert size < 0.6 * settings.values["map"]["voxel_size"]
    assert f"map.voxel_size {size:g}" in notes[0]
    assert fitted_to_surroundings(Seeing(around(30.0)), settings) == (settings, [])


def shaken(gyro: float, accel: float, rate: float = 200.0) -> SimpleNamespace:
    """Return a recording whose inertial samples have this white noise."""
    rng = np.random.default_rng(0)
    count = round(10 * rate)
    samples = ImuData(
        stamp_ns=np.arange(count, dtype=np.int64) * round(1e9 / rate),
        gyro=rng.normal(0, gyro * rate**0.5, (count, 3)),
        accel=rng.normal([0, 0, 9.81], accel * rate**0.5, (count, 3)),
    )
    return SimpleNamespace(imu=lambda: samples)


@pytest.mark.parametrize("recipe", ["default", "lio_sam"])
def test_the_noise_of_the_samples_is_that_of_the_recording_with_a_margin(recipe):
    settings, notes = with_inertial_noise(shaken(2e-4, 3e-3), recipe_settings(recipe))
    assert settings.values["imu"]["gyro_noise"] == pytest.approx(1.5 * 2e-4, rel=0.1)
    assert settings.values["imu"]["accel_noise"] == pytest.approx(1.5 * 3e-3, rel=0.1)
    assert "imu.gyro_noise" in notes[0]
    assert "imu.accel_noise" in notes[0]


def test_given_noise_vibration_and_recipes_with_noise_of_their_own_stay():
    given = with_overrides(Settings(), ["params.imu.gyro_noise=0.001"])
    settings, notes = with_inertial_noise(shaken(2e-4, 1.0), given)
    assert settings == given
    assert notes == []
    for recipe in ("fast_lio2", "loam"):
        own = recipe_settings(recipe)
        assert with_inertial_noise(shaken(2e-4, 3e-3), own) == (own, [])
    slow = with_inertial_noise(shaken(2e-4, 3e-3, rate=10.0), Settings())
    assert slow == (Settings(), [])


def test_samples_without_noise_are_not_believed():
    settings, _ = with_inertial_noise(shaken(0.0, 0.0), Settings())
    own = Settings().values["imu"]["gyro_noise"]
    assert settings.values["imu"]["gyro_noise"] == pytest.approx(own / 30, rel=1e-2)


def street(range_sigma: float) -> list[LidarScan]:
    """Return scans of a street by a sensor with this noise of its ranges."""
    lidar = spinning_lidar(16, 512, range_sigma=range_sigma)
    return list(SimulatedSequence("street", lidar, duration_s=0.5, seed=3).scans())


@pytest.mark.parametrize("sigma", [0.005, 0.02])
def test_the_noise_of_the_ranges_is_that_of_the_scans_and_of_the_surfaces(sigma):
    settings, notes = with_range_noise(Settings(), street(sigma))
    found = np.sqrt(settings.values["lidar"]["range_sigma"] ** 2 - 0.025**2)
    assert found == pytest.approx(sigma, rel=0.15)
    assert "lidar.range_sigma" in notes[0]


def test_the_noise_of_the_ranges_stays_where_it_is_given_or_large_or_unknown_or_without_inertial_samples():
    scans = street(0.02)
    for sets in (["params.lidar.range_sigma=0.03"], ["config.imu.use=false"]):
        given = with_overrides(Settings(), sets)
        assert with_range_noise(given, scans) == (given, [])
    no_rings = [replace(scan, ring=np.full_like(scan.ring, -1)) for scan in scans]
    for others in (street(0.06), no_rings, scans[:0]):
        assert with_range_noise(Settings(), others) == (Settings(), [])
    assert with_range_noise(recipe_settings("fast_lio2"), scans) == (recipe_settings("fast_lio2"), [])


def test_a_given_least_width_leaves_the_voxels_to_the_surroundings():
    given = with_overrides(Settings(), ["params.registration.least_width=0.1"])
    settings, _ = fitted_to_surroundings(Seeing(around(2.0)), given)
    assert settings.values["map"]["voxel_size"] == Default.near_values["params.map.voxel_size"]
    assert settings.values["registration"]["least_width"] == 0.1
