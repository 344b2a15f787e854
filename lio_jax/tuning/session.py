"""One tuning: evaluations are written down as they come, so that a killed one goes on where it was."""

import json
import math
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Listing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path
from lio_jax.tuning.evaluated import Evaluated, validation_loss
from lio_jax.tuning.objectives import nothing_counts, nothing_depends
from lio_jax.tuning.optimise import Bounds, adam, fisher_scoring, lbfgsb, parameter_covariance, stationary
from lio_jax.tuning.problem import Problem, identity, taking_up
from lio_jax.tuning.recording import Recording

HISTORY = "history.json"


@dataclass(frozen=True)
class Iterate:
    """One evaluation."""

    x: tuple[float, ...]
    value: float
    """Training loss."""
    gradient: tuple[float, ...]
    sigma: tuple[float, ...] | None
    """Standard deviation by the Fisher information; None where the loss is no likelihood."""
    unconverged: int
    """Scans whose solve did not converge: with many of them the gradient is not to be trusted."""
    scans: int
    """Scans processed in this evaluation."""
    validation: float | None
    """Loss on the validation recordings; None where there are none."""

    @property
    def judged(self) -> float:
        """Return what decides which iterate is best."""
        return self.value if self.validation is None else self.validation


class EarlyStop(Exception):
    """The loss has not fallen for long."""


class Session:
    """Evaluates, writes down, judges."""

    def __init__(
        self,
        problem: Problem,
        folder: Path | None,
        patience: int,
        observer: Callable[[Iterate], None] = lambda iterate: None,
    ) -> None:
        """Take up the history that lies in the folder.

        Args:
            problem: the loss of the parameters and its recordings.
            folder: gets ``history.json`` after every evaluation; None: nothing is written.
            patience: evaluations without a better one before the tuning ends.
            observer: called after every evaluation.

        Raises:
            UsageError: the history is that of another objective, of other parameters, values, settings or
                recordings.
            LioJaxError: it cannot be read.
        """
        self._path = None if folder is None else folder / HISTORY
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
        self._problem, self._patience, self._observer = problem, patience, observer
        self._unit: NDArray[np.float64] | None = None
        self.history: list[Iterate] = []
        if self._path is not None and self._path.exists():
            self._take_up(self._path)

    @property
    def best(self) -> Iterate:
        """Return the iterate with the lowest loss, on the validation recordings where there are any.

        Where there are none and the optimiser looks for the zero of the gradient: with the smallest gradient.
        """
        finite = [iterate for iterate in self.history if math.isfinite(self._rank(iterate))]
        return min(finite, key=self._rank)

    def _rank(self, iterate: Iterate) -> float:
        if self._unit is None or iterate.validation is not None:
            return iterate.judged
        return float(np.linalg.norm(iterate.gradient * self._unit))

    def run(self, optimiser: str, x: NDArray[np.float64], bounds: Bounds, iterations: int, seed: int) -> None:
        """Minimise from ``x``, or from the last iterate of an earlier, interrupted tuning.

        Args:
            optimiser: scoring, lbfgsb, stationary or adam.
            x: where to start.
            bounds: of the vector.
            iterations: at most, those of the history included.
            seed: of the segments that adam draws.
        """
        self._unit = bounds.unit() if optimiser == "stationary" else None
        start = np.asarray(self.history[-1].x) if self.history else x
        left = iterations - len(self.history)
        if left <= 0:
            return
        try:
            if optimiser == "scoring":
                fisher_scoring(self.evaluate, start, bounds, left)
            elif optimiser == "stationary":
                stationary(self.evaluate, start, bounds, left)
            elif optimiser == "lbfgsb":
                lbfgsb(self.evaluate, start, bounds, left)
            else:
                adam(self._segments(seed + len(self.history)), start, bounds, left)
        except EarlyStop:
            pass

    def evaluate(self, x: NDArray[np.float64], recordings: Listing[Recording] | None = None) -> Evaluated:
        """Return the loss at ``x`` and write it down.

        Raises:
            EarlyStop: it has not fallen for long.
            LioJaxError: the very first value is not finite, or does not depend on the parameters.
        """
        problem = self._problem
        result = problem.loss(x, recordings or problem.training)
        if not self.history and not math.isfinite(result.value):
            raise LioJaxError(
                "the objective is not finite at the start; check the parameters with lio-jax run first."
            )
        if problem.scored and not self.history and result.scores is not None and not result.scores.any():
            raise nothing_counts(result.scans)
        if not self.history and not result.gradient.any():
            raise nothing_depends(problem.free.names)
        sigma = None
        if problem.scored:
            variance = np.diag(parameter_covariance(result))
            sigma = tuple(np.sqrt(np.maximum(variance, 0.0)).tolist())
        iterate = Iterate(
            tuple(np.asarray(x).tolist()),
            result.value,
            tuple(result.gradient.tolist()),
            sigma,
            result.unconverged,
            result.scans,
            validation_loss(problem.loss, x, problem.validation),
        )
        self.history.append(iterate)
        self._write()
        self._observer(iterate)
        since = len(self.history) - 1 - self.history.index(self.best)
        if since >= self._patience:
            raise EarlyStop
        return result

    def _segments(self, seed: int) -> Iterator[Callable[[NDArray[np.float64]], Evaluated]]:
        """Yield the loss over one recording after the other, drawn at random."""
        random = np.random.default_rng(seed)
        while True:
            training = self._problem.training
            chosen = training[int(random.integers(len(training)))]
            yield partial(self.evaluate, recordings=[chosen])

    def _write(self) -> None:
        if self._path is None:
            return
        held: dict[str, Any] = {
            "identity": identity(self._problem),
            "iterates": [asdict(one) for one in self.history],
        }
        with atomic_path(self._path) as aside:
            aside.write_text(json.dumps(held, indent=1) + "\n")

    def _take_up(self, path: Path) -> None:
        with taking_up(path, "history", identity(self._problem)) as check:
            held = json.loads(path.read_text())
            check(held["identity"])
            rows: list[dict[str, Any]] = [
                {key: tuple(value) if isinstance(value, list) else value for key, value in one.items()}
                for one in held["iterates"]
            ]
            self.history = [Iterate(**row) for row in rows]
