"""Which points of a cloud are returns: sensors mark "nothing came back" by NaN, infinity or zeros."""

import numpy as np
from numpy.typing import NDArray


def valid_returns(points: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Tell for each point (n, 3 or more; x, y, z first) whether x, y, z are finite and not all zero, (n,)."""
    with np.errstate(over="ignore", invalid="ignore"):
        squared = points[:, 0] ** 2 + points[:, 1] ** 2 + points[:, 2] ** 2
    return np.isfinite(squared) & (squared > 0)
