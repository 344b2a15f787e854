"""The rosette: field of view, rate, and that it never repeats itself."""

import numpy as np
import pytest

from lio_jax.sim.sensors import livox

LIDAR = livox()


def _directions(number):
    """Return the directions of sweep ``number`` and their angles from +x towards +y and +z, deg."""
    phase = LIDAR.phase(number * LIDAR.period_ns)
    directions = np.asarray(LIDAR.directions(phase), float)
    off_axis = np.arccos(np.clip(directions[..., 0], -1, 1))
    scale = np.rad2deg(off_axis) / np.maximum(np.hypot(directions[..., 1], directions[..., 2]), 1e-12)
    return directions, directions[..., 1] * scale, directions[..., 2] * scale


def test_rate_and_field_of_view_are_those_of_an_avia():
    directions, across, upwards = _directions(0)
    assert directions.shape == (4000, 6, 3)
    assert directions.shape[0] * directions.shape[1] / LIDAR.period == pytest.approx(240_000)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose([np.ptp(across), np.ptp(upwards)], [70.4, 77.2], atol=0.5)
    assert np.abs(across).max() <= 35.2 + 1e-3
    assert np.abs(upwards).max() <= 38.6 + 1e-3


@pytest.mark.parametrize("number", [0, 1, 36_000])
def test_two_prisms_steer_the_beam(number):
    _, across, upwards = _directions(number)
    start = number * 0.1
    time = start + np.arange(4000) * 25e-6
    line = 4
    time = time + LIDAR.delay_ns[line] * 1e-9
    turns = [rate * 1e-3 for rate in LIDAR.prism_mhz]
    steered = 17.6 * sum(np.exp(2j * np.pi * rate * time) for rate in turns)
    np.testing.assert_allclose(across[:, line], steered.real, atol=1e-5)
    fan = np.rad2deg(LIDAR.fan[line])
    np.testing.assert_allclose(upwards[:, line], steered.imag + fan, atol=1e-5)


def test_each_sweep_fills_in_what_the_last_left_out():
    seen: set[tuple[int, int]] = set()
    covered = []
    for number in range(8):
        _, across, upwards = _directions(number)
        cells = np.stack([across, upwards], axis=-1).reshape(-1, 2) // 0.5
        seen |= set(map(tuple, cells.astype(int).tolist()))
        covered.append(len(seen))
    assert covered[1] > 1.3 * covered[0]
    assert covered[7] > 1.6 * covered[0]


def test_sweeps_differ():
    first, second = (_directions(number)[0] for number in (0, 1))
    assert np.abs(first - second).max() > 0.1
