"""Minimise a loss from its gradient: Fisher scoring, bounded quasi-Newton, zero of the gradient, stochastic.

The gradient holds choices fixed, such as which points enter the map (and the whole map for likelihoods by
noise densities), while the loss jumps with them. A line search on the value may stop early where scoring and
:func:`stationary`, which look for the gradient's zero, do not.
"""

import math
from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lio_jax.tuning.evaluated import Evaluated

Vector = NDArray[np.float64]
Evaluate = Callable[[Vector], Evaluated]

_LARGEST_STEP = 1.0
"""Largest change of a component in one scoring step: a factor e of a positive parameter."""
_SMALLEST_SCALE, _LARGEST_SCALE = 0.1, 300.0
_DAMPING = 0.02
"""Share of the information's diagonal that is added to it."""
_LEAST_CURVATURE = 1.0
"""Smallest curvature of a component: one that is not observable keeps its value."""
_START_PRECISION = 1 / 9
"""Precision of the prior at a component's start: its sigma is a factor of 20. While other parameters are far
off, gradients can make a noise so small that it is no longer observable; the prior then brings it back."""


class Bounds(NamedTuple):
    """Box of the vector."""

    lower: Vector
    upper: Vector

    def unit(self) -> Vector:
        """Return what counts as one unit of each component: a factor e of a bound that is a factor 1000."""
        return np.asarray((self.upper - self.lower) / 2 / math.log(1000.0), np.float64)

    def clip(self, x: Vector) -> Vector:
        """Return the nearest vector inside."""
        return np.asarray(np.clip(x, self.lower, self.upper), np.float64)


def fisher_scoring(evaluate: Evaluate, x: Vector, bounds: Bounds, iterations: int) -> None:
    """Newton steps with the Fisher information from the scans' scores (Berndt, Hall, Hall & Hausman 1974).

    Only for likelihoods. Far from the solution the scores' spread overstates the curvature by orders of
    magnitude; the last two gradients tell by how much (Barzilai & Borwein 1988). Ends where the gradient is
    within a tenth of its own standard deviation, or of one nat.
    """
    scale, last, start = 1.0, None, x
    for _ in range(iterations):
        result = evaluate(x)
        information = fisher_information(result)
        gradient = result.gradient * result.scans + _START_PRECISION * (x - start)
        if last is not None:
            stride, before = last
            curvature = stride @ (gradient - before)
            measured = stride @ information @ stride / curvature if curvature > 0 else 2 * scale
            scale = float(np.clip(measured, _SMALLEST_SCALE, _LARGEST_SCALE))
        curvature = information / scale
        damped = curvature + np.diag(_DAMPING * np.diag(curvature) + _LEAST_CURVATURE)
        step = np.clip(-np.linalg.solve(damped, gradient), -_LARGEST_STEP, _LARGEST_STEP)
        step = np.asarray(bounds.clip(x + step) - x, np.float64)
        free = np.abs(step) > 0
        shift = gradient[free]
        spread = (information + _LEAST_CURVATURE * np.eye(len(x)))[np.ix_(free, free)]
        if not free.any() or shift @ np.linalg.solve(spread, shift) < 0.01:
            return
        x, last = x + step, (step, gradient)


def fisher_information(result: Evaluated) -> NDArray[np.float64]:
    """Return the scores' spread about their mean, regular where a parameter has no effect.

    About their mean: what all scans ask for alike, the gradient, tells nothing of the curvature.
    """
    return _spread(_about_their_mean(result))


def parameter_covariance(result: Evaluated) -> NDArray[np.float64]:
    """Return the covariance of a likelihood's maximum, for scores that are correlated from scan to scan.

    Successive scans meet the same surfaces and share the map's errors, so a hundred scans tell less than a
    hundred independent ones. The inverse information stands on both sides of the scores' long-run spread
    (White, "Maximum likelihood estimation of misspecified models", 1982), which has Bartlett's weights over
    the lags (Newey & West 1987) up to the lag that suits the correlation of neighbours (Andrews 1991,
    equations 5.3 and 6.4). A lag over the end of a recording counts like any other.

    Args:
        result: the likelihood at its maximum, with the scores of all scans in their order.

    Returns:
        (p, p) covariance of the vector of parameters.
    """
    scores = _about_their_mean(result)
    information = _spread(scores)
    long_run = information.copy()
    lags = _lags(scores)
    for lag in range(1, lags + 1):
        product = scores[lag:].T @ scores[:-lag]
        long_run += (1 - lag / (lags + 1)) * (product + product.T)
    inverse = np.linalg.inv(information)
    return np.asarray(inverse @ long_run @ inverse, np.float64)


_CURVATURE_STEP = 1e-3
"""Half the distance over which the change of a gradient is taken, in units of the vector."""
_FLAT = 1e-6
"""Curvature of a direction along which a likelihood does not fall: its sigma is 1,000 units."""


def covariance_by_curvature(gradient: Callable[[Vector], Vector], x: Vector) -> NDArray[np.float64]:
    """Return the covariance of a likelihood's maximum as the inverse of the curvature (observed information).

    Args:
        gradient: of minus the logarithm of the likelihood of all measurements, (p,) -> (p,). It is smooth.
        x: (p,) the maximum.

    Returns:
        (p, p) covariance of the vector of parameters.
    """
    steps = _CURVATURE_STEP * np.eye(len(x))
    rows = np.array([(gradient(x + step) - gradient(x - step)) / (2 * _CURVATURE_STEP) for step in steps])
    values, vectors = np.linalg.eigh((rows + rows.T) / 2)
    return np.asarray((vectors / np.maximum(values, _FLAT)) @ vectors.T, np.float64)


