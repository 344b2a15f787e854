"""The covariance of many intervals' noise: its sum over single errors, and its slopes."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.imu.discretise import IntervalNoise, process_noise, process_noise_slopes
from tests.imu.motion import quick_jit

RESULTS, INTERVALS = 4, 7


def inputs_and_noise(seed: int) -> tuple[jax.Array, IntervalNoise]:
    rng = np.random.default_rng(seed)
    inputs = jnp.asarray(rng.normal(size=(INTERVALS, RESULTS, 6)))
    return inputs, IntervalNoise(*(jnp.asarray(rng.uniform(0.1, 1, INTERVALS)) for _ in range(4)))


@pytest.mark.parametrize("measured", [True, False])
def test_the_covariance_is_that_of_simulated_errors(measured: bool) -> None:
    """Follow each single error through the intervals: a bias that changes acts on the later ones only."""
    inputs, noise = inputs_and_noise(0)
    expected = np.zeros((RESULTS + 6, RESULTS + 6))
    for i in range(INTERVALS):
        variances = [noise.gyro[i], noise.accel[i], noise.gyro_bias[i], noise.accel_bias[i]]
        for axis in range(12):
            effect = np.zeros(RESULTS + 6)
            if axis < 6:
                effect[:RESULTS] = inputs[i, :, axis]
            else:
                effect[RESULTS + axis - 6] = 1
                # the bias is subtracted from every later sample
                for later in range(i + 1, INTERVALS):
                    effect[:RESULTS] -= measured * np.asarray(inputs[later, :, axis - 6])
            expected += float(variances[axis // 3]) * np.outer(effect, effect)
    np.testing.assert_allclose(quick_jit(process_noise)(inputs, noise, measured), expected, rtol=1e-12)


@pytest.mark.parametrize("measured", [True, False])
def test_slopes_are_automatic_derivatives(measured: bool) -> None:
    inputs, noise = inputs_and_noise(1)
    rng = np.random.default_rng(2)
    inputs_slopes = jnp.asarray(rng.normal(size=(3, *inputs.shape)))
    noise_slopes = jax.vmap(lambda x: IntervalNoise(*x))(jnp.asarray(rng.normal(size=(5, 4, INTERVALS))))
    by_inputs, by_noise = quick_jit(process_noise_slopes)(
        inputs, inputs_slopes, noise, noise_slopes, measured
    )

    def along_inputs(direction):
        return jax.jvp(lambda x: process_noise(x, noise, measured), (inputs,), (direction,))[1]

    def along_noise(direction):
        return jax.jvp(lambda x: process_noise(inputs, x, measured), (noise,), (direction,))[1]

    np.testing.assert_allclose(by_inputs, jax.vmap(along_inputs)(inputs_slopes), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(by_noise, jax.vmap(along_noise)(noise_slopes), rtol=1e-12, atol=1e-12)


def test_variances_are_linear() -> None:
    inputs, noise = inputs_and_noise(3)
    double = dataclasses.replace(
        noise, **{f.name: 2 * getattr(noise, f.name) for f in dataclasses.fields(noise)}
    )
    np.testing.assert_allclose(process_noise(inputs, double), 2 * process_noise(inputs, noise), rtol=1e-12)
