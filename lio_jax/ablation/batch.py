"""Several parameter sets over one recording in one program: the recipe's step under vmap."""

import time
from collections.abc import Sequence as Listing
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp

from lio_jax.core.errors import LioJaxError
from lio_jax.core.settings import Settings
from lio_jax.data.prefetch import prefetched
from lio_jax.data.sequence import Sequence
from lio_jax.recipes import recipe_of
from lio_jax.recipes.transforms import batched
from lio_jax.run.logs import Overflow, TrajectoryLog
from lio_jax.run.run import check_start, failure_record, imu_feed, percentiles
from lio_jax.run.track import Compiled, ResultBuilder, ScanResult, run_steps, scan_inputs


@dataclass(frozen=True)
class BatchedRun:
    """What one parameter set gave."""

    log: TrajectoryLog
    metrics: dict[str, Any]
    """As in metrics.json; times are the batch's, divided by its size."""


def same_batch(settings: Settings) -> tuple[Any, ...]:
    """Return what the members of a batch have to share."""
    offset = settings.values["extrinsics"]["time_offset"]
    estimated = settings.values["initial"]["time_offset_sigma"] > 0
    return settings.recipe, settings.config, offset, estimated


def run_batch(
    sequence: Sequence,
    settings: Listing[Settings],
    start: int = 0,
    count: int | None = None,
) -> list[BatchedRun]:
    """Run the parameter sets over a recording side by side.

    Args:
        sequence: the recording, read once.
        settings: resolved, all alike in :func:`same_batch`.
        start: first scan.
        count: number of scans; None: to the end.

    Raises:
        LioJaxError: no scan could be read.
    """
    check_start(sequence, start)
    began = time.perf_counter()
    first = settings[0]
    imu, imu_notes = imu_feed(sequence, first)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[one.params() for one in settings])
    runs = [_Run(one, start) for one in settings]
    scans: Any = prefetched(sequence.scans(start, count), first.config.data.prefetch)
    stepper = Compiled(batched(recipe_of(first)), stacked)
    compiled_s = stepper.compile_s
    for fed, state, output in run_steps(stepper, scan_inputs(first, scans, imu)):
        nav, seen = jax.device_get((state.nav, output))
        step_s = time.perf_counter() - fed.padded_at - (stepper.compile_s - compiled_s)
        compiled_s = stepper.compile_s
        for number, run in enumerate(runs):
            own_nav, own = jax.tree.map(lambda leaf, number=number: leaf[number], (nav, seen))
            run.add(run.judged(fed, own_nav, own.registration, own, step_s * 1e3 / len(runs)))
    if not len(runs[0].log):
        reasons = " ".join(sequence.warnings_so_far)
        raise LioJaxError(f"{sequence.info.path}: no scan could be read. {reasons}".strip())
    shared = {
        "prediction": "inertial samples" if imu else "constant velocity",
        "compile_s": round(stepper.compile_s / len(runs), 4),
        "wall_s": round((time.perf_counter() - began) / len(runs), 4),
    }
    warnings = [*sequence.warnings_so_far, *imu_notes, *(imu.warnings() if imu else ())]
    return [BatchedRun(run.log, run.metrics() | shared | run.warned(warnings)) for run in runs]


class _Run:
    """What is kept of one parameter set."""

    def __init__(self, settings: Settings, start: int) -> None:
        self.log = TrajectoryLog()
        self.judged = ResultBuilder(settings)
        self._start = start
        self._overflow = Overflow(settings)
        self._failures: list[dict[str, Any]] = []
        self._stage_ms: dict[str, list[float]] = {"step": [], "total": []}

    def add(self, tracked: ScanResult) -> None:
        self.log.append(tracked)
        self._overflow.add(tracked)
        if tracked.failure:
            self._failures.append(failure_record(self._start + tracked.index, tracked))
        for stage, values in self._stage_ms.items():
            values.append(tracked.stage_ms[stage])

    def metrics(self) -> dict[str, Any]:
        return {
            "scans": len(self.log),
            "scan_ms": {stage: percentiles(values) for stage, values in self._stage_ms.items()},
            "failures": self._failures,
            "overflow": self._overflow.metrics(),
        }

    def warned(self, warnings: list[str]) -> dict[str, Any]:
        return {"warnings": [*warnings, *self._overflow.warnings()]}
