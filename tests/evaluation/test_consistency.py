"""Normalised squared errors against their definition and scipy's distribution."""

import numpy as np
import pytest
from scipy.stats import chi2

from lio_jax.core.errors import UsageError
from lio_jax.evaluation.trajectory_error import average_band, nees


def test_nees_is_the_squared_mahalanobis_distance() -> None:
    rng = np.random.default_rng(0)
    error, root = rng.normal(size=(4, 5, 3)), rng.normal(size=(4, 5, 3, 3))
    covariance = root @ root.swapaxes(-1, -2)
    got = nees(error, covariance)
    assert got.shape == (4, 5)
    expected = error[2, 3] @ np.linalg.inv(covariance[2, 3]) @ error[2, 3]
    np.testing.assert_allclose(got[2, 3], expected, rtol=1e-9)


def test_a_frozen_part_is_refused() -> None:
    with pytest.raises(UsageError, match="frozen"):
        nees(np.zeros(2), np.diag([1.0, 0.0]))


def test_the_band_holds_the_average_as_often_as_it_says() -> None:
    low, high = average_band(3, 50, 0.9)
    averages = np.random.default_rng(1).chisquare(3, (20000, 50)).mean(1)
    assert abs(np.mean((averages > low) & (averages < high)) - 0.9) < 0.01
    # both tails alike
    assert abs(np.mean(averages < low) - 0.05) < 0.01


def test_one_run_has_the_distribution_s_own_band() -> None:
    np.testing.assert_allclose(average_band(6, 1), chi2(6).interval(0.95))


@pytest.mark.parametrize(("dof", "runs", "probability"), [(0, 5, 0.9), (3, 0, 0.9), (3, 5, 1.0), (3, 5, 0.0)])
def test_impossible_bands_are_refused(dof, runs, probability) -> None:
    with pytest.raises(UsageError, match="chi-square band"):
        average_band(dof, runs, probability)
