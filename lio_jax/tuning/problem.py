"""What is tuned or trained: recordings, the parameters as a vector with its bounds, and their loss."""

import math
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Sequence as Listing
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.run.fitted_settings import ring_count
from lio_jax.run.run import settings_for
from lio_jax.settings.settings import Settings
from lio_jax.tuning.corrected import CorrectedLoss, free_of_back_end, names_back_end
from lio_jax.tuning.gradient import Loss, Mode, wants_map
from lio_jax.tuning.objectives import Named, Objective, as_named
from lio_jax.tuning.optimise import Bounds
from lio_jax.tuning.parameters import ParameterVector, free_parameters
from lio_jax.tuning.recording import Recording

_FACTOR = 1000.0
"""Largest change of a positive parameter from its start, as a factor."""
_REACH = {
    "rotation": math.radians(20),
    "translation": 0.5,
    "time_offset": 0.1,
    "elevation_offset": 0.05,
    "ring_elevation_offset": 0.05,
    "range_offset": 0.5,
    "ring_range_offset": 0.5,
    "range_scale": math.log(1.2),
    "lever_arm": 3.0,
}
"""Largest change of parameters that move the points or the antenna, from their start: rad, m, s, and of a
logarithm."""
SHORTEST_SEGMENT = 20
"""Least number of scans of a segment: a shorter one shows the start only."""


@dataclass(frozen=True)
class Problem:
    """A loss of parameters over recordings, and where its minimum is looked for."""

    given: Settings
    """Settings as they were given."""
    settings: Settings
    """The same with the sizes and the extrinsics of the first recording."""
    free: ParameterVector
    loss: Loss | CorrectedLoss
    named: Named
    through_map: bool
    """Whether the derivative goes through the map."""
    training: tuple[Recording, ...]
    validation: tuple[Recording, ...]
    notes: tuple[str, ...]
    """What was taken from the recordings, or is wrong with them, in sentences."""

    @property
    def scored(self) -> bool:
        """Return whether the loss is a likelihood with a score for each scan."""
        return self.named.likelihood and not isinstance(self.loss, CorrectedLoss)

    @property
    def of_graph(self) -> bool:
        """Return whether the loss is the likelihood of a graph, which is smooth and has no scores."""
        return self.named.likelihood and isinstance(self.loss, CorrectedLoss)

    def first(self) -> NDArray[np.float64]:
        """Return the vector of the start, (p,)."""
        return np.asarray(self.free.first(), np.float64)

    def bounds(self) -> Bounds:
        """Return the vectors that are allowed."""
        first, width = self.first(), _largest_change(self.free)
        upper = first + width
        for place, name in enumerate(self.free.names):
            if name == "registration.information_scale":
                upper[place] = 0.0
        return Bounds(first - width, np.maximum(upper, first))

    def at_limit(self, x: NDArray[np.float64]) -> list[str]:
        """Return the names of the components that changed as far as they may."""
        # the difference of a bound and the start is rounded
        ended = np.abs(x - self.first()) > 0.999 * _largest_change(self.free)
        return [name for name, at in zip(self.free.names, ended, strict=True) if at]

    def tuned_settings(self, x: NDArray[np.float64]) -> Settings:
        """Return the settings that were given with the values of a vector.

        What was taken from the recordings is left out: a run takes it from its own recording.
        """
        settings = self.given
        for path, value in self.free.overrides(x).items():
            settings = settings.with_value(path, value, "tuned")
        return settings


def identity(problem: Problem) -> dict[str, Any]:
    """Return what tells a problem from others, by the words in which another one is refused.

    It consists of lists, numbers and words: JSON keeps it as it is.
    """
    return {
        "objective": problem.named.name,
        "parameters": list(problem.free.names),
        "values of parameters": problem.settings.values,
        "recipe": problem.settings.recipe,
        "config": repr(problem.settings.config),
        "recordings": [piece.name for piece in problem.training],
        "pieces": [len(piece) for piece in problem.training],
        "recordings that judge": [judge.name for judge in problem.validation],
    }


