"""Train learned parts: stochastic gradient steps over pieces of many recordings.

Each step takes the mean gradient of a batch of pieces, drawn without replacement within an epoch, and goes
down along Adam's direction (Kingma & Ba 2015) with a rate that falls to zero as a half cosine (Loshchilov &
Hutter, "SGDR: Stochastic gradient descent with warm restarts", 2017, without the restarts). What is needed
to go on is written after every step, so that a killed training goes on to the same numbers.
"""

import json
import math
from collections.abc import Callable
from collections.abc import Sequence as Listing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import atomic_path, read_arrays
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.settings.settings import Settings
from lio_jax.tuning.evaluated import validation_loss
from lio_jax.tuning.objectives import Objective, nothing_depends
from lio_jax.tuning.optimise import Bounds, Moments
from lio_jax.tuning.problem import Problem, identity, problem_of, taking_up

TRAINING = "training.npz"
_Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Epoch:
    """All pieces of the recordings, once."""

    training: float
    """Mean loss of the pieces, each before the step that it takes part in."""
    validation: float | None
    """Loss on the recordings that judge, after the epoch; None where there are none."""
    skipped: int
    """Batches without a finite loss and gradient; they changed nothing."""


@dataclass(frozen=True)
class Trained:
    """What a training found."""

    settings: Settings
    """The settings that were given, with the parameters found. What was taken from the recordings is left
    out: a run takes it from its own recording."""
    epochs: tuple[Epoch, ...]
    best: int
    """Number of the epoch whose parameters were taken, from 0: that of the lowest validation loss, or the
    last one where no recording judges."""


@dataclass(frozen=True)
class Schedule:
    """How a training goes over its pieces."""

    batch: int = 4
    """Pieces in one step."""
    epochs: int = 20
    rate: float = 0.01
    """First length of a step in each component: of logarithms for positive parameters, of the others
    themselves."""
    patience: int = 5
    """Epochs without a lower validation loss after which the training ends."""
    seed: int = 0
    """Of the order of the pieces."""

    def __post_init__(self) -> None:
        """Refuse impossible numbers.

        Raises:
            UsageError: one is not positive.
        """
        for name in ("batch", "epochs", "patience"):
            if getattr(self, name) < 1:
                raise UsageError(f"{name} must be 1 or more, not {getattr(self, name)}.")
        if not (math.isfinite(self.rate) and self.rate > 0):
            raise UsageError(f"rate must be a positive number, not {self.rate}.")


def train(
    recordings: Listing[Sequence],
    patterns: Listing[str],
    objective: str | Objective | None = None,
    settings: Settings | None = None,
    validate: Listing[Sequence] = (),
    truth: Trajectory | None = None,
    segment: int | None = 50,
    schedule: Schedule | None = None,
    out: Path | None = None,
    observer: Callable[[Epoch], None] = lambda epoch: None,
) -> Trained:
    """Train parameters of a recipe, such as a network's weights, on pieces of recordings.

    For hundreds of numbers and many recordings. A few parameters are tuned by
    :func:`lio_jax.tuning.tune.tune`, which finds their intervals, too.
    The gradients are by reverse mode. All pieces are kept in memory.

    Args:
        recordings: to learn from.
        patterns: parameters by name or glob, such as ``learned.weights``.
        objective: by name, a sum of names, or one's own; None: ``noise``, which needs no truth, or ``ate``
            for parameters of the back end.
        settings: recipe, config and params to start from; None: the default recipe's.
        validate: recordings that decide which epoch is taken and when to stop.
        truth: in place of that of the recordings.
        segment: number of scans of a piece, each of which starts on its own; None: whole recordings.
        schedule: of the steps.
        out: folder for ``training.npz``, made where there is none, from which the same call goes on after
            a kill; None: nothing is written.
        observer: called after every epoch.

    Raises:
        UsageError: see :func:`lio_jax.tuning.problem.problem_of`; or the folder holds another training.
        LioJaxError: no batch of the first epoch has a finite loss, or nothing depends on the parameters.
    """
    problem = problem_of(
        recordings, patterns, objective, settings, validate, truth, segment=segment, mode="reverse"
    )
    session = TrainingSession(problem, schedule or Schedule(), out)
    session.run(observer)
    return session.trained()


