"""The loss at one vector of parameters, as optimisers take it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Evaluated:
    """The loss at one vector of parameters."""

    value: float
    gradient: NDArray[np.float64]
    """(p,)."""
    scores: NDArray[np.float64] | None
    """(n, p) each scan's share of the gradient of the sum over all scans; None by reverse mode."""
    unconverged: int
    """Scans whose solve did not converge: with many of them the gradient is not to be trusted."""
    scans: int
