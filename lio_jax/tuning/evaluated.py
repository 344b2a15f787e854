"""The loss at one vector of parameters, as optimisers take it, and what it is on recordings that judge."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lio_jax.tuning.recording import Recording


class Valued(Protocol):
    """A loss whose values need no gradient."""

    def values(self, xs: NDArray[np.float64], recording: Recording) -> NDArray[np.float64]:
        """Return the loss of one recording at each row of ``xs``, (n, p)."""
        ...


def validation_loss(loss: Valued, x: NDArray[np.float64], judges: Sequence[Recording]) -> float | None:
    """Return the mean loss over recordings, weighted by their numbers of scans; None without recordings.

    Args:
        loss: of the parameters.
        x: (p,) the vector of parameters.
        judges: recordings that are not learned from.
    """
    if not judges:
        return None
    losses = [float(loss.values(np.asarray(x)[None], recording)[0]) for recording in judges]
    return float(np.average(losses, weights=[len(recording) for recording in judges]))


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
