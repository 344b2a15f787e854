"""Run the tasks of an ablation on worker processes, or in the calling process for a notebook."""

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError
from pathlib import Path
from typing import Any

from lio_jax.ablation.cluster import Workers
from lio_jax.ablation.perform import perform
from lio_jax.ablation.ranking import VariantComparison, compare
from lio_jax.ablation.spec import load_spec
from lio_jax.ablation.store import Store, opened
from lio_jax.ablation.tasks import Task, pieces, tasks_of
from lio_jax.core.errors import LioJaxError
from lio_jax.data.whole_output import named_disk_errors
from lio_jax.run.folder import write_text

Perform = Callable[[tuple[Task, ...], Store], None]
"""Function that runs tasks in order and leaves each one done or failed in the store."""
Progress = Callable[[int, int], None]
"""Function that receives the numbers of finished and of failed tasks."""

_LOOK_EVERY_S = 0.5


def execute(
    workers: Workers,
    store: Store,
    tasks: Sequence[Task],
    perform: Perform,
    prepare: Callable[[], None],
    progress: Progress,
) -> None:
    """Run the tasks, and return when every task is done or has failed.

    If a worker dies during a run, the run starts again on another worker. A run that ends several workers
    counts as failed.

    Args:
        workers: the workers.
        store: the folder of the results.
        tasks: all tasks; those that are done, or have failed, are not run.
        perform: function that runs tasks in a worker; it must be importable there.
        prepare: function that is called in a worker first.
        progress: function that is called twice a second.

    Raises:
        LioJaxError: results can no longer be written.
    """
    from distributed import wait

    keys = [task.key for task in tasks]
    # workers may have another working directory
    store = Store(store.root.resolve())
    deaths: Counter[str] = Counter()
    ended = _ended(store, keys)
    queue = deque(pieces([task for task in tasks if task.key not in ended], workers.count()))
    waiting: dict[Any, tuple[Task, ...]] = {}
    try:
        while queue or waiting:
            # only as many as the workers run at once: a death must not be attributed to a waiting task
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
    """Return the remaining tasks of a piece whose worker died during one of them."""
    from distributed import KilledWorker

    error = future.exception()
    if error is not None and not isinstance(error, KilledWorker):
        raise error
    ended = _ended(store, [task.key for task in piece])
    return tuple(task for task in piece if task.key not in ended)


_DIED = "the worker process died each time it was tried; most likely memory ran out (see the system's log)."
_one_at_a_time = threading.Lock()


def _work(prepare: Callable[[], None], perform: Perform, tasks: tuple[Task, ...], store: Store) -> None:
    # only one thread of a worker runs: several would hold several maps in memory
    with _one_at_a_time:
        prepare()
        perform(tasks, store)


def _ended(store: Store, keys: Sequence[str]) -> set[str]:
    return {*store.done(keys), *store.failed(keys)}


def run_ablation(spec_path: Path, out: Path) -> VariantComparison:
    """Run the ablation of a specification, one run after the other, and compare the results.

    It works like ``lio-jax ablate``, with JAX as the caller has set it up. Runs whose results are in ``out``
    already are not repeated.

    Args:
        spec_path: YAML file; see :mod:`lio_jax.ablation.spec`.
        out: folder of the results, new or from an earlier ablation.

    Raises:
        UsageError: the specification is wrong, or the folder is taken.
        LioJaxError: results can no longer be written.
    """
    spec = load_spec(spec_path)
    tasks = tasks_of(spec)
    with opened(out) as store:
        with named_disk_errors(out / "spec.yaml"):
            write_text(out / "spec.yaml", spec.text)
        for piece in pieces(tasks, 1):
            perform(piece, store)
        return compare(spec, tasks, store)
