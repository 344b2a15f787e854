"""Several parameter sets over one recording in one program: the recipe's step under vmap."""

import time
from collections.abc import Sequence as Listing
from typing import Any

import jax
import jax.numpy as jnp

from lio_jax.data.sequence import Sequence
from lio_jax.recipes.transforms import batched
from lio_jax.run.compiled import Compiled
from lio_jax.run.logs import Failures, Overflow, StageTimes, TrajectoryLog
from lio_jax.run.run import check_start, imu_feed, nothing_read, prediction
from lio_jax.run.sinks import RunResult, Sink, finish_all
from lio_jax.run.track import ResultBuilder, run_steps, scan_inputs
from lio_jax.run.verdict import Verdict
from lio_jax.settings.settings import Settings, recipe_of


def same_batch(settings: Settings) -> tuple[Any, ...]:
    """Return what the members of a batch have to share."""
    offset = settings.values["extrinsics"]["time_offset"]
    estimated = settings.values["initial"].get("time_offset_sigma", 0.0) > 0
    velocity = tuple(settings.values["initial"]["velocity"])
    # lists with a number per ring may be of any length
    shapes = tuple(leaf.shape for leaf in jax.tree.leaves(settings.params()))
    return settings.recipe, settings.config, settings.run, offset, estimated, velocity, shapes


def run_batch(
    sequence: Sequence,
    settings: Listing[Settings],
    start: int = 0,
    count: int | None = None,
) -> list[RunResult]:
    """Run the parameter sets over a recording side by side; times are the batch's, divided by its size.

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
    judges = [ResultBuilder(one) for one in settings]
    sinks: list[list[Sink]] = [
        [TrajectoryLog(), StageTimes("step", "total"), Failures(start), Overflow(one), Verdict(one)]
        for one in settings
    ]
    scans = sequence.scans(start, count)
    stepper = Compiled(batched(recipe_of(first)), stacked)
    compiled_s, tracked = stepper.compile_s, False
    for fed, state, output in run_steps(stepper, scan_inputs(first, scans, imu)):
        nav, seen = jax.device_get((state.nav, output))
        step_s = time.perf_counter() - fed.begun_at - (stepper.compile_s - compiled_s)
        compiled_s = stepper.compile_s
        tracked = True
        for number, (judged, own_sinks) in enumerate(zip(judges, sinks, strict=True)):
            own_nav, own = jax.tree.map(lambda leaf, number=number: leaf[number], (nav, seen))
            result = judged(fed, own_nav, own.registration, own, step_s * 1e3 / len(judges))
            for sink in own_sinks:
                sink.take(result)
    if not tracked:
        raise nothing_read(sequence)
    shared = {
        "compile_s": round(stepper.compile_s / len(settings), 4),
        "wall_s": round((time.perf_counter() - began) / len(settings), 4),
    }
    return [_finished(one, prediction(sequence, imu, imu_notes) | shared) for one in sinks]


def _finished(sinks: list[Sink], metrics: dict[str, Any]) -> RunResult:
    run = RunResult(metrics=metrics)
    finish_all(sinks, run)
    return run
