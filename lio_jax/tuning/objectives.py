"""Objectives with and without ground truth, over any recipe's steps."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from lio_jax.core.errors import UsageError
from lio_jax.core.types import state_dtype
from lio_jax.lidar.range_scatter import range_scatter
from lio_jax.recipes.output import Evidence
from lio_jax.registration.point_evidence import PointEvidence
from lio_jax.tuning.objective import Objective, Observed, TruePose

_CAUCHY = 0.6120031809624806
"""Where 2 z^2 / (z^2 + c^2) is one on average over a normal z."""
_SHARPNESS = 1.669886
"""Curvature over variance of the scores of that density, by the logarithm of its scale."""


class MeanOverScans(eqx.Module):
    """The mean of a loss of single scans; scans that could not be matched do not count."""

    loss: Callable[[Observed, TruePose], Float[Array, ""]]
    """A pure function, or a pytree that can be called."""
    skip: int = eqx.field(static=True, default=0)
    """Scans at the start that do not count."""

    def start(self) -> Float[Array, "3"]:
        """Return sum, count and scans seen."""
        return jnp.zeros(3, state_dtype())

    def add(self, sums: Float[Array, "3"], seen: Observed, truth: TruePose) -> Float[Array, "3"]:
        """Add a scan's loss."""
        counts = ~seen.lost & (sums[2] >= self.skip)
        loss = jnp.where(counts, self.loss(seen, truth), 0.0)
        return sums + jnp.stack([loss, jnp.where(counts, 1.0, 0.0), jnp.ones_like(loss)])

    def value(self, sums: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the mean."""
        return sums[0] / jnp.maximum(sums[1], 1.0)


class MarginalLikelihood(eqx.Module):
    """The negative log marginal likelihood of a recording's measurements per scan, by a smoother.

    It asks how probable inertial samples and scan matches are whatever the states. The errors of the matches
    count as white: what the map hands on of them from scan to scan is booked on the samples.
    """

    skip: int = eqx.field(static=True, default=0)
    """Scans at the start whose measurements do not count."""

    def start(self) -> Float[Array, "3"]:
        """Return the log-likelihood of all scans, that of those skipped, and the scans seen."""
        return jnp.zeros(3, state_dtype())

    def add(self, sums: Float[Array, "3"], seen: Observed, truth: TruePose) -> Float[Array, "3"]:
        """Add a scan."""
        if seen.log_evidence is None:
            raise UsageError("the recipe has no smoother and no marginal likelihood; use lio_sam, or pose.")
        total = seen.log_evidence
        return jnp.stack([total, jnp.where(sums[2] < self.skip, total, sums[1]), sums[2] + 1])

    def value(self, sums: Float[Array, "3"]) -> Float[Array, ""]:
        """Return the mean."""
        return (sums[1] - sums[0]) / jnp.maximum(sums[2] - self.skip, 1.0)


class WeightedSum(eqx.Module):
    """A sum of objectives."""

    parts: tuple[Objective, ...]
    weights: tuple[float, ...] = eqx.field(static=True)

    def start(self) -> tuple[Any, ...]:
        """Return each part's sums."""
        return tuple(part.start() for part in self.parts)

    def add(self, sums: tuple[Any, ...], seen: Observed, truth: TruePose) -> tuple[Any, ...]:
        """Add a scan to each part."""
        return tuple(part.add(own, seen, truth) for part, own in zip(self.parts, sums, strict=True))

    def value(self, sums: tuple[Any, ...]) -> Float[Array, ""]:
        """Return the weighted sum of the parts' values."""
        values = (part.value(own) for part, own in zip(self.parts, sums, strict=True))
        total = jnp.zeros((), state_dtype())
        for weight, value in zip(self.weights, values, strict=True):
            total += weight * value
        return total


def pose_innovation(seen: Observed, truth: TruePose) -> Float[Array, ""]:
    """Return the negative log-likelihood of the scan match as one measurement of the pose.

    Innovation and covariance are those of the update (Bar-Shalom, Li & Kirubarajan, "Estimation with
    applications to tracking and navigation", 2001, section 5.4), with ``registration.information_scale`` of
    the points' information.
    """
    return -_evidence(seen).innovation.log_likelihood()


def point_innovation(seen: Observed, truth: TruePose) -> Float[Array, ""]:
    """Return the negative log-likelihood of all matched points, each as a measurement of its own.

    By Laplace's method at the solution, where the prior's share of the cost is g'Wg / 2 with the gradient g
    and the predicted pose's covariance W, so that only 6 x 6 algebra is left. The points count as
    ``registration.information_scale`` points each, because neighbours share the map's error.
    """
    evidence = _evidence(seen)
    points = _points(seen)
    information, W, g = evidence.information, evidence.pose_covariance, evidence.gradient
    scale = points.scale
    log_det = jnp.linalg.slogdet(jnp.eye(6, dtype=W.dtype) + W @ information)[1]
    return 0.5 * (scale * (points.squared_error + points.log_det) + g @ W @ g + log_det)


def range_noise(seen: Observed, truth: TruePose) -> Float[Array, ""]:
    """Return how badly ``lidar.range_sigma`` explains the scatter of neighbouring returns.

    Edges between neighbours are many and far off, so the scatter's scale is asked for by a Cauchy density
    (Huber & Ronchetti, "Robust statistics", 2009, section 5): normal noise gives it a scale of ``_CAUCHY``
    sigmas, and with ``_SHARPNESS`` its scores vary as much as it curves, as those of a likelihood do.
    """
    scan, params = seen.scan, seen.params
    if scan is None or params is None:
        raise UsageError(
            "the objective ranges wants the scan and the parameters beside what a step left to see."
        )
    scatter = range_scatter(scan, params)
    ranges = (params.lidar.range_sigma * scatter.spread) ** 2
    variance = _CAUCHY**2 * (ranges + (params.lidar.angle_sigma * scatter.slope) ** 2)
    loss = jnp.log(variance) / 2 + jnp.log1p(scatter.deviation**2 / variance)
    return _SHARPNESS * jnp.sum(jnp.where(scatter.valid, loss, 0.0))


def map_consistency(seen: Observed, truth: TruePose) -> Float[Array, ""]:
    """Return the mean squared distance of the scan from the map, m^2: blur of the map, in other words.

    It tells of what distorts scans, such as extrinsics and time offset, not of noise densities.
    """
    return seen.rmse**2


def _evidence(seen: Observed) -> Evidence:
    if seen.evidence is None:
        raise UsageError(
            "the recipe carries no innovations (neither a smoother does nor a run without inertial samples); "
            "use marginal with lio_sam, else ate, rpe or map."
        )
    return seen.evidence


def _points(seen: Observed) -> PointEvidence:
    points = _evidence(seen).points
    if points is None:
        raise UsageError("the recipe tells nothing of single points; use the objective pose.")
    return points
