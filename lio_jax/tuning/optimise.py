"""Minimise a loss from its streaming gradient: Fisher scoring, bounded quasi-Newton, or stochastic steps.

The gradient holds the map fixed while the loss's value follows it, so the two differ a little; a line search
on the value may stop early where scoring, which looks for the gradient's zero, does not.
"""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lio_jax.tuning.loss import Evaluated

Vector = NDArray[np.float64]
Evaluate = Callable[[Vector], Evaluated]

_LARGEST_STEP = 1.0
"""Of a component in one scoring step: a factor e of a positive parameter."""


class Bounds(NamedTuple):
    """Box of the vector."""

    lower: Vector
    upper: Vector

    def clip(self, x: Vector) -> Vector:
        """Return the nearest vector inside."""
        return np.clip(x, self.lower, self.upper)


def scoring(evaluate: Evaluate, x: Vector, bounds: Bounds, iterations: int) -> None:
    """Newton steps with the Fisher information from the scans' scores (Berndt, Hall, Hall & Hausman 1974).

    Only for likelihoods. A damping of the information's diagonal grows when the gradient turns against the
    last step, and falls otherwise.
    """
    damping, last_step = 0.02, None
    for _ in range(iterations):
        result = evaluate(x)
        information, gradient = fisher_information(result), result.gradient * result.scans
        if last_step is not None:
            damping = np.clip(damping * (4.0 if gradient @ last_step > 0 else 0.5), 0.02, 10.0)
        damped = information + damping * np.diag(np.diag(information))
        step = -np.linalg.solve(damped, gradient)
        step *= min(1.0, _LARGEST_STEP / np.abs(step).max())
        following = bounds.clip(x + step)
        if np.abs(following - x).max() < 0.01:
            return
        x, last_step = following, following - x


def fisher_information(result: Evaluated) -> NDArray[np.float64]:
    """Return the sum of the scores' outer products, regular where a parameter has no effect."""
    information = result.scores.T @ result.scores
    return information + np.diag(np.where(np.diag(information) > 0, 1e-9 * np.diag(information), 1.0))


def lbfgsb(evaluate: Evaluate, x: Vector, bounds: Bounds, iterations: int) -> None:
    """Bounded L-BFGS (Byrd, Lu, Nocedal & Zhu 1995) by jaxopt."""
    import jax.numpy as jnp
    from jaxopt import ScipyBoundedMinimize

    def value_and_gradient(x: Vector) -> tuple[float, Vector]:
        result = evaluate(np.asarray(x, np.float64))
        return result.value, jnp.asarray(result.gradient)  # type: ignore[return-value]

    solver = ScipyBoundedMinimize(
        fun=value_and_gradient,
        value_and_grad=True,
        method="L-BFGS-B",
        jit=False,
        maxiter=iterations,
        tol=1e-6,
    )
    solver.run(jnp.asarray(x), bounds=(jnp.asarray(bounds.lower), jnp.asarray(bounds.upper)))


def adam(segments: Iterator[Evaluate], x: Vector, bounds: Bounds, iterations: int, rate: float = 0.1) -> None:
    """Stochastic steps over random segments (Kingma & Ba 2015), the rate falling to a tenth at the end."""
    mean, square = np.zeros_like(x), np.zeros_like(x)
    for iteration in range(1, iterations + 1):
        gradient = next(segments)(x).gradient
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.99 * square + 0.01 * gradient**2
        scaled = (mean / (1 - 0.9**iteration)) / (np.sqrt(square / (1 - 0.99**iteration)) + 1e-12)
        x = bounds.clip(x - rate * 0.1 ** (iteration / iterations) * scaled)