@contextmanager
def taking_up(path: Path, kind: str, own: Mapping[str, Any]) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Give a check of the identity in a file that an interrupted tuning or training has left.

    Call it before the rest of the file is used. An error of reading within the block names the file.

    Args:
        path: of the file.
        kind: what it holds, such as ``training``.
        own: the identity of the problem which goes on.

    Raises:
        UsageError: another problem has left it. The message names what differs.
        LioJaxError: it cannot be read, or lacks a part.
    """

    def check(left: Mapping[str, Any]) -> None:
        if other := [name for name, value in own.items() if left[name] != value]:
            was = f" (it has {left['objective']})" if "objective" in other else ""
            raise UsageError(
                f"{path}: is the {kind} of another problem, with other {', '.join(other)}{was}; give another "
                "--out, or --overwrite to begin anew."
            )

    try:
        yield check
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise LioJaxError(
            f"{path}: is no {kind} that can be continued ({error}); give --overwrite to begin anew."
        ) from None


def problem_of(
    recordings: Listing[Sequence],
    patterns: Listing[str],
    objective: str | Objective | None = None,
    settings: Settings | None = None,
    validate: Listing[Sequence] = (),
    truth: Trajectory | None = None,
    start: int = 0,
    count: int | None = None,
    segment: int | None = None,
    mode: Mode = "auto",
) -> Problem:
    """Read the recordings and return the loss of the parameters over them.

    Args:
        recordings: to learn from.
        patterns: parameters by name or glob, such as ``imu.*_noise``.
        objective: by name, a sum of names, or one's own; None: ``noise``, or ``ate`` for parameters of the
            back end.
        settings: recipe, config and params; None: the default recipe's.
        validate: recordings to judge by; they are run whole.
        truth: in place of that of the recordings.
        start: first scan of each recording.
        count: number of scans of each; None: to the end.
        segment: cut the recordings into pieces of this many scans, each of which starts on its own.
        mode: of the derivative; auto and forward give the scans' scores of a likelihood.

    Raises:
        UsageError: a parameter or an objective is not known or has no derivative, truth is needed and
            missing, or a number is impossible.
    """
    if not recordings:
        raise UsageError("no recording was given to learn from.")
    if start < 0 or (count is not None and count < 2):
        raise UsageError(f"--start must be 0 or more and --scans 2 or more, not {start} and {count}.")
    if segment is not None and segment < SHORTEST_SEGMENT:
        raise UsageError(
            f"--segment must be {SHORTEST_SEGMENT} scans or more, not {segment}: a shorter one shows the "
            "start only."
        )
    given = settings if settings is not None else Settings()
    corrected = names_back_end(patterns, given)
    named = as_named(objective if objective is not None else "ate" if corrected else "noise")

    def free_in(settings: Settings) -> ParameterVector:
        if corrected:
            return free_of_back_end(settings, patterns, named)
        return free_parameters(settings.params(), list(patterns), lambda: ring_count(recordings[0].scans()))

    free_in(given)
    for sequence in recordings:
        _check_truth(sequence, truth, named)
    for sequence in validate:
        _check_truth(sequence, None, named)
    fitted, notes = settings_for(recordings[0], given)
    training = [
        Recording(sequence, fitted, begin, length, truth)
        for sequence in recordings
        for begin, length in _pieces(sequence, start, count, segment)
    ]
    judging, more = settings_for(validate[0], fitted) if validate else (fitted, [])
    validation = [Recording(sequence, judging) for sequence in validate]
    of_each = [note for one in (*training, *validation) for note in one.notes]
    notes = list(dict.fromkeys([*notes, *more, *of_each]))
    free = free_in(fitted)
    through_map = not corrected and wants_map(named, free)
    loss: Loss | CorrectedLoss = (
        CorrectedLoss(fitted, free, named.objective)
        if corrected
        else Loss(fitted.recipe, fitted.config, free, named.objective, through_map, named.likelihood, mode)
    )
    return Problem(
        given,
        fitted,
        free,
        loss,
        named,
        through_map,
        tuple(training),
        tuple(validation),
        tuple(notes),
    )


def _check_truth(sequence: Sequence, truth: Trajectory | None, named: Named) -> None:
    if named.needs_truth and truth is None and sequence.truth() is None:
        raise UsageError(
            f"{sequence.info.path}: holds no truth, which the objective needs; give it (--gt FILE), or an "
            "objective without truth (noise, or marginal for loops and GPS)."
        )


def _pieces(
    sequence: Sequence, start: int, count: int | None, segment: int | None
) -> Iterator[tuple[int, int]]:
    """Yield the first scan and the number of scans of each piece of a recording."""
    left = max(0, sequence.info.scan_count - start)
    count = left if count is None else min(count, left)
    length = count if segment is None else min(segment, count)
    for begin in range(start, start + count - length + 1, max(length, 1)):
        yield begin, length


def _largest_change(free: ParameterVector) -> NDArray[np.float64]:
    """Return the largest change of each component from its start."""
    return np.array([_REACH.get(name.split(".")[1], math.log(_FACTOR)) for name in free.names])
