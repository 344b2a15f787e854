"""Patterns select a vector of parameters, and the vector is written back."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from lio_jax.core.errors import UsageError
from lio_jax.core.leaf import leaf, section, traced
from lio_jax.tuning.parameters import free_parameters
from tests.params import DEFAULTS, Params, default_params


def test_positive_parameters_are_logarithms_and_the_rest_stays():
    free = free_parameters(default_params(), ["params.imu.*_noise", "lidar.range_sigma"])
    assert free.names == ("imu.gyro_noise", "imu.accel_noise", "lidar.range_sigma")
    params = free(free.first() + jnp.log(jnp.array([2.0, 3.0, 0.5])))
    start = default_params()
    assert float(params.imu.gyro_noise) == pytest.approx(2 * float(start.imu.gyro_noise))
    assert float(params.imu.accel_noise) == pytest.approx(3 * float(start.imu.accel_noise))
    assert float(params.lidar.range_sigma) == pytest.approx(0.5 * float(start.lidar.range_sigma))
    assert params.registration == start.registration


class Learned(eqx.Module):
    """Parameters with more than three numbers, as a learned part has them."""

    weights: Float[Array, "5"] = leaf((0.5, -1.0, 0.0, 2.0, 0.25), tuned="linear")
    scales: Float[Array, "2"] = leaf((0.5, 2.0), above=0, tuned="log")


class WithLearned(Params):
    learned: Learned = section(Learned)


def test_a_parameter_may_have_any_number_of_numbers():
    free = free_parameters(traced(WithLearned), ["learned.*"])
    assert free.names == (*(f"learned.weights.{n}" for n in range(5)), "learned.scales.0", "learned.scales.1")
    params = free(free.first() + 1.0)
    np.testing.assert_allclose(params.learned.weights, [1.5, 0.0, 1.0, 3.0, 1.25])
    np.testing.assert_allclose(params.learned.scales, np.exp(1) * np.array([0.5, 2.0]))
    written = free.overrides(np.asarray(free.first()) + 1.0)
    np.testing.assert_allclose(written["params.learned.weights"], [1.5, 0.0, 1.0, 3.0, 1.25])


def test_extrinsics_turn_and_shift_from_their_start():
    free = free_parameters(default_params(), ["extrinsics.*"])
    turn, shift = np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, 3.0])
    x = free.first() + jnp.concatenate([jnp.asarray(turn), jnp.asarray(shift), jnp.array([0.02])])
    written = free.overrides(np.asarray(x))
    expected = Rotation.from_rotvec(turn)
    assert (Rotation.from_quat(written["params.extrinsics.rotation"]) * expected.inv()).magnitude() < 1e-12
    np.testing.assert_allclose(written["params.extrinsics.translation"], shift)
    assert written["params.extrinsics.time_offset"] == pytest.approx(0.02)


@pytest.mark.parametrize(
    ("patterns", "words"),
    [
        (["map.voxel_size"], ["map.voxel_size", "no derivative", "imu.gyro_noise"]),
        (["imu.gyro_noize"], ["imu.gyro_noize", "imu.gyro_noise"]),
        (["lidar.angle_sigma"], ["lidar.angle_sigma", "is 0", "--set"]),
        ([], ["no parameter to tune"]),
    ],
)
def test_what_cannot_be_tuned_is_reported_in_one_sentence(patterns, words):
    with pytest.raises(UsageError) as raised:
        free_parameters(default_params(), patterns)
    assert all(word in str(raised.value) for word in words)


def test_a_glob_takes_what_it_can():
    free = free_parameters(default_params(), ["lidar.*", "registration.*"])
    # corrections of each ring only where they are asked for, or have numbers
    assert free.paths == (
        "lidar.range_sigma",
        "lidar.elevation_offset",
        "lidar.range_offset",
        "lidar.range_scale",
        "registration.information_scale",
        "registration.kernel",
    )


@pytest.mark.parametrize("pattern", ["lidar.ring_elevation_offset", "lidar.ring_*"])
def test_corrections_of_each_ring_start_at_zero_for_each_ring(pattern):
    free = free_parameters(default_params(), ["lidar.elevation_offset", pattern], lambda: 4)
    names = [f"lidar.ring_elevation_offset.{ring}" for ring in range(4)]
    assert free.names[:5] == ("lidar.elevation_offset", *names)
    if pattern.endswith("*"):
        assert free.names[5:] == tuple(f"lidar.ring_range_offset.{ring}" for ring in range(4))
    np.testing.assert_array_equal(free.first(), np.zeros(len(free.names)))
    x = np.arange(len(free.names)) * 1e-3
    assert free.overrides(x)["params.lidar.ring_elevation_offset"] == pytest.approx([1e-3, 2e-3, 3e-3, 4e-3])
    assert {one.unit for one in free.declared[:5]} == {"rad"}


def test_corrections_of_rings_that_are_not_known_need_a_start():
    with pytest.raises(UsageError) as raised:
        free_parameters(default_params(), ["lidar.ring_range_offset"])
    assert "--set params.lidar.ring_range_offset=[0, 0, ...]" in str(raised.value)
    with pytest.raises(UsageError):
        free_parameters(default_params(), ["lidar.ring_range_offset"], lambda: 0)
    given = traced(Params, {**DEFAULTS, "lidar": {**DEFAULTS["lidar"], "ring_range_offset": [0.01, 0.02]}})
    free = free_parameters(given, ["lidar.ring_range_offset"], lambda: 16)
    np.testing.assert_allclose(free.first(), [0.01, 0.02])
