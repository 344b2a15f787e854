"""The logarithm of poses against the exponential's power series, up to third derivatives."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.linalg import logm

from lio_jax.pose_graph.factors import logarithm
from lio_jax.pose_graph.graph import matrices_of
from tests.loops.graphs import stacked

GROUPS = pytest.mark.parametrize("group", [jaxlie.SE3, jaxlie.SE2], ids=["space", "plane"])
ANGLES = [0.0, 1e-9, 3e-6, 1.1e-5, 3e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.27, 0.29, 0.49, 0.51, 1.0, 2.0]


def matrix_of(tangent):
    """Return the matrix of the Lie algebra, for a tangent with the rotation first."""
    if len(tangent) == 3:
        w, x, y = tangent
        return jnp.array([[0, -w, x], [w, 0, y], [0, 0, 0]])
    a, b, c, x, y, z = tangent
    return jnp.array([[0, -c, b, x], [c, 0, -a, y], [-b, a, 0, z], [0, 0, 0, 0]])


def exponential(tangent):
    """Return the (1,) pose of a tangent by the power series of its matrix."""
    matrix = matrix_of(tangent)
    one = jnp.eye(len(matrix))

    def add(n, sums):
        term = sums[0] @ matrix / n
        return term, sums[1] + term

    total = jax.lax.fori_loop(1, 30, add, (one, one))[1]
    if len(tangent) == 3:
        return jaxlie.SE2(jnp.concatenate([total[:2, 0], total[:2, 2]])[None])
    w = jnp.sqrt(1 + jnp.trace(total[:3, :3])) / 2
    lower, upper = jnp.array([2, 0, 1]), jnp.array([1, 2, 0])
    vector = (total[lower, upper] - total[upper, lower]) / (4 * w)
    return jaxlie.SE3(jnp.concatenate([w[None], vector, total[:3, 3]])[None])


compiled_logarithm = jax.jit(logarithm)


@jax.jit
def derivatives_along(tangent, direction):
    """Return the logarithm of the exponential along a direction, and its first three derivatives."""

    def along(t):
        return logarithm(exponential(tangent + t * direction))[0]

    def with_slope(function):
        return lambda t: jax.jvp(function, (t,), (1.0,))

    ((value, first), _), (_, (second, third)) = with_slope(with_slope(with_slope(along)))(0.0)
    return value, first, second, third


@GROUPS
@pytest.mark.parametrize("angle", ANGLES)
def test_logarithm_inverts_the_exponential_up_to_third_derivatives(group, angle):
    rng = np.random.default_rng(3)
    tangent, direction = rng.normal(size=(2, group.tangent_dim))
    turning = slice(0, 1 if group is jaxlie.SE2 else 3)
    tangent[turning] *= angle / np.linalg.norm(tangent[turning])
    value, first, second, third = derivatives_along(jnp.asarray(tangent), jnp.asarray(direction))
    np.testing.assert_allclose(value, tangent, atol=1e-14)
    np.testing.assert_allclose(first, direction, atol=1e-13)
    np.testing.assert_allclose(second, 0, atol=1e-12)
    np.testing.assert_allclose(third, 0, atol=1e-11)


@GROUPS
def test_logarithm_is_that_of_the_matrices(group):
    rng = np.random.default_rng(4)
    tangents = rng.normal(size=(6, group.tangent_dim)) * 0.1 ** np.arange(6)[:, None]
    poses = group.exp(jnp.asarray(tangents))
    expected = np.stack([logm(matrix) for matrix in matrices_of(poses)])
    ours = np.stack([matrix_of(tangent) for tangent in compiled_logarithm(poses)])
    np.testing.assert_allclose(ours, expected, atol=1e-13)


def test_both_quaternions_of_a_rotation_have_one_logarithm():
    pose = jaxlie.SE3.exp(jnp.array([1.0, 2.0, 3.0, 0.2, -0.1, 0.3]))
    other = jaxlie.SE3(pose.wxyz_xyz * jnp.array([-1, -1, -1, -1, 1, 1, 1]))
    first, second = compiled_logarithm(stacked([pose, other]))
    np.testing.assert_allclose(first, [0.2, -0.1, 0.3, 1.0, 2.0, 3.0], atol=1e-14)
    np.testing.assert_allclose(second, first, atol=1e-14)


def test_half_a_turn_is_finite():
    half = jaxlie.SE3(jnp.array([[0.0, 0, 0, 1, 1, 2, 3]]))
    np.testing.assert_allclose(compiled_logarithm(half)[0, :3], [0, 0, np.pi], atol=1e-14)
    slope = jax.jit(jax.jacfwd(lambda numbers: logarithm(jaxlie.SE3(numbers))))(half.wxyz_xyz)
    assert np.all(np.isfinite(slope))
