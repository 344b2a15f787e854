"""Many runs with known noise: the filter's errors are as large as it says, and so are its innovations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lio_jax.core.error_state import (
    ACCEL_BIAS,
    DOF,
    EXTRINSIC_ROTATION,
    EXTRINSIC_TRANSLATION,
    GRAVITY,
    GYRO_BIAS,
    POSITION,
    ROTATION,
    TIME_OFFSET,
    VELOCITY,
)
from lio_jax.core.types import CONVERGED
from lio_jax.evaluation.trajectory_error import average_band, nees
from tests.estimation import wave

pytestmark = pytest.mark.long

RUNS, SCANS = 64, 100
PARTS = {
    "rotation": (ROTATION, 0.02),
    "position": (POSITION, 0.05),
    "velocity": (VELOCITY, 0.1),
    "gyro_bias": (GYRO_BIAS, 0.01),
    "accel_bias": (ACCEL_BIAS, 0.1),
    "gravity": (GRAVITY, 0.02),
    "extrinsic_rotation": (EXTRINSIC_ROTATION, 0.03),
    "extrinsic_translation": (EXTRINSIC_TRANSLATION, 0.05),
    "time_offset": (TIME_OFFSET, 0.01),
}
FROZEN = tuple(PARTS)[5:]


@pytest.fixture(scope="module")
def outcomes() -> dict[str, tuple]:
    """Return errors, covariances and updates of all runs, with calibration and gravity frozen and free."""
    simulate = jax.jit(jax.vmap(wave.run, (0, None, None)))
    true = wave.truth(SCANS)
    found = {}
    for name, frozen in {"frozen": FROZEN, "free": ()}.items():
        sigma = np.zeros(DOF)
        for part, (where, value) in PARTS.items():
            sigma[where] = 0.0 if part in frozen else value
        errors, updates = simulate(jax.random.split(jax.random.key(2), RUNS), jnp.asarray(sigma), true)
        found[name] = np.asarray(errors), np.asarray(updates.covariance), updates
    return found


CASES = [
    (case, part) for case in ("frozen", "free") for part in PARTS if case == "free" or part not in FROZEN
]


@pytest.mark.parametrize(("case", "part"), CASES)
def test_errors_are_as_large_as_the_filter_says(outcomes, case, part) -> None:
    errors, covariances, _ = outcomes[case]
    where, _ = PARTS[part]
    values = nees(errors[:, :, where], covariances[:, :, where, where]).mean(0)
    low, high = average_band(where.stop - where.start, RUNS, 0.95)
    assert low < values[-1] < high
    # over the whole run: neighbouring scans are correlated, so this is no sharper but looks everywhere
    assert np.mean((low < values) & (values < high)) > 0.6


def test_the_whole_error_is_as_large_as_the_filter_says(outcomes) -> None:
    errors, covariances, _ = outcomes["free"]
    values = nees(errors[:, -1], covariances[:, -1])
    low, high = average_band(DOF, RUNS, 0.95)
    assert low < values.mean() < high


@pytest.mark.parametrize("case", ["frozen", "free"])
def test_innovations_are_as_large_as_the_filter_says(outcomes, case) -> None:
    innovation = outcomes[case][2].innovation
    assert np.all(np.asarray(innovation.dof) == 6)
    low, high = average_band(6, innovation.nis.size, 0.95)
    assert low < np.mean(innovation.nis) < high


def test_every_update_converges(outcomes) -> None:
    for _, _, updates in outcomes.values():
        assert np.all(np.asarray(updates.status) == CONVERGED)


def test_what_is_frozen_has_no_error_and_no_variance(outcomes) -> None:
    errors, covariances, _ = outcomes["frozen"]
    for part in FROZEN:
        where, _ = PARTS[part]
        assert not np.any(covariances[:, :, where])
        # the rotation's logarithm of a product with its own inverse
        assert np.abs(errors[:, :, where]).max() < 1e-15


def test_the_calibration_is_found_when_the_motion_excites_it(outcomes) -> None:
    """The time offset among it: its sign is that of the propagation, and it is counted once."""
    errors = outcomes["free"][0]
    for part, limit in {"extrinsic_rotation": 0.1, "extrinsic_translation": 0.3, "time_offset": 0.1}.items():
        where, start = PARTS[part]
        assert np.sqrt(np.mean(errors[:, -1, where] ** 2)) < limit * start
