"""The mean of an objective over several recordings, with its gradient and the scans' scores."""

from collections.abc import Sequence as Listing
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lio_jax.recipes.params import RecipeConfig as Config
from lio_jax.tuning.objectives import Objective
from lio_jax.tuning.parameters import ParameterVector
from lio_jax.tuning.recording import Recording
from lio_jax.tuning.streaming import StreamingGradient


@dataclass(frozen=True)
class Evaluated:
    """The loss at one vector of parameters."""

    value: float
    gradient: NDArray[np.float64]
    """(p,)."""
    scores: NDArray[np.float64]
    """(n, p) each scan's share of the gradient of the sum over all scans."""
    unconverged: int
    """Scans whose solve did not converge: with many of them the gradient is not to be trusted."""
    scans: int


class Loss:
    """Mean objective over recordings, weighted by their numbers of scans."""

    def __init__(self, recipe: str, config: Config, free: ParameterVector, objective: Objective) -> None:
        """Keep the programs; they are compiled on first use."""
        self._streaming = StreamingGradient(recipe, config, free, objective)

    def __call__(self, x: NDArray[np.float64], recordings: Listing[Recording]) -> Evaluated:
        """Return the loss at a vector of parameters, with its gradient."""
        results = [self._streaming(x, recording) for recording in recordings]
        counts = np.array([len(result.scores) for result in results])
        shares = counts / counts.sum()
        return Evaluated(
            value=float(shares @ [result.value for result in results]),
            gradient=shares @ np.stack([result.gradient for result in results]),
            scores=np.concatenate(
                [count * result.scores for count, result in zip(counts, results, strict=True)]
            ),
            unconverged=sum(len(result.unconverged) for result in results),
            scans=int(counts.sum()),
        )
