"""The accelerometer's unit is recognised by gravity."""

from dataclasses import replace

import numpy as np
import pytest

from lio_jax.data.config import DataConfig
from lio_jax.data.imu_checks import accel_scale

CONFIG = DataConfig()


def _driving(gravity: float) -> np.ndarray:
    rng = np.random.default_rng(1)
    return np.array([0.0, 0.0, gravity]) + rng.normal(0.0, 0.1 * gravity, (500, 3))


def test_the_unit_g_is_recognised_and_reported() -> None:
    scale, note = accel_scale(_driving(1.0), CONFIG)
    assert scale == 9.80665
    assert note == "accelerometer in g (median 0.997): converted to m/s^2"


def test_metres_per_second_squared_pass_in_silence() -> None:
    assert accel_scale(_driving(9.81), CONFIG) == (1.0, "")


def test_free_fall_for_a_moment_does_not_confuse() -> None:
    accel = _driving(9.81)
    accel[:200] = [0.0, 0.0, 1.0]
    assert accel_scale(accel, CONFIG)[0] == 1.0


def test_neither_is_pointed_out() -> None:
    scale, note = accel_scale(_driving(3.2), CONFIG)
    assert scale == 1.0
    assert "neither 1 g nor 9.8 m/s^2" in note
    assert "config.data.accel_unit" in note


def test_the_unit_can_be_given() -> None:
    assert accel_scale(_driving(9.81), replace(CONFIG, accel_unit="g")) == (pytest.approx(9.80665), "")
    assert accel_scale(_driving(1.0), replace(CONFIG, accel_unit="m/s^2")) == (1.0, "")


def test_no_samples_are_no_trouble() -> None:
    assert accel_scale(np.empty((0, 3)), CONFIG) == (1.0, "")
