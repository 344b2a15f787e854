import math

import numpy as np
import pytest

from lio_jax.core.errors import UsageError
from lio_jax.data.reconstruct import (
    KITTI_START_AZIMUTH,
    azimuth_time,
    guess_beams,
    ring_from_azimuth_wraps,
    ring_from_elevation,
)
from tests.shared_data import SHARED_DATA, needs_shared


def points_at(
    azimuth: np.ndarray, elevation_deg: np.ndarray | float = 0.0, range_m: float = 10.0
) -> np.ndarray:
    elevation = np.radians(np.broadcast_to(elevation_deg, np.shape(azimuth)))
    return (
        range_m
        * np.stack(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
        )
    ).astype(np.float32)


def loam_relative_time(points: np.ndarray) -> list[float]:
    """A-LOAM's point by point loop, as its paper's code states it."""
    start = -math.atan2(points[0, 1], points[0, 0])
    end = -math.atan2(points[-1, 1], points[-1, 0]) + 2 * math.pi
    if end - start > 3 * math.pi:
        end -= 2 * math.pi
    elif end - start < math.pi:
        end += 2 * math.pi
    half_passed, times = False, []
    for x, y, _ in points:
        orientation = -math.atan2(y, x)
        if not half_passed:
            if orientation < start - math.pi / 2:
                orientation += 2 * math.pi
            elif orientation > start + math.pi * 3 / 2:
                orientation -= 2 * math.pi
            if orientation - start > math.pi:
                half_passed = True
        else:
            orientation += 2 * math.pi
            if orientation < end - math.pi * 3 / 2:
                orientation += 2 * math.pi
            elif orientation > end + math.pi / 2:
                orientation -= 2 * math.pi
        times.append((orientation - start) / (end - start))
    return times


@pytest.mark.parametrize("start", [-3.0, -1.0, 0.0, 0.7, 2.5, 3.1])
@pytest.mark.parametrize("turn", [0.7, 0.95, 1.0, 1.04, 1.3])
def test_time_between_first_and_last_point_is_that_of_loams_loop(start: float, turn: float) -> None:
    jitter = np.random.default_rng(1).normal(0.0, 2e-3, 3000)
    jitter[[0, -1]] = 0.0
    points = points_at(start - np.linspace(0.0, turn * 2 * np.pi, 3000) + jitter)
    expected = np.clip(loam_relative_time(points), 0.0, 1.0) * 0.1
    np.testing.assert_allclose(azimuth_time(points, 0.1), expected, atol=1e-6)


def test_time_ascends_evenly_over_a_clockwise_sweep() -> None:
    points = points_at(1.2 - np.linspace(0.0, 2.02 * np.pi, 5000))
    np.testing.assert_allclose(azimuth_time(points, 0.1), np.linspace(0.0, 0.1, 5000), atol=1e-6)


def test_counter_clockwise_sweeps_are_mirrored() -> None:
    points = points_at(1.2 + np.linspace(0.0, 1.98 * np.pi, 5000))
    times = azimuth_time(points, 0.1, clockwise=False)
    np.testing.assert_allclose(times, np.linspace(0.0, 0.1, 5000), atol=1e-6)


def test_a_fixed_start_measures_one_turn_from_there() -> None:
    azimuth = np.radians([179.999, 90.0, 0.0, -90.0, -179.999])
    times = azimuth_time(points_at(azimuth), 0.1, start_azimuth=KITTI_START_AZIMUTH)
    np.testing.assert_allclose(times, [0.0, 0.025, 0.05, 0.075, 0.1], atol=1e-6)


def test_points_stored_ring_by_ring_get_the_time_of_their_azimuth() -> None:
    """The last point ends a ring, not the sweep: A-LOAM's rule would give later rings one time."""
    azimuth = 0.5 - np.linspace(0.0, 2 * np.pi, 1000, endpoint=False)
    points = np.concatenate([points_at(azimuth, elevation) for elevation in np.linspace(-15, 15, 16)])
    expected = np.tile(np.linspace(0.0, 0.1, 1000, endpoint=False), 16)
    off = np.abs(azimuth_time(points, 0.1) - expected)
    assert np.median(off) < 1e-6
    assert (np.minimum(off, 0.1 - off) < 1e-6).all()


def test_times_stay_within_the_sweep() -> None:
    points = np.random.default_rng(0).normal(size=(2000, 3)).astype(np.float32)
    for start in (None, 0.3):
        times = azimuth_time(points, 0.1, start_azimuth=start)
        assert times.dtype == np.float32
        assert times.min() >= 0.0
        assert times.max() <= np.float32(0.1)


