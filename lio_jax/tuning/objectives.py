"""Objectives over a recording: what one is, those with and without ground truth, and their names."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.scipy.special import logsumexp
from jaxtyping import Array, Bool, Float, Int32

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.types import ImuBatch, NavState, Scan, state_dtype
from lio_jax.lidar.params import BeamParams
from lio_jax.lidar.range_scatter import range_scatter
from lio_jax.recipes.params import RecipeParams as Params
from lio_jax.recipes.recipe import Evidence
from lio_jax.recipes.transforms import RecipeLike
from lio_jax.registration.point_evidence import PointEvidence
from lio_jax.tuning.objective_names import EXAMPLE, LISTED, SHORT


class TruePose(eqx.Module):
    """Where the vehicle was at a scan's end."""

    T_world_imu: jaxlie.SE3
    known: Bool[Array, ""]
    """False where there is no truth."""


class Observed(eqx.Module):
    """One scan, the parameters, and what its step leaves to see."""

    nav: NavState
    """At the scan's end."""
    rmse: Float[Array, ""]
    """Robustly weighted root mean square distance of the scan to the map, m."""
    blur: Float[Array, ""]
    """Mean squared distance of the scan from the map, robust, as a share of the squared ranges."""
    status: Int32[Array, ""]
    """Status code of the solve, see :mod:`lio_jax.core.types`."""
    lost: Bool[Array, ""]
    covariance: Float[Array, "24 24"] | None
    """Covariance of the navigation state's error; None from recipes without one."""
    evidence: Evidence | None
    """How well the scan was foretold; None from recipes that carry no covariance."""
    log_evidence: Float[Array, ""] | None
    """Log-likelihood of all measurements so far; None from recipes without a smoother."""
    scan: Scan | None = None
    """As it was fed to the step."""
    params: Params | None = None
    """The step's."""

    @staticmethod
    def of(state: Any, output: Any) -> "Observed":
        """Return what a recipe's step leaves to see."""
        result = output.registration
        return Observed(
            nav=state.nav,
            rmse=result.rmse,
            blur=result.blur,
            status=result.status,
            lost=output.lost,
            covariance=output.covariance,
            evidence=output.evidence,
            log_evidence=output.log_evidence,
        )

    def with_scan(self, scan: Scan, params: Params) -> "Observed":
        """Return the same with what went into the step.

        Not by :meth:`of`: a program that hands its arguments through has them copied.
        """
        return replace(self, scan=scan, params=params)


@dataclass(frozen=True)
class Observing:
    """A recipe whose output is what an objective sees: nothing else is computed or differentiated."""

    recipe: RecipeLike

    def init(self, params: Params, imu: ImuBatch | None = None) -> Any:
        """Return the state before the first scan."""
        return self.recipe.init(params, imu)

    def step(
        self, params: Params, state: Any, scan: Scan, imu: ImuBatch | None = None
    ) -> tuple[Any, Observed]:
        """Return the state after a scan and what the step leaves to see."""
        state, output = self.recipe.step(params, state, scan, imu)
        return state, Observed.of(state, output)


class Objective(Protocol):
    """A loss over a recording: lower is better. Its sums are a pytree of floating-point arrays.

    Compiled programs are kept by what it is, so it must not change after its first use: let it be an
    ``equinox.Module``, or a frozen dataclass.
    """

    def start(self) -> Any:
        """Return the sums before the first scan."""
        ...

    def add(self, sums: Any, seen: Observed, truth: TruePose) -> Any:
        """Return the sums with one more scan."""
        ...

    def value(self, sums: Any) -> Float[Array, ""]:
        """Return the loss."""
        ...


_SHARPNESS = math.sqrt(3.0)
"""Curvature over variance of the scores of :func:`range_noise`, by the logarithm of the noise, for n = 1."""


