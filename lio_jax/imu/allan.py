"""Noise densities of an inertial sensor: by its Allan deviation at rest, or by its differences in motion."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

POINTS_PER_DECADE = 12
"""Number of averaging times per factor of ten."""
_LONGEST_SHARE = 1 / 9
"""Longest averaging time as a share of the recording: longer ones have too few averages."""
_MODEL_ERROR = 0.05
"""Relative error of the noise model: without it the many short averages would determine the fit alone."""
_HUBER = 2.0
_FIT_ROUNDS = 10
_CLEAR = 3.0
"""Least distance from zero of a random walk that is reported, in standard deviations."""
_VISIBLE = 0.25
"""Least share of a random walk that is reported in the variance at the longest averaging time."""


@dataclass(frozen=True)
class NoiseFit:
    """The continuous-time noise densities of one axis."""

    white: float
    """Density of the white noise, unit of the signal per sqrt(Hz): the line of slope -1/2 at 1 s."""
    walk: float | None
    """Density of the random walk, unit of the signal per s and sqrt(Hz): the line of slope +1/2 at 3 s. None
    where it is not significant."""
    flicker: float
    """Bias instability, unit of the signal: the Allan deviation of the flat part."""
    quantisation: float
    """Quantisation noise, unit of the signal times s."""

    def deviation(self, tau: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the Allan deviation of the fitted noise at averaging times ``tau``, s."""
        walk = self.walk or 0.0
        return np.sqrt(
            3 * self.quantisation**2 / tau**2 + self.white**2 / tau + self.flicker**2 + walk**2 * tau / 3
        )


_DIFFERENCED_HZ = 50.0
"""Rate of the averages whose differences show the noise, Hz: higher rates may be filtered in the sensor."""
_SLOWEST_HZ = 80.0
"""Least rate of samples whose differences show noise rather than motion, Hz."""
_WINDOW_S = 1.0
_FEWEST_WINDOWS = 3
_GAP_FACTOR = 1.5
_DIFFERENCED = 20.0
"""Variance of the third difference of white noise of variance 1."""


def noise_in_motion(seconds: NDArray[np.float64], samples: NDArray[np.float64]) -> float | None:
    """Return the density of the white noise of a sensor in motion, mean of its axes.

    Third differences of averages over 0.02 s contain little of a vehicle's motion. Their mean square over
    windows of a second is that of the noise, and of vibration; the median window counts.

    Args:
        seconds: (m,) ascending, s.
        samples: (m, axes).

    Returns:
        Unit of the samples per sqrt(Hz); None where the rate is below 80 Hz, or where less than three
        seconds are without a gap.
    """
    steps = np.diff(seconds)
    interval = float(np.median(steps)) if len(steps) else np.inf
    if not 0 < interval < 1 / _SLOWEST_HZ:
        return None
    averaged = max(1, round(1 / (interval * _DIFFERENCED_HZ)))
    rate = 1 / (interval * averaged)
    window = averaged * round(_WINDOW_S * rate)
    squares = []
    for first in range(0, len(samples) - window + 1, window):
        if np.all(steps[first : first + window - 1] < _GAP_FACTOR * interval):
            part = samples[first : first + window].reshape(-1, averaged, samples.shape[1]).mean(1)
            squares.append(np.mean(np.diff(part, 3, axis=0) ** 2))
    if len(squares) < _FEWEST_WINDOWS:
        return None
    return float(np.sqrt(np.median(squares) / _DIFFERENCED / rate))


def averaging_factors(count: int) -> NDArray[np.int64]:
    """Return the numbers of samples to average over, evenly spaced in the logarithm.

    Args:
        count: number of samples in the recording.

    Returns:
        (k,) distinct numbers, ascending; none for fewer than nine samples.
    """
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
        samples: (m, columns) at a constant rate.
        interval: time between two samples, s.
        factors: (k,) numbers of samples averaged, each at most (m - 1) / 2.

    Returns:
        (k, columns) in the unit of the samples.
    """
    # the mean is removed, because a sum over an hour would lose digits
    integral = np.zeros((len(samples) + 1, samples.shape[1]))
    np.cumsum((samples - samples.mean(axis=0)) * interval, axis=0, out=integral[1:])
    deviations = np.empty((len(factors), samples.shape[1]))
    for row, factor in enumerate(factors.tolist()):
        change = integral[2 * factor :] - 2 * integral[factor:-factor] + integral[: -2 * factor]
        deviations[row] = np.sqrt(np.mean(change**2, axis=0) / 2) / (factor * interval)
    return deviations


def fit_noise(tau: NDArray[np.float64], deviation: NDArray[np.float64], duration: float) -> NoiseFit:
    """Fit quantisation, white noise, flicker and random walk to an Allan deviation.

    The Allan variance is the sum of the four parts. One non-negative least-squares fit of its relative error
    finds all of them, so no part has to be read from a range of averaging times that another part may
    disturb. The weights follow from the number of independent averages. Averaging times whose variance does
    not fit, because of vibration or filters, lose weight (Huber).

    Args:
        tau: (k,) averaging times, s.
        deviation: (k,) Allan deviations, unit of the signal.
        duration: length of the recording, s.
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
