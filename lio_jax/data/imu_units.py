"""The accelerometer's unit, recognised from the strength of gravity."""

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.config import DataConfig

STANDARD_GRAVITY = 9.80665
"""m/s^2."""


def accel_scale(accel: NDArray[np.float64], config: DataConfig) -> tuple[float, str]:
    """Return the factor that turns the samples into m/s^2, and a note ("" where there is nothing to say).

    Over a recording the median specific force is near one gravity whatever the vehicle does, so it is near 1
    for an accelerometer in g and near 9.8 for one in m/s^2.

    Args:
        accel: (m, 3) as recorded.
        config: ``accel_unit`` overrides.
    """
    if config.accel_unit != "auto":
        return (STANDARD_GRAVITY if config.accel_unit == "g" else 1.0), ""
    if len(accel) == 0:
        return 1.0, ""
    median = float(np.median(np.linalg.norm(accel, axis=1)))
    if 0.8 <= median <= 1.25:
        return STANDARD_GRAVITY, f"accelerometer in g (median {median:.3f}): converted to m/s^2"
    if not 7.0 <= median <= 13.0:
        return 1.0, (
            f"the accelerometer's median strength {median:.3g} is neither 1 g nor 9.8 m/s^2: taken as m/s^2, "
            "set config.data.accel_unit if it is not"
        )
    return 1.0, ""
