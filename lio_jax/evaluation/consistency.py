"""Consistency of a filter: normalised squared errors and their chi-square bands."""

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from lio_jax.core.errors import UsageError


def nees(error: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the normalised estimation error squared, error' covariance^-1 error.

    For a consistent filter it has a chi-square distribution with d degrees of freedom. For the normalised
    innovation squared, pass innovations and their covariances (Bar-Shalom, Li & Kirubarajan, "Estimation with
    applications to tracking and navigation", 2001, section 5.4).

    Args:
        error: (..., d) truth minus estimate, in the tangent space at the estimate.
        covariance: (..., d, d) covariance that the filter states.

    Raises:
        UsageError: a covariance is not positive definite: leave frozen parts of the state out.
    """
    try:
        factor = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError as exc:
        raise UsageError(
            "a covariance is not positive definite: leave frozen parts of the state out"
        ) from exc
    return np.sum(np.linalg.solve(factor, error[..., None]) ** 2, (-2, -1))


def average_band(dof: int, runs: int, probability: float = 0.95) -> tuple[float, float]:
    """Return the two-sided band that contains the average over independent runs with a given probability.

    Args:
        dof: number of degrees of freedom of each value.
        runs: number of independent values in the average.
        probability: probability of the band, between 0 and 1.
    """
    if dof < 1 or runs < 1 or not 0 < probability < 1:
        raise UsageError(
            f"a chi-square band needs dof >= 1, runs >= 1 and 0 < probability < 1, "
            f"not {dof}, {runs} and {probability}"
        )
    outside = (1 - probability) / 2
    low, high = (float(chi2.ppf(share, dof * runs)) / runs for share in (outside, 1 - outside))
    return low, high
