"""Derivatives of an update's parts where eigenvalues meet or vanish, against central differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.estimation.innovation import innovation_of, square_root_information
from lio_jax.estimation.pose_measurement import keep_observed


def symmetric(values, seed):
    rotation = np.linalg.qr(np.random.default_rng(seed).normal(size=(len(values),) * 2))[0]
    return jnp.asarray(rotation @ np.diag(values) @ rotation.T)


@pytest.mark.parametrize("values", [[3.0, 3.0, 3.0], [5.0, 5.0, 1.0], [4.0, 2.0, 1.0]], ids=str)
def test_statistics_have_derivatives_where_eigenvalues_meet(values):
    rng = np.random.default_rng(0)
    information, change, W = (
        symmetric(values, 1),
        symmetric([1.0, -2.0, 0.5], 2),
        symmetric([0.1, 0.2, 0.3], 3),
    )
    gradient, gradient_change = jnp.asarray(rng.normal(size=(2, 3)))

    def statistics(t):
        root, whitened, eigenvalues = square_root_information(
            information + t * change, gradient + t * gradient_change
        )
        innovation = innovation_of(root.T @ W @ root, whitened, eigenvalues)
        return jnp.stack([innovation.nis, innovation.log_det])

    step = 1e-6
    expected = (statistics(step) - statistics(-step)) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(statistics)(0.0), expected, rtol=1e-7)
    np.testing.assert_allclose(jax.jacrev(statistics)(0.0), expected, rtol=1e-7)


def test_statistics_have_derivatives_without_information_in_a_direction():
    """A change within the observed plane, and one that turns the plane."""
    root = jnp.asarray(np.random.default_rng(4).normal(size=(3, 2)))
    turn = jnp.asarray(np.random.default_rng(5).normal(size=(3, 2)))
    W = symmetric([0.1, 0.2, 0.3], 6)

    def statistics(t):
        moved = root + t * turn
        factor, whitened, eigenvalues = square_root_information(
            moved @ moved.T, moved @ jnp.array([0.4, -0.7])
        )
        innovation = innovation_of(factor.T @ W @ factor, whitened, eigenvalues)
        return jnp.stack([innovation.nis, innovation.log_det])

    step = 1e-6
    expected = (statistics(step) - statistics(-step)) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(statistics)(0.0), expected, rtol=1e-6)


@pytest.mark.parametrize("weak", [0, 1, 2])
def test_dropped_directions_turn_with_the_information(weak):
    values = [1e-4] * weak + [3.0, 3.0, 7.0, 7.0, 8.0, 9.0][weak:]
    information, change = symmetric(values, 7), symmetric([1.0, -1.0, 2.0, 0.3, 0.1, -0.4], 8)
    rng = np.random.default_rng(9)
    gradient, gradient_change = jnp.asarray(rng.normal(size=(2, 6)))

    def kept(t):
        # the dropped directions' own information stays small, as the number dropped is a choice
        held, along, _ = keep_observed(
            information + t * change, gradient + t * gradient_change, jnp.asarray(1.0 + t), jnp.array(0.01)
        )
        return jnp.concatenate([held.ravel(), along])

    step = 1e-7
    expected = (kept(step) - kept(-step)) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(kept)(0.0), expected, rtol=1e-5, atol=1e-6)
