"""An ablation whose runs take a moment and leave two files; also a command, to be killed."""

import os
import sys
import time
from pathlib import Path

from lio_jax.ablation.cluster import on_this_machine
from lio_jax.ablation.execute import execute
from lio_jax.ablation.sources import Recorded
from lio_jax.ablation.store import opened
from lio_jax.ablation.tasks import Task
from lio_jax.ablation.variants import Variant
from lio_jax.settings.settings import Settings

RECORDINGS, VARIANTS = 4, 12
TAKES_S = 0.06
LINES = 200


def tasks():
    """Return runs of a few recordings, each of which is one piece of work."""
    settings = Settings()
    return [
        Task(
            Recorded(f"r{recording}", "none"),
            Variant(f"v{variant}", {}, settings),
            "trajectory",
            None,
            f"r{recording}v{variant:02d}",
            f"r{recording}",
        )
        for recording in range(RECORDINGS)
        for variant in range(VARIANTS)
    ]


def content(key):
    return f"{key}\n" * LINES


def nothing():
    """Stand for what a worker needs before its first run."""


def perform(pieces, store):
    """Write two halves with a pause in between: a kill likely falls between them."""
    for task in pieces:
        if store.is_done(task.key):
            continue
        with store.result(task.key) as folder:
            (folder / "first.txt").write_text(content(task.key))
            time.sleep(TAKES_S)
            (folder / "second.txt").write_text(content(task.key))


POISON = "r1v03"


def poisoned(pieces, store):
    """Take the worker process down at one of the runs."""
    for task in pieces:
        if task.key == POISON:
            os._exit(9)
        perform((task,), store)


def run(root, work=perform):
    with opened(root) as store, on_this_machine(2) as workers:
        # as --retry-failed does: a run whose worker was killed four times counts as failed
        store.forget_failures(store.failed([task.key for task in tasks()]))
        execute(workers, store, tasks(), work, nothing, lambda done, failed: None)


if __name__ == "__main__":
    run(Path(sys.argv[1]))
