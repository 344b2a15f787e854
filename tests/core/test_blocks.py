"""Matrices put together from blocks against numpy's assignments."""

import jax
import jax.numpy as jnp
import numpy as np

from lio_jax.core.geometry import from_blocks


def test_blocks_stand_where_they_were_put_and_add_up() -> None:
    rng = np.random.default_rng(0)
    one, other, all_over = rng.normal(size=(2, 3)), rng.normal(size=(3, 1)), rng.normal(size=(4, 6))
    expected = all_over.copy()
    expected[1:3, :3] += one
    expected[1:, 5:] += other
    got = from_blocks(
        (4, 6),
        (slice(1, 3), slice(0, 3), jnp.asarray(one)),
        (slice(1, None), slice(5, 6), jnp.asarray(other)),
        (slice(None), slice(None), jnp.asarray(all_over)),
    )
    np.testing.assert_array_equal(got, expected)


def test_what_is_not_covered_is_zero_and_of_the_blocks_dtype() -> None:
    got = from_blocks((3, 3), (slice(0, 1), slice(2, 3), jnp.ones((1, 1), jnp.float32)))
    assert got.dtype == jnp.float32
    np.testing.assert_array_equal(got, [[0, 0, 1], [0, 0, 0], [0, 0, 0]])


def test_each_block_has_its_part_of_the_derivative() -> None:
    weights = jnp.arange(12.0).reshape(3, 4)
    place = (slice(1, 3), slice(1, 3))
    slope = jax.grad(lambda block: jnp.sum(weights * from_blocks((3, 4), (*place, block))))(jnp.zeros((2, 2)))
    np.testing.assert_array_equal(slope, weights[place])
