"""Programs and recordings that several tests of the smoother share."""

import jax.numpy as jnp

from lio_jax.estimation.chain import Chain
from lio_jax.estimation.motion_state import MotionState
from lio_jax.estimation.sliding_window import log_evidence
from lio_jax.estimation.smoother import Smoothed, smooth
from tests.experiments import bench_path  # noqa: F401
from tests.imu.motion import quick_jit

ROWS = 12
"""Number of rows in most recordings: one program serves all of them."""


@quick_jit
def smoothed(chain: Chain, guess: MotionState, tolerance: float = 1e-9, at_most: int = 40) -> Smoothed:
    return smooth(
        chain, guess, max_iterations=jnp.asarray(at_most, jnp.int32), tolerance=jnp.asarray(tolerance)
    )


evidence_of = quick_jit(log_evidence)
