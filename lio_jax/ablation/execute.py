"""Run the tasks of an ablation: on worker processes, or in the calling process for a notebook."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

from lio_jax.ablation.cluster import Workers
from lio_jax.ablation.perform import perform
from lio_jax.ablation.ranking import Comparison, compare
from lio_jax.ablation.spec import load_spec
from lio_jax.ablation.store import Store, opened
from lio_jax.ablation.tasks import Task, pieces, tasks_of
from lio_jax.core.errors import LioJaxError
from lio_jax.data.whole_output import disk_errors_said
from lio_jax.run.folder import write_text

Perform = Callable[[tuple[Task, ...], Store], None]
"""Leaves each task done or failed in the store, in order."""
Progress = Callable[[int, int], None]
"""Told how many tasks are done, and how many have failed."""

_LOOK_EVERY_S = 0.5


def execute(
    workers: Workers,
    store: Store,
    tasks: Sequence[Task],
    perform: Perform,
    prepare: Callable[[], None],
    progress: Progress,
) -> None:
    """Return when every task is done or has failed.

    A worker that dies takes one run with it, which is begun again elsewhere; one that takes down worker after
    worker counts as failed.

    Args:
        workers: who does it.
        store: where results go.
        tasks: those that are done, or have failed, are left alone.
        perform: does some tasks in a worker; found there by its name.
        prepare: called in a worker before.
        progress: called twice a second.

    Raises:
        LioJaxError: nothing can be written any more.
    """
    from distributed import wait

    keys = [task.key for task in tasks]
    # workers may be at home elsewhere
    store = Store(store.root.resolve())
    deaths: Counter[str] = Counter()
    ended = _ended(store, keys)
    queue = deque(pieces([task for task in tasks if task.key not in ended], workers.count()))
    waiting: dict[Any, tuple[Task, ...]] = {}
    try:
        while queue or waiting:
            # no more than are worked on: a worker that dies must not be blamed on what only waits for it
            while queue and len(waiting) < max(1, workers.count()):
                piece = queue.popleft()
                future = workers.client.submit(_work, prepare, perform, piece, store, pure=False)
                waiting[future] = piece
            try:
                finished = wait(list(waiting), timeout=_LOOK_EVERY_S, return_when="FIRST_COMPLETED").done
            except TimeoutError:
                finished = set()
            except CancelledError:
                raise LioJaxError(
                    "the dask scheduler went away; the same command goes on from here."
                ) from None
            progress(len(store.done(keys)), len(store.failed(keys)))
            workers.revive()
            for future in finished:
                left = _left(store, waiting.pop(future), future)
                if left:
                    deaths[left[0].key] += 1
                    if deaths[left[0].key] > workers.deaths_allowed:
                        store.fail(left[0].key, left[0].describe(), _DIED)
                        left = left[1:]
                if left:
                    queue.appendleft(left)
        progress(len(store.done(keys)), len(store.failed(keys)))
    finally:
        workers.client.cancel(list(waiting), force=True)


def _left(store: Store, piece: tuple[Task, ...], future: Any) -> tuple[Task, ...]:
    """Return what is left of a piece because its worker died at the first of them."""
    from distributed import KilledWorker

    error = future.exception()
    if error is not None and not isinstance(error, KilledWorker):
        raise error
    ended = _ended(store, [task.key for task in piece])
    return tuple(task for task in piece if task.key not in ended)


_DIED = "the worker process died each time it was tried; most likely memory ran out (see the system's log)."
_one_at_a_time = threading.Lock()


def _work(prepare: Callable[[], None], perform: Perform, tasks: tuple[Task, ...], store: Store) -> None:
    # a worker with several threads would hold several maps at once
    with _one_at_a_time:
        prepare()
        perform(tasks, store)


def _ended(store: Store, keys: Sequence[str]) -> set[str]:
    return {*store.done(keys), *store.failed(keys)}


def run_ablation(spec_path: Path, out: Path) -> Comparison:
    """Run what a specification asks for, one run after the other, and compare.

    As ``lio-jax ablate`` does it, but with JAX as the caller has set it up. What ``out`` holds already is not
    run again.

    Args:
        spec_path: YAML file; see :mod:`lio_jax.ablation.spec`.
        out: folder of the results, new or of an earlier ablation.

    Raises:
        UsageError: the specification is wrong, or the folder is taken.
        LioJaxError: nothing can be written any more.
    """
    spec = load_spec(spec_path)
    tasks = tasks_of(spec)
    with opened(out) as store:
        with disk_errors_said(out / "spec.yaml"):
            write_text(out / "spec.yaml", spec.text)
        for piece in pieces(tasks, 1):
            perform(piece, store)
        return compare(spec, tasks, store)
