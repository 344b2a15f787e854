"""Prefix sums by products against numpy's cumulative sums."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.prefix_sum import prefix_sum, running_count


@pytest.mark.parametrize("count", [1, 5, 32, 64, 65, 96, 1000, 5000])
def test_sums_of_rows(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 2, 3))
    np.testing.assert_allclose(prefix_sum(jnp.asarray(values)), np.cumsum(values, axis=0), atol=1e-11)
    np.testing.assert_allclose(
        prefix_sum(jnp.asarray(values[:, 0, 0])), np.cumsum(values[:, 0, 0]), atol=1e-11
    )


@pytest.mark.parametrize("count", [1, 33, 8192, 100_000])
def test_counts_are_exact(count: int) -> None:
    mask = np.random.default_rng(count).random(count) < 0.7
    got = jax.jit(running_count)(jnp.asarray(mask))
    assert got.dtype == jnp.int32
    np.testing.assert_array_equal(got, np.cumsum(mask))


def test_the_derivative_is_the_sum_of_what_follows() -> None:
    weights = jnp.asarray(np.random.default_rng(0).normal(size=70))
    slope = jax.grad(lambda values: weights @ prefix_sum(values))(jnp.zeros(70))
    np.testing.assert_allclose(slope, np.cumsum(weights[::-1])[::-1], atol=1e-12)