def test_no_points_and_no_duration_give_no_time() -> None:
    assert azimuth_time(np.zeros((0, 3), np.float32), 0.1).shape == (0,)
    assert not azimuth_time(points_at(np.linspace(0, 3, 9)), 0.0).any()


def test_sixteen_beams_are_recognised_by_their_elevation() -> None:
    elevation = np.arange(-15.0, 15.1, 2.0)
    np.testing.assert_array_equal(ring_from_elevation(points_at(np.zeros(16), elevation), 16), np.arange(16))


def test_thirty_two_beams_are_recognised_by_their_elevation() -> None:
    elevation = -92.0 / 3.0 + np.arange(32) * 4.0 / 3.0 + 0.05
    np.testing.assert_array_equal(ring_from_elevation(points_at(np.zeros(32), elevation), 32), np.arange(32))


@pytest.mark.parametrize(
    ("elevation", "ring"),
    [
        (1.99, 0),
        (1.5, 2),
        (0.0, 6),
        (-8.55, 32),
        (-8.8, 32),
        (-9.0, 32),
        (-10.0, 34),
        (-17.5, 49),
        (-18.2, -1),
        (2.1, -1),
    ],
)
def test_sixty_four_beams_are_recognised_by_loams_two_blocks(elevation: float, ring: int) -> None:
    point = points_at(np.zeros(1), np.array([elevation]))
    a = elevation
    expected = int((2 - a) * 3 + 0.5) if a >= -8.83 else 32 + int((-8.83 - a) * 2 + 0.5)
    expected = expected if -24.33 <= a <= 2 and expected <= 50 else -1
    assert ring_from_elevation(point, 64)[0] == ring == expected


@pytest.mark.parametrize(
    ("beams", "elevation"), [(16, 17.0), (16, -19.0), (32, 14.0), (32, -33.0), (64, -25.0)]
)
def test_points_of_no_beam_get_minus_one(beams: int, elevation: float) -> None:
    assert ring_from_elevation(points_at(np.zeros(1), elevation), beams)[0] == -1


def test_other_numbers_of_beams_are_refused() -> None:
    with pytest.raises(UsageError, match=r"config\.data\.beams=40"):
        ring_from_elevation(np.ones((1, 3), np.float32), 40)


@pytest.mark.parametrize(("beams", "low", "high"), [(16, -15.0, 5.0), (32, -30.67, 10.67), (64, -24.3, 2.0)])
def test_the_number_of_beams_is_guessed_by_the_lowest(beams: int, low: float, high: float) -> None:
    rng = np.random.default_rng(2)
    elevation = rng.choice(np.linspace(low, high, beams), 20000)
    assert guess_beams(points_at(rng.uniform(-3, 3, 20000), elevation)) == beams


def test_the_last_point_of_a_ring_may_be_rounded_to_minus_zero() -> None:
    ring = points_at(np.linspace(0.01, 2 * np.pi - 0.01, 500))
    ring[-1] = (10.0, -0.0, 0.0)
    np.testing.assert_array_equal(ring_from_azimuth_wraps(np.tile(ring, (3, 1))), np.repeat([0, 1, 2], 500))


def test_half_empty_rings_are_still_told_apart() -> None:
    """Beams into the sky return from one side only."""
    ring = points_at(np.linspace(0.2, 2.0, 300))
    np.testing.assert_array_equal(ring_from_azimuth_wraps(np.tile(ring, (3, 1))), np.repeat([0, 1, 2], 300))


@needs_shared
@pytest.mark.parametrize(
    "folder",
    [
        "kitti_odometry/sequences/04/velodyne",
        "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync/velodyne_points/data",
        "kitti_raw/2011_09_26/2011_09_26_drive_0060_sync/velodyne_points/data",
    ],
)
def test_real_kitti_scans_have_64_rings_from_top_to_bottom(folder: str) -> None:
    for path in sorted((SHARED_DATA / folder).glob("*.bin")):
        points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]
        ring = ring_from_azimuth_wraps(points)
        assert ring[-1] == 63, path
        elevation = np.degrees(np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1])))
        medians = np.array([np.median(elevation[ring == beam]) for beam in range(64)])
        assert (np.diff(medians) < -0.1).all(), path
        assert guess_beams(points) == 64