class TrainingSession:
    """A training and what it has found so far."""

    def __init__(self, problem: Problem, schedule: Schedule, out: Path | None) -> None:
        """Take up the training that lies in the folder.

        Args:
            problem: the loss of the parameters.
            schedule: of the steps.
            out: folder for ``training.npz``; None: nothing is written.

        Raises:
            UsageError: the training in the folder has another objective, other parameters, recordings,
                settings, pieces or another order.
        """
        self._problem, self._schedule = problem, schedule
        self._path = None if out is None else out / TRAINING
        if out is not None:
            out.mkdir(parents=True, exist_ok=True)
        first = problem.first()
        self._x, self._moments, self._best_x = first, Moments.none(len(first)), first
        self._losses: list[float] = []
        self._skipped = 0
        self.epochs: list[Epoch] = []
        if self._path is not None and self._path.exists():
            self._take_up(self._path)

    @property
    def best(self) -> int:
        """Return the number of the epoch whose parameters are taken."""
        losses = [epoch.validation for epoch in self.epochs]
        if not losses or losses[0] is None:
            return len(self.epochs) - 1
        return int(np.argmin([math.inf if loss is None or math.isnan(loss) else loss for loss in losses]))

    def trained(self) -> Trained:
        """Return what was found so far."""
        settings = self._problem.tuned_settings(self._best_x)
        return Trained(settings, tuple(self.epochs), self.best)

    def run(self, observer: Callable[[Epoch], None]) -> None:
        """Train until the last epoch, or until the validation loss has not fallen for long."""
        schedule, pieces = self._schedule, self._problem.training
        batches = -(-len(pieces) // schedule.batch)
        bounds = self._problem.bounds()
        while len(self.epochs) < schedule.epochs and not self._fails_to_improve():
            epoch = len(self.epochs)
            order = np.random.default_rng((schedule.seed, epoch)).permutation(len(pieces))
            for number in range(len(self._losses) + self._skipped, batches):
                chosen = order[number * schedule.batch : (number + 1) * schedule.batch]
                done = (epoch * batches + number) / (schedule.epochs * batches)
                rate = schedule.rate * (1 + math.cos(math.pi * done)) / 2
                self._step([int(piece) for piece in chosen], rate, bounds)
            self._end_epoch(observer)

    def _fails_to_improve(self) -> bool:
        return len(self.epochs) - 1 - self.best >= self._schedule.patience

    def _step(self, chosen: list[int], rate: float, bounds: Bounds) -> None:
        result = self._problem.loss(self._x, [self._problem.training[piece] for piece in chosen])
        if math.isfinite(result.value) and np.isfinite(result.gradient).all():
            if not self._moments.steps and not result.gradient.any():
                raise nothing_depends(self._problem.free.names)
            self._moments, self._x = self._moments.step(self._x, result.gradient, rate, bounds)
            self._losses.append(result.value)
        else:
            self._skipped += 1
        self._write()

    def _end_epoch(self, observer: Callable[[Epoch], None]) -> None:
        if not self._losses:
            raise LioJaxError(
                f"no batch of epoch {len(self.epochs) + 1} has a finite loss and gradient; check the "
                "parameters with lio-jax run, and make the rate smaller."
            )
        validation = validation_loss(self._problem.loss, self._x, self._problem.validation)
        epoch = Epoch(float(np.mean(self._losses)), validation, self._skipped)
        self.epochs.append(epoch)
        if self.best == len(self.epochs) - 1:
            self._best_x = self._x
        self._losses, self._skipped = [], 0
        self._write()
        observer(epoch)

    def _identity(self) -> dict[str, Any]:
        return identity(self._problem) | {"batch": self._schedule.batch, "seed": self._schedule.seed}

    def _write(self) -> None:
        if self._path is None:
            return
        rows = [(one.training, one.validation, one.skipped) for one in self.epochs]
        with atomic_path(self._path) as aside, aside.open("wb") as file:
            np.savez(
                file,
                x=self._x,
                best_x=self._best_x,
                mean=self._moments.mean,
                square=self._moments.square,
                steps=np.int64(self._moments.steps),
                losses=np.array(self._losses),
                skipped=np.int64(self._skipped),
                epochs=np.array(rows, np.float64).reshape(-1, 3),
                identity=np.array(json.dumps(self._identity())),
            )

    def _take_up(self, path: Path) -> None:
        with taking_up(path, "training", self._identity()) as check:
            held = read_arrays(path)
            check(json.loads(str(held["identity"])))
            judged = bool(self._problem.validation)
            self.epochs = [
                Epoch(training, validation if judged else None, int(skipped))
                for training, validation, skipped in held["epochs"].tolist()
            ]
            self._moments = Moments(held["mean"], held["square"], int(held["steps"]))
            self._x, self._best_x = held["x"], held["best_x"]
            self._losses, self._skipped = held["losses"].tolist(), int(held["skipped"])