class MeanOverScans(eqx.Module):
    """The mean of a loss of single scans. A scan that could not be matched has the loss of the worst one that
    was: without it, parameters that lose the hardest scans would have the lowest mean.

    The loss of a lost scan is a constant of the derivative. If no scan was matched, the mean is infinite.
    """

    loss: Callable[[Observed, TruePose], Float[Array, ""]]
    """A pure function, or a pytree that can be called."""
    skip: int = eqx.field(static=True, default=0)
    """Scans at the start that do not count."""

    def start(self) -> Float[Array, "5"]:
        """Return the sum over matched scans, their number, the scans seen, those lost, and the worst loss."""
        return jnp.zeros(5, state_dtype()).at[4].set(-jnp.inf)

    def add(self, sums: Float[Array, "5"], seen: Observed, truth: TruePose) -> Float[Array, "5"]:
        """Add a scan's loss."""
        begun = sums[2] >= self.skip
        counts = begun & ~seen.lost
        loss = jnp.where(counts, self.loss(seen, truth), 0.0)
        worst = jnp.maximum(sums[4], jnp.where(counts, loss, -jnp.inf))
        one = jnp.ones_like(loss)
        numbers = [jnp.where(counts, one, 0.0), one, jnp.where(begun & seen.lost, one, 0.0)]
        return jnp.concatenate([sums[:4] + jnp.stack([loss, *numbers]), jax.lax.stop_gradient(worst)[None]])

    def value(self, sums: Float[Array, "5"]) -> Float[Array, ""]:
        """Return the mean; 0 where no scan counts."""
        total, matched, _, lost, worst = sums
        charged = jnp.where(lost > 0, lost * jax.lax.stop_gradient(worst), 0.0)
        mean = (total + jnp.where(matched > 0, charged, 0.0)) / jnp.maximum(matched + lost, 1.0)
        return jnp.where((matched > 0) | (lost == 0), mean, jnp.inf)


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

    The gamma divergence of a normal density from the returns, with gamma 1 (Fujisawa & Eguchi, "Robust
    parameter estimation with a small bias against heavy contamination", 2008): ``-n log mean(f / |f|)`` with
    the density ``f`` and its norm ``|f| = sqrt(int f^2)``. Edges between neighbours are many and far off.
    There f vanishes, so they do not move the lowest value. With ``_SHARPNESS`` the scores vary as much as the
    loss curves, as those of a likelihood do.
    """
    scan, params = seen.scan, seen.params
    if scan is None or params is None:
        raise UsageError(
            "the objective ranges needs the scan and the parameters: call Observed.with_scan first."
        )
    scatter = range_scatter(scan, params.lidar)
    variance = jnp.square(params.lidar.range_sigma) * jnp.ones_like(scatter.spread)
    if isinstance(params.lidar, BeamParams):
        variance = variance + (params.lidar.angle_sigma * scatter.slope / scatter.spread) ** 2
    squared = (scatter.deviation / scatter.spread) ** 2 / variance
    density = -squared / 2 - jnp.log(variance) / 4
    number = jnp.sum(scatter.valid)
    counted = jnp.where(scatter.valid, density, -jnp.inf)
    # without any return the sum has no logarithm
    mean = logsumexp(jnp.where(number > 0, counted, 0.0)) - jnp.log(jnp.maximum(number, 1))
    return -_SHARPNESS * number * mean


def map_consistency(seen: Observed, truth: TruePose) -> Float[Array, ""]:
    """Return the blur of the map: the mean squared distance of the scan from it, relative to ranges, mrad^2.

    It tells of what distorts scans, such as extrinsics and time offset, not of noise densities. Relative to
    ranges, because a smaller world has smaller distances.
    """
    return 1e6 * seen.blur


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


class AbsoluteError(eqx.Module):
    """Root mean square position error after the best rigid alignment, m.

    Horn, "Closed-form solution of absolute orientation using unit quaternions", 1987; Umeyama 1991, from the
    moments of the two point sets alone. At the best rotation the error's derivative by the rotation vanishes,
    so the alignment is differentiable without differentiating the decomposition.
    """

    def start(self) -> Float[Array, "18"]:
        """Return count, sums, products and squares."""
        return jnp.zeros(18, state_dtype())

    def add(self, sums: Float[Array, "18"], seen: Observed, truth: TruePose) -> Float[Array, "18"]:
        """Add a pair of positions, where the truth is known."""
        p, q = seen.nav.T_world_imu.translation(), truth.T_world_imu.translation()
        products = (q[:, None] * p).ravel()
        moments = jnp.concatenate([jnp.ones(1), p, q, products, (p @ p)[None], (q @ q)[None]])
        return sums + jnp.where(truth.known, moments, 0.0)

    def value(self, sums: Float[Array, "18"]) -> Float[Array, ""]:
        """Return the error; 0 for fewer than two poses."""
        count = jnp.maximum(sums[0], 1.0)
        p, q = sums[1:4] / count, sums[4:7] / count
        covariance = sums[7:16].reshape(3, 3) / count - q[:, None] * p
        left, _, right = jnp.linalg.svd(jax.lax.stop_gradient(covariance))
        flip = jnp.diag(jnp.ones(3).at[2].set(jnp.sign(jnp.linalg.det(left @ right))))
        aligned = jnp.sum((left @ flip @ right) * covariance)
        mean_square = sums[16] / count - p @ p + sums[17] / count - q @ q - 2 * aligned
        return _root(mean_square)


class RelativeError(eqx.Module):
    """Root mean square error of the motion over a number of scans: m, or rad for the rotation."""

    scans: int = eqx.field(static=True, default=10)
    rotation: bool = eqx.field(static=True, default=False)

    def start(self) -> tuple[Any, ...]:
        """Return the last poses of both and whether they are known, the sum of squares and the count."""
        poses = jnp.zeros((2, self.scans, 7), state_dtype()).at[:, :, 0].set(1.0)
        return poses, jnp.zeros(self.scans, state_dtype()), jnp.zeros(2, state_dtype())

    def add(self, sums: tuple[Any, ...], seen: Observed, truth: TruePose) -> tuple[Any, ...]:
        """Compare the motion since ``scans`` scans ago with the true one."""
        poses, known, total = sums
        new = jnp.stack([seen.nav.T_world_imu.wxyz_xyz, truth.T_world_imu.wxyz_xyz])
        moved, truly = (
            jaxlie.SE3(old[0]).inverse() @ jaxlie.SE3(pose) for old, pose in zip(poses, new, strict=True)
        )
        error = truly.inverse() @ moved
        off = error.rotation().log() if self.rotation else error.translation()
        both = jnp.where(truth.known, known[0], 0.0)
        total += jnp.stack([jnp.where(both > 0, off @ off, 0.0), both])
        poses = jnp.concatenate([poses[:, 1:], new[:, None]], 1)
        return poses, jnp.append(known[1:], jnp.where(truth.known, 1.0, 0.0)), total

    def value(self, sums: tuple[Any, ...]) -> Float[Array, ""]:
        """Return the error; 0 where no motion could be compared."""
        total = sums[2]
        return _root(total[0] / jnp.maximum(total[1], 1.0))


def _root(square: Float[Array, ""]) -> Float[Array, ""]:
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


@dataclass(frozen=True)
class Named:
    """An objective and what has to be known about it."""

    objective: Objective
    needs_truth: bool
    likelihood: bool
    """A mean negative log-likelihood per scan: its scores give the parameters' uncertainty."""
    name: str = ""
    """Words that tell it from other objectives, the same in every process."""


OPENING = 10
"""Scans at a recording's start that tell of the first state's sigmas, not of the noise."""


def nothing_counts(scans: int) -> LioJaxError:
    """Return the error of a recording of so many scans in which no scan depends on the parameters."""
    return LioJaxError(
        f"none of the {scans} scans tells of the parameters. A likelihood leaves out the scans that could "
        f"not be matched, and all but ranges leave out the first {OPENING}: use a longer recording, or "
        "parameters on which the objective depends."
    )


def nothing_depends(names: Sequence[str]) -> LioJaxError:
    """Return the error of an objective that does not depend on any of the named parameters."""
    return LioJaxError(
        f"the objective does not depend on {', '.join(names)} at these values; name parameters of what the "
        "recording has, or start from other values."
    )


_SINGLE = {
    "pose": Named(MeanOverScans(pose_innovation, OPENING), False, True),
    "point": Named(MeanOverScans(point_innovation, OPENING), False, True),
    "marginal": Named(MarginalLikelihood(OPENING), False, True),
    "ranges": Named(MeanOverScans(range_noise), False, True),
    "map": Named(MeanOverScans(map_consistency), False, False),
    "ate": Named(AbsoluteError(), True, False),
    "rpe": Named(RelativeError(), True, False),
    "rpe-rotation": Named(RelativeError(rotation=True), True, False),
}


def objective_named(text: str) -> Named:
    """Return an objective by name, or a sum such as ``ate+0.01*pose``.

    Raises:
        UsageError: a name is not known (lists those there are), or a weight is no number.
    """
    written = SHORT.get(text, text).replace(" ", "")
    terms = written.split("+")
    parts, weights = [], []
    for term in terms:
        weight, star, name = term.rpartition("*")
        if name.strip() not in _SINGLE:
            raise UsageError(
                f"objective '{name.strip()}' is not known; there are: {LISTED}, and sums such as {EXAMPLE}."
            )
        try:
            weights.append(float(weight) if star else 1.0)
        except ValueError:
            raise UsageError(f"objective '{term}': '{weight}' is no number to weigh {name} with.") from None
        parts.append(_SINGLE[name.strip()])
    if len(parts) == 1 and weights == [1.0]:
        return replace(parts[0], name=written)
    return Named(
        WeightedSum(tuple(part.objective for part in parts), tuple(weights)),
        any(part.needs_truth for part in parts),
        all(part.likelihood for part in parts) and set(weights) == {1.0},
        written,
    )


def as_named(objective: str | Objective) -> Named:
    """Return an objective that is given by name or is one's own, which needs no truth and has no scores.

    Raises:
        UsageError: see :func:`objective_named`.
    """
    if isinstance(objective, str):
        return objective_named(objective)
    return Named(objective, False, False, _in_words(objective))


def _in_words(part: Any) -> str:
    """Return the classes, functions and numbers of which an objective consists, without addresses."""
    if isinstance(part, tuple | list):
        return f"({', '.join(map(_in_words, part))})"
    if is_dataclass(part) and not isinstance(part, type):
        inside = ", ".join(_in_words(getattr(part, field.name)) for field in fields(part))
        return f"{type(part).__qualname__}({inside})"
    if isinstance(part, bool | int | float | str) or part is None:
        return repr(part)
    if isinstance(part, jax.Array | np.ndarray):
        return str(np.asarray(part).tolist())
    return str(getattr(part, "__qualname__", type(part).__qualname__))