_STRONGEST_CORRELATION = 0.97
"""Largest correlation of neighbouring scores from which the number of lags is found."""
_MOST_LAGS = 1 / 4
"""Largest number of lags, relative to the number of scans."""


def _lags(scores: NDArray[np.float64]) -> int:
    """Return the number of lags by Andrews' rule for Bartlett's weights, each parameter's scores an AR(1)."""
    power = np.sum(scores**2, axis=0)
    neighbours = np.sum(scores[1:] * scores[:-1], axis=0)[power > 0] / power[power > 0]
    if not len(neighbours):
        return 0
    r = np.clip(neighbours, -_STRONGEST_CORRELATION, _STRONGEST_CORRELATION)
    alpha = np.sum(4 * r**2 / ((1 - r) ** 6 * (1 + r) ** 2)) / np.sum((1 - r) ** -4)
    return int(min(math.ceil(1.1447 * (alpha * len(scores)) ** (1 / 3)), _MOST_LAGS * len(scores)))


def _spread(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum of the scores' products, regular where a parameter has no effect."""
    spread = scores.T @ scores
    return np.asarray(spread + np.diag(np.where(np.diag(spread) > 0, 1e-9 * np.diag(spread), 1.0)))


def _about_their_mean(result: Evaluated) -> NDArray[np.float64]:
    """Return the scores of the scans that count, less their mean; a scan that does not count has zeros."""
    assert result.scores is not None, "scoring needs the scans' scores"
    scores = result.scores[np.any(result.scores != 0, axis=1)]
    return np.asarray(scores - np.sum(scores, axis=0) / max(len(scores), 1), np.float64)


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


_FIRST_STEP, _LONGEST_STEP, _SHORTEST_STEP = 0.25, 1.0, 0.01
"""Lengths of steps of :func:`stationary` in units of :meth:`Bounds.unit`."""


def stationary(evaluate: Evaluate, x: Vector, bounds: Bounds, iterations: int) -> None:
    """Go to where the gradient vanishes, by quasi-Newton steps that never look at the value.

    For losses that jump with choices which the gradient holds, so that their values have many small minima
    and their gradients point the right way (Wilke, Kok, Snyman & Groenwold, "Gradient-only approaches to
    avoid spurious local minima in unconstrained optimization", 2013). A step is taken unless the slope along
    it comes out larger than before with the other sign. Ends where two steps in a row are short: the first
    one may have been short because the curvature was that of a place far away.
    """
    unit, identity = bounds.unit(), np.eye(len(x))
    gradient = evaluate(x).gradient * unit
    inverse: Vector | None = None
    short = False
    for _ in range(iterations - 1):
        norm = float(np.linalg.norm(gradient))
        if inverse is None:
            step = -gradient * (_FIRST_STEP / max(norm, np.finfo(float).tiny))
        else:
            step = -inverse @ gradient
        step *= min(1.0, _LONGEST_STEP / max(float(np.linalg.norm(step)), np.finfo(float).tiny))
        step = (bounds.clip(x + unit * step) - x) / unit
        was_short, short = short, bool(np.linalg.norm(step) < _SHORTEST_STEP)
        if (short and was_short) or not step.any():
            return
        there = evaluate(x + unit * step).gradient * unit
        change = there - gradient
        curvature = float(step @ change)
        if curvature > 0:
            if inverse is None:
                inverse = identity * curvature / float(change @ change)
            left = identity - np.outer(step, change) / curvature
            inverse = left @ inverse @ left.T + np.outer(step, step) / curvature
        elif inverse is not None:
            inverse = 2 * inverse
        if step @ there <= abs(step @ gradient):
            x, gradient = x + unit * step, there


class Moments(NamedTuple):
    """What Adam remembers of the gradients (Kingma & Ba 2015, algorithm 1)."""

    mean: Vector
    square: Vector
    steps: int

    @staticmethod
    def none(size: int) -> "Moments":
        """Return the moments before the first gradient."""
        return Moments(np.zeros(size), np.zeros(size), 0)

    def with_gradient(self, gradient: Vector) -> "Moments":
        """Return the moments after one more gradient."""
        mean = 0.9 * self.mean + 0.1 * gradient
        return Moments(mean, 0.99 * self.square + 0.01 * gradient**2, self.steps + 1)

    def step(self, x: Vector, gradient: Vector, rate: float, bounds: "Bounds") -> tuple["Moments", Vector]:
        """Return the moments after one more gradient, and where the step of length ``rate`` leads."""
        moments = self.with_gradient(gradient)
        return moments, bounds.clip(x - rate * moments.direction())

    def direction(self) -> Vector:
        """Return the direction to descend against: a component is near 1 where its gradients agree."""
        mean = self.mean / (1 - 0.9**self.steps)
        square = self.square / (1 - 0.99**self.steps)
        return np.asarray(mean / (np.sqrt(square) + 1e-12), np.float64)


def adam(segments: Iterator[Evaluate], x: Vector, bounds: Bounds, iterations: int, rate: float = 0.1) -> None:
    """Stochastic steps over random segments (Kingma & Ba 2015), the rate falling to a tenth at the end.

    It serves a tuning, which judges and writes down every evaluation. A training takes the same steps over
    batches and epochs (:mod:`lio_jax.tuning.train`).
    """
    moments = Moments.none(len(x))
    for iteration in range(1, iterations + 1):
        gradient = next(segments)(x).gradient
        moments, x = moments.step(x, gradient, rate * 0.1 ** (iteration / iterations), bounds)
