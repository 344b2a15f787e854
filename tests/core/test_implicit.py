"""Implicit derivatives against a closed form and central differences."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.implicit import ImplicitSolution, Problem, implicit, with_derivative_of


def solve(inputs):
    """Find x of x^3 + a x = b per component; report a x and the number of steps."""
    a, b, count = inputs

    def newton(carry):
        x, steps = carry
        return x - (x**3 + a * x - b) / (3 * x**2 + a), steps + 1

    x, steps = jax.lax.while_loop(
        lambda carry: jnp.max(jnp.abs(carry[0] ** 3 + a * carry[0] - b)) > 1e-13,
        newton,
        (jnp.ones_like(b), count),
    )
    return ImplicitSolution(x, steps, (a * x, steps))


CUBIC = Problem(
    solve,
    lambda x, steps, inputs: x**3,
    lambda x, cube, steps, inputs: cube + inputs[0] * x - inputs[1],
    lambda x, cube, steps, inputs: (inputs[0] * x, steps),
)


def total(a, b):
    solution = implicit(CUBIC, (a, b, jnp.int32(0)))
    return jnp.sum(solution.root**2) + jnp.sum(jnp.sin(solution.reported[0]))


A, B = jnp.array(2.0), jnp.array([1.0, 2.0, 3.0])


@pytest.mark.parametrize("derivative", [jax.grad, jax.jacfwd, jax.jacrev], ids=lambda f: f.__name__)
def test_derivatives_agree_with_central_differences_in_both_modes(derivative):
    step = 1e-6
    by_a = (total(A + step, B) - total(A - step, B)) / (2 * step)
    assert float(jax.jit(derivative(total))(A, B)) == pytest.approx(float(by_a), rel=1e-8)
    for k in range(3):
        shift = step * jnp.eye(3)[k]
        by_b = (total(A, B + shift) - total(A, B - shift)) / (2 * step)
        assert float(jax.jit(derivative(total, 1))(A, B)[k]) == pytest.approx(float(by_b), rel=1e-8)


def test_a_batch_of_tangents_shares_the_solve():
    directions = jnp.eye(3)
    batched = jax.vmap(lambda d: jax.jvp(lambda b: total(A, b), (B,), (d,)), out_axes=(None, 0))(directions)
    np.testing.assert_allclose(batched[1], jax.grad(total, 1)(A, B), rtol=1e-12)


def test_what_is_not_moved_costs_no_derivative():
    solution = eqx.filter_jvp(lambda a: implicit(CUBIC, (A, B, a)).root, (jnp.int32(0),), (None,))
    np.testing.assert_allclose(solution[0] ** 3 + A * solution[0], B, atol=1e-12)


def test_low_rank_directions_give_the_same_derivative():
    """The probe feels the sum of the root's components alone."""

    def solved(inputs):
        x = jnp.linalg.solve(jnp.eye(3) * 2 + 0.3 * jnp.ones((3, 3)), inputs)
        return ImplicitSolution(x, None, jnp.zeros(()))

    def problem(directions):
        return Problem(
            solved,
            lambda x, _, b: 0.3 * jnp.sum(x),
            lambda x, probed, _, b: 2 * x + probed - b,
            lambda x, probed, _, b: probed,
            directions,
        )

    few = problem(lambda x, b: (jnp.ones((3, 1)) / 3, jnp.ones((1, 3))))
    for p in (few, problem(None)):
        jacobian = jax.jacfwd(lambda b, p=p: implicit(p, b).root)(B)
        np.testing.assert_allclose(jacobian, np.linalg.inv(np.eye(3) * 2 + 0.3), atol=1e-14)
        slope = jax.jacfwd(lambda b, p=p: implicit(p, b).reported)(B)
        np.testing.assert_allclose(slope, 0.3 * jacobian.sum(0), atol=1e-14)


def test_a_known_value_takes_the_derivative_of_its_formula():
    value, slope = jax.value_and_grad(lambda x: with_derivative_of(jnp.array(7.0), jnp.sin, x))(
        jnp.array(0.3)
    )
    assert float(value) == 7.0
    assert float(slope) == pytest.approx(np.cos(0.3))


def test_a_structured_inverse_of_the_slope_gives_the_same_derivative_in_both_modes():
    """x + a tanh(x) = b, whose slope is diagonal; without the probe's derivatives one by one."""

    def solved(inputs):
        a, b = inputs
        step = lambda _, x: x - (x + a * jnp.tanh(x) - b) / (1 + a / jnp.cosh(x) ** 2)  # noqa: E731
        x = jax.lax.fori_loop(0, 30, step, b)
        return ImplicitSolution(x, None, jnp.sum(jnp.tanh(x)))

    def problem(inverse_slope):
        return Problem(
            solved,
            lambda x, _, inputs: jnp.tanh(x),
            lambda x, probed, _, inputs: x + inputs[0] * probed - inputs[1],
            lambda x, probed, _, inputs: jnp.sum(probed),
            inverse_slope=inverse_slope,
        )

    def diagonal(x, _, inputs, right):
        return right / (1 + inputs[0] / jnp.cosh(x) ** 2)

    def values(problem):
        return lambda a: jnp.append(*implicit(problem, (a, B))[::2])

    expected = jax.jacfwd(values(problem(None)))(A)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(derivative(values(problem(diagonal)))(A), expected, rtol=1e-12)
