"""The work of one worker: the runs of one recording and one static config, in order."""

import traceback
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from lio_jax.ablation.batch import run_batch, same_batch
from lio_jax.ablation.sources import KeptSequence, Source
from lio_jax.ablation.store import DiskError, Store, write_result
from lio_jax.ablation.tasks import Task
from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path
from lio_jax.data.config import DataConfig
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory, write_tum
from lio_jax.evaluation.evaluate import evaluate
from lio_jax.run.folder import write_json, write_text
from lio_jax.run.run import run_sequence, settings_for
from lio_jax.settings.settings import Settings

_KEPT = {"trajectory.tum", "metrics.json", "config.yaml"}
"""Files of a run folder that are kept if not everything is kept."""
_LARGEST_BATCH = 64
_NOT_WRITTEN = {"config.output.map": False, "config.output.recording": False, "config.output.plot": False}

WholeRun = Callable[[Sequence, Settings, Path, Source, Trajectory | None], dict[str, Any]]
"""Function that writes a whole run folder as ``lio-jax run`` does, and returns its metrics."""


def perform(tasks: tuple[Task, ...], store: Store, whole_run: WholeRun | None = None) -> None:
    """Leave each task done or failed in the store; tasks that are so already are not run again.

    Raises:
        DiskError: results can no longer be written.
    """
    left = [task for task in tasks if not store.is_done(task.key) and not store.has_failed(task.key)]
    if not left:
        return
    try:
        sequence, truth = _recording(left[0].source, left[0].source_key, left[0].settings.run.data)
    except Exception as error:
        for task in left:
            _fail(store, task, error)
        return
    for batch in _batches(left, sequence):
        if len(batch) > 1:
            _batched(batch, sequence, truth, store)
        else:
            _alone(batch[0], sequence, truth, store, whole_run)


@lru_cache(maxsize=1)
def _recording(source: Source, key: str, config: DataConfig) -> tuple[Sequence, Trajectory | None]:
    sequence = KeptSequence(source.open(config))
    return sequence, source.truth(sequence)


def _batches(tasks: list[Task], sequence: Sequence) -> Iterator[list[Task]]:
    """Yield the tasks that run in one program; on a CPU single tasks: a batch costs more than it saves."""
    import jax

    size = tasks[0].batch or (1 if jax.default_backend() == "cpu" else _LARGEST_BATCH)
    if size == 1 or tasks[0].keep == "everything" or tasks[0].settings.run.known_map.path:
        yield from ([task] for task in tasks)
        return
    groups: dict[Any, list[Task]] = {}
    for task in tasks:
        groups.setdefault(same_batch(task.settings), []).append(task)
    for group in groups.values():
        yield from (group[start : start + size] for start in range(0, len(group), size))


def _alone(
    task: Task, sequence: Sequence, truth: Trajectory | None, store: Store, whole_run: WholeRun | None
) -> None:
    try:
        with store.result(task.key) as folder:
            settings, _ = settings_for(sequence, task.settings)
            if task.keep == "everything" and whole_run is not None:
                metrics = whole_run(sequence, task.settings, folder, task.source, truth)
            else:
                settings = _without_pictures(settings)
                result = run_sequence(sequence, settings, folder, task.source.start, task.source.scans)
                if result.interruption is not None:
                    raise result.interruption
                metrics = _scored(result.metrics, result.trajectory, truth)
                for file in folder.iterdir():
                    if file.name not in _KEPT:
                        file.unlink()
            write_json(folder / "metrics.json", metrics)
            write_result(folder, task, settings, metrics, batch=1)
    except DiskError:
        raise
    except Exception as error:
        _fail(store, task, error)


def _batched(tasks: list[Task], sequence: Sequence, truth: Trajectory | None, store: Store) -> None:
    source = tasks[0].source
    try:
        settings = [_without_pictures(settings_for(sequence, task.settings)[0]) for task in tasks]
        runs = run_batch(sequence, settings, source.start, source.scans)
    except Exception as error:
        for task in tasks:
            _fail(store, task, error)
        return
    for task, own, run in zip(tasks, settings, runs, strict=True):
        try:
            if run.interruption is not None:
                raise run.interruption
            with store.result(task.key) as folder:
                with atomic_path(folder / "trajectory.tum") as aside:
                    write_tum(aside, run.trajectory)
                write_text(folder / "config.yaml", own.to_yaml())
                metrics = _scored(run.metrics, run.trajectory, truth)
                write_json(folder / "metrics.json", metrics)
                write_result(folder, task, own, metrics, len(tasks))
        except DiskError:
            raise
        except Exception as error:
            _fail(store, task, error)


def _scored(metrics: dict[str, Any], estimate: Trajectory, truth: Trajectory | None) -> dict[str, Any]:
    return metrics if truth is None else metrics | evaluate(estimate, truth).as_dict()


def _without_pictures(settings: Settings) -> Settings:
    for path, value in _NOT_WRITTEN.items():
        settings = settings.with_value(path, value, "ablation")
    return settings


def _fail(store: Store, task: Task, error: Exception) -> None:
    if isinstance(error, LioJaxError):
        store.fail(task.key, task.describe(), str(error))
    else:
        reason = " ".join(str(error).split()) or "no reason given"
        trace = "".join(traceback.format_exception(error))
        store.fail(task.key, task.describe(), f"unexpected {type(error).__name__}: {reason}.", trace)
