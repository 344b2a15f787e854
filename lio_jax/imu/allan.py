"""Allan deviation of an inertial sensor at rest, and the noise densities it shows."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

POINTS_PER_DECADE = 12
_LONGEST_SHARE = 1 / 9
"""Averaging times beyond this share of the recording rest on too few averages."""
_MODEL_ERROR = 0.05
"""Relative error of the noise model itself: keeps the many short averages from deciding alone."""
_HUBER = 2.0
_FIT_ROUNDS = 10
_CLEAR = 3.0
"""A random walk is stated where it is this many standard deviations from zero ..."""
_VISIBLE = 0.25
"""... and makes at least this share of the variance at the longest averaging time."""


@dataclass(frozen=True)
class NoiseFit:
    """The noise densities of one axis, as continuous-time densities."""

    white: float
    """Unit of the signal per sqrt(Hz): the slope -1/2 read at 1 s."""
    walk: float | None
    """Unit of the signal per s and sqrt(Hz): the slope +1/2 read at 3 s; None where it does not show."""
    flicker: float
    """Bias instability: the flat part's Allan deviation, unit of the signal."""
    quantisation: float
    """Unit of the signal times s."""

    def deviation(self, tau: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Allan deviation of the fitted noise at averaging times ``tau``, s."""
        walk = self.walk or 0.0
        return np.sqrt(
            3 * self.quantisation**2 / tau**2 + self.white**2 / tau + self.flicker**2 + walk**2 * tau / 3
        )


def averaging_factors(count: int) -> NDArray[np.int64]:
    """Return numbers of samples to average over, evenly spread in the logarithm, for ``count`` samples."""
    longest = int(count * _LONGEST_SHARE)
    if longest < 1:
        return np.zeros(0, np.int64)
    decades = np.log10(longest)
    steps = max(2, round(decades * POINTS_PER_DECADE) + 1)
    return np.unique(np.round(np.logspace(0, decades, steps)).astype(np.int64))


def allan_deviation(
    samples: NDArray[np.float64], interval: float, factors: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the overlapping Allan deviation of each column (IEEE Std 952-1997, annex C).

    Args:
        samples: (m, columns) at a steady rate.
        interval: between samples, s.
        factors: (k,) numbers of samples averaged, each at most (m - 1) / 2.

    Returns:
        (k, columns) in the unit of the samples.
    """
    # the mean is removed because a sum over an hour would cost its digits
    integral = np.zeros((len(samples) + 1, samples.shape[1]))
    np.cumsum((samples - samples.mean(axis=0)) * interval, axis=0, out=integral[1:])
    deviations = np.empty((len(factors), samples.shape[1]))
    for row, factor in enumerate(factors.tolist()):
        change = integral[2 * factor :] - 2 * integral[factor:-factor] + integral[: -2 * factor]
        deviations[row] = np.sqrt(np.mean(change**2, axis=0) / 2) / (factor * interval)
    return deviations


def fit_noise(tau: NDArray[np.float64], deviation: NDArray[np.float64], duration: float) -> NoiseFit:
    """Fit quantisation, white noise, flicker and random walk to an Allan deviation.

    The variance is their sum, so a non-negative least-squares fit of its relative error finds them all at
    once and none has to be read off a range where it may not be alone. Averaging times whose variance does
    not fit (vibration, filters) lose weight (Huber). Weights follow the number of independent averages.

    Args:
        tau: (k,) averaging times, s.
        deviation: (k,) Allan deviation.
        duration: of the recording, s.
    """
    if not deviation.any():
        return NoiseFit(white=0.0, walk=None, flicker=0.0, quantisation=0.0)
    variance = np.maximum(deviation, 1e-6 * deviation.max()) ** 2
    parts = np.stack([3 / tau**2, 1 / tau, np.ones_like(tau), tau / 3], axis=1) / variance[:, None]
    averages = np.maximum(1.5 * duration / tau - 2, 1)
    sigma = np.sqrt(2 / averages + _MODEL_ERROR**2)
    weight = 1 / sigma
    scale = np.linalg.norm(parts * weight[:, None], axis=0)
    for _ in range(_FIT_ROUNDS):
        found = nnls(parts * weight[:, None] / scale, weight)[0] / scale
        misfit = np.abs(parts @ found - 1) / sigma
        weight = np.sqrt(np.minimum(1, _HUBER / np.maximum(misfit, 1e-12))) / sigma
    quantisation, white, flicker, walk = found.tolist()
    return NoiseFit(
        white=white**0.5,
        walk=walk**0.5 if _walk_is_clear(parts, weight, found, tau) else None,
        flicker=flicker**0.5,
        quantisation=quantisation**0.5,
    )


def _walk_is_clear(
    parts: NDArray[np.float64],
    weight: NDArray[np.float64],
    found: NDArray[np.float64],
    tau: NDArray[np.float64],
) -> bool:
    present = found > 0
    if not present[3]:
        return False
    rows = parts[:, present] * weight[:, None]
    scale = np.linalg.norm(rows, axis=0)
    # neighbouring averaging times share most of their data: about one independent point per octave
    shared = POINTS_PER_DECADE * np.log10(2.0)
    covariance = np.linalg.pinv((rows / scale).T @ (rows / scale)) * shared / np.outer(scale, scale)
    clear = found[3] > _CLEAR * np.sqrt(covariance[-1, -1])
    return bool(clear and found[3] * parts[-1, 3] >= _VISIBLE)
