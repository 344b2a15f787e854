"""The loss at one vector of parameters, as optimisers take it."""

from collections.abc import Sequence
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

    @staticmethod
    def mean(
        counts: Sequence[int],
        values: Sequence[float],
        gradients: Sequence[NDArray[np.float64]],
        scores: NDArray[np.float64] | None = None,
        unconverged: int = 0,
    ) -> "Evaluated":
        """Return the mean over recordings, weighted by their numbers of scans.

        Args:
            counts: number of scans of each recording.
            values: loss of each.
            gradients: (p,) gradient of each.
            scores: of all scans together.
            unconverged: number of all scans whose solve did not converge.
        """
        shares = np.array(counts) / sum(counts)
        return Evaluated(
            float(shares @ np.array(values)), shares @ np.stack(gradients), scores, unconverged, sum(counts)
        )
