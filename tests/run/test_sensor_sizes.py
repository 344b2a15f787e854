"""Sizes of the feature arrays by a recording's first scan."""

import numpy as np
import pytest

from lio_jax.data.sequence import LidarScan
from lio_jax.lidar.params import LoamRingConfig
from lio_jax.run.fitted_settings import (
    notes_on_rings,
    ring_count,
    with_point_order,
    with_sensor_sizes,
)
from lio_jax.settings.settings import recipe_settings, with_overrides

LOAM = recipe_settings("loam")


def scan(rings: int, per_ring: int) -> LidarScan:
    ring = np.repeat(np.arange(rings, dtype=np.int32), per_ring)
    none = np.zeros(len(ring), np.float32)
    return LidarScan(0, np.ones((len(ring), 3), np.float32), none, ring, none, 0.1)


@pytest.mark.parametrize(("beams", "rings"), [(8, 8), (16, 16), (40, 40), (64, 64), (128, 128)])
def test_the_arrays_hold_every_ring_of_the_first_scan_with_points(beams, rings):
    settings, said = with_sensor_sizes(LOAM, [scan(0, 0), scan(beams, 900)])
    features = settings.config.features
    assert features.rings == rings
    assert 900 < features.columns < 1200
    assert 0 < features.surface_points <= 49152
    (sentence,) = said
    assert sentence.startswith(f"Sizes by the first scans: config.features.rings={rings}, ")
    assert sentence.endswith(f"config.features.surface_points={features.surface_points}.")


def test_a_first_scan_that_is_cut_short_or_sees_the_lower_beams_alone_does_not_decide():
    features = with_sensor_sizes(LOAM, [scan(16, 100), scan(8, 900), scan(32, 800)])[0].config.features
    assert features.rings == 32
    assert 900 < features.columns < 1200


def test_what_is_given_stays():
    given = with_overrides(LOAM, ["config.features.rings=32", "config.features.surface_points=1000"])
    settings, _ = with_sensor_sizes(given, [scan(64, 900)])
    assert (settings.config.features.rings, settings.config.features.surface_points) == (32, 1000)
    fixed = with_overrides(given, ["config.features.columns=640"])
    assert with_sensor_sizes(fixed, iter(())) == (fixed, [])


@pytest.mark.parametrize("scans", [[], [scan(0, 0)]])
def test_a_recording_without_points_gets_the_usual_sizes(scans):
    features = with_sensor_sizes(LOAM, scans)[0].config.features
    assert (features.rings, features.columns) == (LoamRingConfig().rings, LoamRingConfig().columns)


def test_rings_of_a_few_points_leave_room_for_a_neighbourhood():
    features = with_sensor_sizes(LOAM, [scan(16, 3)])[0].config.features
    assert features.columns > 2 * features.neighbours


LIO_SAM = recipe_settings("lio_sam")


def lines(azimuth: np.ndarray, shuffled: bool = False) -> LidarScan:
    """Four rings whose points follow each other along the azimuths (rad)."""
    azimuth = np.repeat(azimuth, 4)
    ring = np.tile(np.arange(4, dtype=np.int32), len(azimuth) // 4)
    time = np.linspace(0, 0.1, len(ring)).astype(np.float32)
    points = np.stack([10 * np.cos(azimuth), 10 * np.sin(azimuth), ring], axis=1).astype(np.float32)
    order = np.random.default_rng(0).permutation(len(ring)) if shuffled else slice(None)
    return LidarScan(0, points[order], time[order], ring[order], time[order], 0.1)


def order_of(settings, *scans: LidarScan) -> tuple[str, list[str]]:
    chosen, notes = with_point_order(settings, scans)
    return chosen.config.features.order, notes


def test_lines_that_swing_to_and_fro_keep_the_order_of_the_scan():
    swings = lines(0.6 * np.sin(np.linspace(0, 40, 900)))
    order, (note,) = order_of(LIO_SAM, scan(0, 0), swings)
    assert order == "arrival"
    assert "config.features.order=arrival" in note
    given = with_overrides(LIO_SAM, ["config.features.order=azimuth"])
    assert order_of(given, swings) == ("azimuth", [])


@pytest.mark.parametrize("turns", [1, -1])
@pytest.mark.parametrize("shuffled", [False, True])
def test_rings_of_a_turning_sensor_go_by_azimuth(turns, shuffled):
    turning = lines(np.linspace(-np.pi, turns * 2 * np.pi - np.pi, 900), shuffled)
    assert order_of(LIO_SAM, turning) == ("azimuth", [])


def test_points_in_no_order_at_all_go_by_azimuth():
    turning = lines(np.linspace(-np.pi, np.pi, 900), shuffled=True)
    untimed = LidarScan(0, turning.points, np.zeros_like(turning.time), turning.ring, turning.time, 0.0)
    assert order_of(LIO_SAM, untimed, scan(0, 0)) == ("azimuth", [])


def test_lists_with_a_number_per_ring_should_fit_the_rings_of_the_scans():
    short, long, fitting = (
        with_overrides(LOAM, [f"params.lidar.ring_range_offset={[0.01] * length}"]) for length in (3, 32, 16)
    )
    scans = [scan(0, 0), scan(12, 100), scan(16, 100)]
    assert ring_count(scans) == 16
    (sentence,) = notes_on_rings(short, scans)
    assert sentence == (
        "params.lidar.ring_range_offset has 3 numbers and the first scans have 16 rings: "
        "the numbers are those of rings 0 to 2, the other rings have none."
    )
    (sentence,) = notes_on_rings(long, scans)
    assert sentence.endswith(
        "32 numbers and the first scans have 16 rings: the numbers are those of rings 0 to 31."
    )
    assert notes_on_rings(fitting, scans) == notes_on_rings(LOAM, scans) == []
