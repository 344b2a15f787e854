"""Objectives of the pose graph after loops and GPS, with gradients by the back end's parameters.

The choices of the back end are those of one run at the first parameters (see
:mod:`lio_jax.tuning.replayed_graph`). So a loss costs one solve of the graph, and it is smooth.
"""

from collections.abc import Sequence as Listing
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.leaf import settings_of, traced
from lio_jax.core.xla import programs
from lio_jax.loops.back_end import BackEnd
from lio_jax.loops.closing import LoopCloser
from lio_jax.recipes import recipe_named
from lio_jax.recipes.transforms import Dual, push_forward
from lio_jax.run.compiled import CompiledStep
from lio_jax.run.global_correction import gps_gate, light
from lio_jax.run.keyframes import KeyframePicker
from lio_jax.run.track import ResultBuilder, run_steps
from lio_jax.settings.settings import Settings
from lio_jax.settings.shared import GlobalParams
from lio_jax.tuning.evaluated import Evaluated
from lio_jax.tuning.objectives import (
    MarginalLikelihood,
    Named,
    Objective,
    Observed,
    TruePose,
    WeightedSum,
)
from lio_jax.tuning.parameters import ParameterVector, free_parameters, named_leaves
from lio_jax.tuning.recording import Recording
from lio_jax.tuning.replayed_graph import ReplayedGraph, replayed_graph
from lio_jax.tuning.streaming import split_objective


def names_back_end(patterns: Listing[str], settings: Settings) -> bool:
    """Return whether patterns name parameters of the back end, and not of the recipe.

    Args:
        patterns: parameters by name or glob.
        settings: of the run.

    Raises:
        UsageError: they name both, or the run has no back end or feeds its corrections back.
    """
    own, shared = settings_of(recipe_named(settings.recipe).params_type), settings_of(GlobalParams)
    back_end = [one for one in patterns if named_leaves(one, shared) and not named_leaves(one, own)]
    if not back_end:
        return False
    if rest := [pattern for pattern in patterns if pattern not in back_end]:
        raise UsageError(
            f"'{back_end[0]}' belongs to the back end and '{rest[0]}' to the recipe; tune them one after the "
            "other."
        )
    backend = settings.run.backend
    if not (backend.loops or backend.gps):
        raise UsageError(
            f"'{back_end[0]}' has no effect without the back end; add --set config.backend.loops=true or "
            "config.backend.gps=true."
        )
    if backend.feedback:
        raise UsageError(
            f"'{back_end[0]}' is tuned for an odometry that does not depend on it; leave "
            "config.backend.feedback=true out."
        )
    return True


def free_of_back_end(settings: Settings, patterns: Listing[str], named: Named) -> ParameterVector:
    """Return the parameters of the back end that the patterns name.

    Args:
        settings: their start values.
        patterns: parameters by name or glob.
        named: the objective.

    Raises:
        UsageError: the objective depends neither on the corrected trajectory nor on the graph, or see
            :func:`lio_jax.tuning.parameters.free_parameters`.
    """
    objective = named.objective
    if isinstance(objective, WeightedSum) and any(map(_is_evidence, objective.parts)):
        raise UsageError("for loops and GPS, marginal is no part of a sum; take marginal alone.")
    if named.likelihood and not _is_evidence(objective):
        raise UsageError(
            "a likelihood of single scans does not depend on loops and GPS; take the objective ate, rpe or "
            "rpe-rotation, or marginal, which needs no truth."
        )
    return free_parameters(traced(GlobalParams, settings.values), list(patterns))


def _is_evidence(objective: Objective) -> bool:
    """Return whether the objective is the likelihood of the graph, not a loss of the trajectory."""
    return isinstance(objective, MarginalLikelihood)


class CorrectedRun(NamedTuple):
    """A run of the odometry and the back end over a recording."""

    seen: tuple[Observed, ...]
    """What an objective sees of each scan, numpy leaves; the pose is that of the odometry."""
    truth: tuple[TruePose, ...]
    """Of each scan."""
    replayed: ReplayedGraph
    loops: int
    """Number of loops in the graph."""
    fixes: int
    """Number of fixes in the graph."""

    def evidence_per_scan(self, params: GlobalParams) -> Float[Array, ""]:
        """Return minus the log marginal likelihood of the graph over the number of scans."""
        return self.replayed.negative_log_evidence(params) / len(self.seen)


def corrected_run(recording: Recording, settings: Settings) -> CorrectedRun:
    """Run the odometry and the back end over a recording.

    Args:
        recording: run through once.
        settings: with ``config.backend.loops`` or ``config.backend.gps``.

    Raises:
        LioJaxError: the recording holds no fixes and GPS is asked for, or it has no pose.
    """
    backend = settings.run.backend
    gate = gps_gate(recording.sequence, settings)[0] if backend.gps else None
    back_end = BackEnd(settings, LoopCloser(settings) if backend.loops else None, gate)
    picker, build = KeyframePicker(settings), ResultBuilder(settings)
    stamps, poses, seen, truth = [], [], [], []
    step = CompiledStep(settings)
    for fed, state, output in run_steps(step, recording.scan_inputs(), pager=step.pager()):
        observed = jax.tree.map(np.array, Observed.of(state, output))
        registration = jax.tree.map(np.array, output.registration)
        result = build(fed, observed.nav, registration, output, 0.0)
        if (keyframe := picker(result)) is not None:
            back_end.add(light(keyframe))
        stamps.append(result.stamp_ns)
        poses.append(result.T_world_imu)
        seen.append(observed)
        truth.append(jax.tree.map(np.array, recording.truth_at(fed.end_ns)))
    back_end.settle()
    found = back_end.correction()
    if not len(found.stamp_ns):
        raise LioJaxError(f"{recording.name}: the odometry has no pose; check it with lio-jax run first.")
    return CorrectedRun(
        tuple(seen),
        tuple(truth),
        replayed_graph(found, np.array(stamps, np.int64), np.array(poses), backend.gps_elevation),
        sum(weight is not None for _, weight in found.loops),
        found.fixes.get("used", 0),
    )


