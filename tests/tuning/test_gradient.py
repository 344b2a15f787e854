"""The gradient in one line, without a run."""

import numpy as np
import pytest

from lio_jax import SimulatedSequence, gradient
from lio_jax.core.errors import LioJaxError
from lio_jax.sim.imu import ImuModel
from lio_jax.tuning import gradient as module
from lio_jax.tuning.streaming import Gradient


def test_a_likelihood_of_which_no_scan_counts_is_refused(monkeypatch):
    """As of the first ten scans alone."""
    nothing = Gradient(0.0, np.zeros(1), np.zeros((10, 1)), ())
    monkeypatch.setattr(module, "streaming_gradient", lambda *args, **options: nothing)
    drive = SimulatedSequence("street", duration_s=2.0, beams=8, columns=256, imu=ImuModel())
    with pytest.raises(LioJaxError, match="none of the 10 scans tells of the parameters"):
        gradient(drive, ["imu.gyro_noise"], "pose", count=10)
