"""The derivative of sums over placed points, against that of the sum written out."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from lio_jax.registration.point_sums import point_sums

COUNT = 60
RNG = np.random.default_rng(5)
POINTS = jnp.asarray(RNG.normal(size=(COUNT, 3)))
LEVELS = jnp.asarray(RNG.normal(size=(COUNT,)))
START = jnp.asarray(np.concatenate([RNG.normal(size=6), [0.7, 1.3]]))


MET = jnp.asarray(RNG.normal(size=(COUNT, 2)))


def rows(arm, shift, scales, met, levels):
    placed = arm + shift[:, None] + met[:, 0] * met[:, 1]
    weight = scales[0] / (1 + jnp.sum(arm**2, 0) * scales[1] ** 2)
    return jnp.stack([weight * placed[0] * placed[2], jnp.sin(placed[1] - levels), weight])


def arguments(vector, points):
    R = jaxlie.SO3.exp(vector[:3]).as_matrix()
    return points, R, vector[3:6], vector[6:]


def written_out(vector, points, met=MET):
    points, R, shift, scales = arguments(vector, points)
    return jnp.sum(rows(R @ points.T, shift, scales, met, LEVELS), -1)


def summed(vector, points, met=MET):
    total = jax.lax.stop_gradient(written_out(vector, points, met))
    return point_sums(total, rows, *arguments(vector, points), met, LEVELS)


def test_the_value_is_what_was_given():
    np.testing.assert_array_equal(summed(START, POINTS), written_out(START, POINTS))


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("by", [0, 1, 2], ids=["pose and scales", "points", "what they lie on"])
def test_derivatives_are_those_of_the_sum(mode, by):
    expected = jax.jacfwd(written_out, by)(START, POINTS, MET)
    np.testing.assert_allclose(mode(summed, by)(START, POINTS, MET), expected, rtol=1e-10, atol=1e-12)


def test_a_tangent_of_everything_is_the_sum_of_the_parts():
    place = START, POINTS, MET
    tangents = tuple(jnp.asarray(RNG.normal(size=part.shape)) for part in place)
    expected = jax.jvp(written_out, place, tangents)[1]
    np.testing.assert_allclose(jax.jvp(summed, place, tangents)[1], expected, rtol=1e-10)