class CorrectedLoss:
    """Mean objective over recordings after loops and GPS, weighted by their numbers of scans."""

    def __init__(self, settings: Settings, free: ParameterVector, objective: Objective) -> None:
        """Keep what the loss is of.

        Args:
            settings: at which the choices of the back end are made.
            free: its parameters.
            objective: of the corrected trajectory. It sees the corrected ``nav.T_world_imu``; all else is as
                the odometry has it, and there is no ``scan``. :class:`MarginalLikelihood`: see
                :meth:`ReplayedGraph.negative_log_evidence`, per scan.
        """
        self._settings, self._free, self._objective = settings, free, objective
        self._runs: dict[int, tuple[Recording, CorrectedRun]] = {}

    def __call__(self, x: NDArray[np.float64], recordings: Listing[Recording]) -> Evaluated:
        """Return the loss at a vector of parameters, with its gradient."""
        results = [
            corrected_gradient(self.run_over(one), self._free, self._objective, jnp.asarray(x))
            for one in recordings
        ]
        values, gradients = zip(*results, strict=True)
        return Evaluated.mean([len(recording) for recording in recordings], values, gradients)

    def values(self, xs: NDArray[np.float64], recording: Recording) -> NDArray[np.float64]:
        """Return the objective of one recording at each row of ``xs``."""
        run = self.run_over(recording)
        return np.array([corrected_value(run, self._free, self._objective, jnp.asarray(x)) for x in xs])

    def run_over(self, recording: Recording) -> CorrectedRun:
        """Return the run over a recording, which is made once.

        Raises:
            LioJaxError: the objective is the likelihood of the graph, which has neither loops nor fixes; or
                see :func:`corrected_run`.
        """
        if id(recording) not in self._runs:
            run = corrected_run(recording, self._settings)
            if _is_evidence(self._objective) and not run.replayed.closed:
                raise LioJaxError(
                    f"{recording.name}: no loop and no fix is in the graph, so its likelihood does not "
                    "depend on the parameters; use a recording that returns to a place or has GPS fixes."
                )
            self._runs[id(recording)] = recording, run
        return self._runs[id(recording)][1]


def corrected_gradient(
    run: CorrectedRun, free: ParameterVector, objective: Objective, x: Array
) -> tuple[float, NDArray[np.float64]]:
    """Return an objective of the corrected trajectory and its derivative, (p,).

    Args:
        run: of the odometry and the back end; its choices are constants.
        free: parameters of the back end.
        objective: see :class:`CorrectedLoss`.
        x: (p,) where.
    """
    if _is_evidence(objective):
        evidence = push_forward(run.evidence_per_scan, free.with_tangents(x))
        return float(evidence.value), np.asarray(evidence.dot, np.float64)
    poses = push_forward(run.replayed.corrected, free.with_tangents(x))
    arrays, static = split_objective(objective)
    add = programs(_add_with_tangents, static)
    sums = objective.start()
    total = Dual(sums, jax.tree.map(lambda leaf: jnp.zeros((len(x), *leaf.shape), leaf.dtype), sums))
    numbers, dots = np.asarray(poses.value), np.asarray(poses.dot)
    for number, (seen, truth) in enumerate(zip(run.seen, run.truth, strict=True)):
        total = add(arrays, total, Dual(numbers[number], dots[:, number]), seen, truth)
    value = push_forward(eqx.combine(arrays, static).value, total)
    return float(value.value), np.asarray(value.dot, np.float64)


def corrected_value(run: CorrectedRun, free: ParameterVector, objective: Objective, x: Array) -> float:
    """Return the objective of :func:`corrected_gradient` without its derivative."""
    if _is_evidence(objective):
        return float(run.evidence_per_scan(free(x)))
    poses = np.asarray(run.replayed.corrected(free(x)))
    arrays, static = split_objective(objective)
    add = programs(_add, static)
    total = objective.start()
    for pose, seen, truth in zip(poses, run.seen, run.truth, strict=True):
        total = add(arrays, total, pose, seen, truth)
    return float(objective.value(total))


def _add_with_tangents(
    static: Any, arrays: Any, sums: Dual, pose: Dual, seen: Observed, truth: TruePose
) -> Dual:
    return push_forward(lambda sums, numbers: _add(static, arrays, sums, numbers, seen, truth), sums, pose)


def _add(
    static: Any, arrays: Any, sums: Any, numbers: Float[Array, "7"], seen: Observed, truth: TruePose
) -> Any:
    objective: Objective = eqx.combine(arrays, static)
    moved = eqx.tree_at(lambda seen: seen.nav.T_world_imu, seen, jaxlie.SE3(numbers))
    return objective.add(sums, moved, truth)
