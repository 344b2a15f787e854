"""Several parameter sets over one recording in one program: the recipe's step under vmap."""

import time
from collections.abc import Sequence as Listing
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from lio_jax.core.xla import PerShape
from lio_jax.data.prefetch import prefetched
from lio_jax.data.sequence import Sequence
from lio_jax.recipes import recipe_named
from lio_jax.recipes.params import RecipeConfig as Config
from lio_jax.run.logs import Failures, Overflow, StageTimes, TrajectoryLog
from lio_jax.run.run import check_start, imu_feed, nothing_read, prediction
from lio_jax.run.sinks import RunResult, Sink, finish_all
from lio_jax.run.track import ResultBuilder, run_steps, scan_inputs
from lio_jax.settings.settings import Settings


class BatchPrograms:
    """A recipe's programs under one static config, for a batch of parameters."""

    def __init__(self, recipe: str, config: Config) -> None:
        self.recipe = recipe_named(recipe)(config)
        self.init = PerShape(jax.jit(jax.vmap(self.recipe.init, (0, None))))
        over_states = jax.vmap(self.recipe.step, (0, 0, None, None))
        self.step = PerShape(jax.jit(over_states, donate_argnums=1))

    @property
    def compile_s(self) -> float:
        """Return the time spent on compiling so far, s."""
        return self.init.compile_s + self.step.compile_s


def same_batch(settings: Settings) -> tuple[Any, ...]:
    """Return what the members of a batch have to share."""
    offset = settings.values["extrinsics"]["time_offset"]
    estimated = settings.values.get("initial", {}).get("time_offset_sigma", 0.0) > 0
    return settings.recipe, settings.config, settings.run, offset, estimated


def run_batch(
    sequence: Sequence,
    settings: Listing[Settings],
    programs: BatchPrograms,
    start: int = 0,
    count: int | None = None,
) -> list[RunResult]:
    """Run the parameter sets over a recording side by side; times are the batch's, divided by its size.

    Args:
        sequence: the recording, read once.
        settings: resolved, all alike in :func:`same_batch`.
        programs: of their recipe and config.
        start: first scan.
        count: number of scans; None: to the end.

    Raises:
        LioJaxError: no scan could be read.
    """
    check_start(sequence, start)
    began, compiled_s = time.perf_counter(), programs.compile_s
    first = settings[0]
    imu, imu_notes = imu_feed(sequence, first)
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[one.params() for one in settings])
    judges = [ResultBuilder(one) for one in settings]
    sinks: list[list[Sink]] = [
        [TrajectoryLog(), StageTimes("step", "total"), Failures(start), Overflow(one)] for one in settings
    ]
    scans: Any = prefetched(sequence.scans(start, count), first.run.data.prefetch)
    compiled, tracked = programs.compile_s, False
    for fed, state, output in run_steps(_BatchStep(programs, stacked), scan_inputs(first, scans, imu)):
        nav, seen = jax.device_get((state.nav, output))
        step_s = time.perf_counter() - fed.padded_at - (programs.compile_s - compiled)
        compiled = programs.compile_s
        tracked = True
        for number, (judged, own_sinks) in enumerate(zip(judges, sinks, strict=True)):
            own_nav, own = jax.tree.map(lambda leaf, number=number: leaf[number], (nav, seen))
            result = judged(fed, own_nav, own.registration, own, step_s * 1e3 / len(judges))
            for sink in own_sinks:
                sink.take(result)
    if not tracked:
        raise nothing_read(sequence)
    shared = {
        "compile_s": round((programs.compile_s - compiled_s) / len(settings), 4),
        "wall_s": round((time.perf_counter() - began) / len(settings), 4),
    }
    return [_finished(one, prediction(sequence, imu, imu_notes) | shared) for one in sinks]


def _finished(sinks: list[Sink], metrics: dict[str, Any]) -> RunResult:
    run = RunResult(metrics=metrics)
    finish_all(sinks, run)
    return run


class _BatchStep:
    """A :class:`lio_jax.run.track.Step` over a batch of states."""

    def __init__(self, programs: BatchPrograms, params: Any) -> None:
        self.initial_state = partial(programs.init, params)
        self._step = partial(programs.step, params)

    def restarted(self, state: Any, imu: Any) -> Any:
        return self.initial_state(imu).with_velocity_of(state)

    def __call__(self, state: Any, scan: Any, imu: Any) -> tuple[Any, Any]:
        return self._step(state, scan, imu)
