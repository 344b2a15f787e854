"""``lio-jax ablate``: many unattended runs, and a fair comparison of them."""

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import partial
from pathlib import Path
from typing import Any

from tqdm import tqdm

from lio_jax.ablation.cluster import at_scheduler, on_this_machine
from lio_jax.ablation.execute import execute
from lio_jax.ablation.perform import perform
from lio_jax.ablation.ranking import as_text, compare
from lio_jax.ablation.report import write_report
from lio_jax.ablation.sources import Source
from lio_jax.ablation.spec import Spec, load_spec
from lio_jax.ablation.store import Store, opened
from lio_jax.ablation.tasks import Task, tasks_of
from lio_jax.commands.run import run_into
from lio_jax.commands.runtime import prepare_jax, say
from lio_jax.core.errors import LioJaxError
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory
from lio_jax.data.whole_output import named_disk_errors
from lio_jax.run.folder import write_text
from lio_jax.settings.settings import Settings


def ablate(spec_path: Path, out: Path, scheduler: str, report: bool, retry_failed: bool) -> None:
    """Run an ablation from the command line, or continue one.

    Raises:
        UsageError: the specification is wrong, the folder is taken, or no scheduler answers.
        LioJaxError: some runs failed, or the command was interrupted; finished runs are kept.
    """
    spec = load_spec(spec_path)
    tasks = tasks_of(spec)
    keys = [task.key for task in tasks]
    with opened(out) as store:
        with named_disk_errors(out / "spec.yaml"):
            write_text(out / "spec.yaml", spec.text)
        if retry_failed:
            store.forget_failures(store.failed(keys))
        done = len(store.done(keys))
        left = len(tasks) - done - len(store.failed(keys))
        say(
            f"{len(spec.sources)} recordings x {len(spec.variants)} variants: {len(tasks)} runs, {done} done."
        )
        try:
            if left:
                _execute(store, tasks, left, scheduler)
        except KeyboardInterrupt:
            raise LioJaxError(
                f"interrupted: {len(store.done(keys))} of {len(tasks)} runs are done; "
                "the same command goes on from there."
            ) from None
        _conclude(spec, tasks, store, report)


def whole_run(
    sequence: Sequence, settings: Settings, out: Path, source: Source, truth: Trajectory | None
) -> dict[str, Any]:
    """Write all files of ``lio-jax run`` to ``out``, its messages to run.log, and return its metrics."""
    with (out / "run.log").open("w") as log, redirect_stdout(log), redirect_stderr(log):
        return run_into(sequence, settings, out, source.start, source.scans, truth).metrics


def _execute(store: Store, tasks: list[Task], left: int, scheduler: str) -> None:
    workers = at_scheduler(scheduler) if scheduler else on_this_machine(left)
    with workers as ready, _progress(len(tasks), len(tasks) - left) as progress:
        job = partial(perform, whole_run=whole_run)
        execute(ready, store, tasks, job, prepare_jax, progress)


def _conclude(spec: Spec, tasks: list[Task], store: Store, report: bool) -> None:
    comparison = compare(spec, tasks, store)
    page = store.root / "report.html"
    if report:
        with named_disk_errors(page):
            write_report(comparison, store)
    print(as_text(comparison))
    print(f"\nruns       {store.root / 'tasks'}")
    if report:
        print(f"report     {page}")
    failures = list(comparison.failures.values())
    for record in failures[:_REASONS_SHOWN]:
        say(f"failed: {record['run']}: {record['reason']}")
    if failures:
        raise LioJaxError(
            f"{len(failures)} of {len(tasks)} runs failed ({store.root / 'failed'} holds the reasons); "
            "--retry-failed tries them again."
        )


_REASONS_SHOWN = 5
_REPORT_EVERY = 0.1


@contextmanager
def _progress(total: int, ended: int) -> Iterator[Callable[[int, int], None]]:
    """Yield a function that shows the progress: a bar on a terminal, else a line after every tenth of it."""
    if sys.stderr.isatty():
        with tqdm(total=total, initial=ended, unit="run") as bar:

            def show(done: int, failed: int) -> None:
                bar.set_postfix({"failed": failed} if failed else {}, refresh=False)
                bar.update(done + failed - bar.n)
                bar.refresh()

            yield show
        return
    began, reported = time.monotonic(), ended

    def tell(done: int, failed: int) -> None:
        nonlocal reported
        now = done + failed
        if now - reported < _REPORT_EVERY * total and not (now == total > reported):
            return
        reported = now
        left_s = (time.monotonic() - began) / max(now - ended, 1) * (total - now)
        say(f"{now} of {total} runs ended, {failed} failed, about {_duration(left_s)} left")

    yield tell


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes} min" if hours else f"{minutes} min {rest} s" if minutes else f"{rest} s"
