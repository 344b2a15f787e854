"""The folder of an ablation, the only record of its results and of its failures with their reasons.

spec.yaml             as of the last command
tasks/KEY/            one finished run, complete or absent:
    result.parquet    one row: settings and metrics
    manifest.json     the run's settings, versions of packages, and machine
    trajectory.tum  metrics.json  config.yaml
failed/KEY.json       why a run failed
report.html
"""

import errno
import json
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import folder_lock
from lio_jax.data.whole_output import disk_errors_said, written_whole
from lio_jax.run.folder import write_json


class DiskError(LioJaxError):
    """Results can no longer be written, so no further run is worth starting."""


@dataclass(frozen=True)
class Store:
    """The results of tasks by their keys."""

    root: Path

    def folder(self, key: str) -> Path:
        """Return the folder of a task's result, whether it exists or not."""
        return self.root / "tasks" / key

    def is_done(self, key: str) -> bool:
        """Return whether the task's result exists."""
        return self.folder(key).is_dir()

    def done(self, keys: Iterable[str]) -> list[str]:
        """Return the keys that are done, from one listing of the folder."""
        there = _names(self.root / "tasks")
        return [key for key in keys if key in there]

    def failed(self, keys: Iterable[str]) -> list[str]:
        """Return the keys that failed, from one listing of the folder."""
        failed, done = _names(self.root / "failed"), _names(self.root / "tasks")
        return [key for key in keys if f"{key}.json" in failed and key not in done]

    def reason(self, key: str) -> dict[str, str]:
        """Return the record of a task that failed: run, reason, traceback."""
        record: dict[str, str] = json.loads((self.root / "failed" / f"{key}.json").read_text())
        return record

    def has_failed(self, key: str) -> bool:
        """Return whether the task failed."""
        return (self.root / "failed" / f"{key}.json").is_file()

    @contextmanager
    def result(self, key: str) -> Iterator[Path]:
        """Yield a hidden folder that becomes the task's result if the block ends without an exception.

        Raises:
            DiskError: the disk is full or cannot be written.
        """
        with _disk_errors(), written_whole(self.folder(key)) as folder:
            folder.mkdir()
            yield folder

    def fail(self, key: str, run: str, reason: str, traceback: str = "") -> None:
        """Record why a task failed."""
        path = self.root / "failed" / f"{key}.json"
        with _disk_errors(), disk_errors_said(path):
            path.parent.mkdir(exist_ok=True)
            write_json(path, {"run": run, "reason": reason, "traceback": traceback})

    def forget_failures(self, keys: Iterable[str]) -> None:
        """Remove the records of failures, so that the tasks are tried again."""
        for key in keys:
            (self.root / "failed" / f"{key}.json").unlink(missing_ok=True)


@contextmanager
def opened(root: Path) -> Iterator[Store]:
    """Hold an ablation's folder during the block, so that no other command uses it.

    Remains of killed runs are removed.

    Raises:
        UsageError: it is a file, cannot be made, holds something else, or is in use by another command.
    """
    if root.is_file():
        raise UsageError(f"{root}: is a file; give a folder for the ablation's results.")
    if root.is_dir() and (names := _names(root)) and not names & _OURS:
        raise UsageError(f"{root}: holds something else than an ablation; choose another folder.")
    try:
        (root / "tasks").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{root}: the folder cannot be made ({error.strerror}).") from None
    with folder_lock(root) as free:
        if not free:
            raise UsageError(
                f"{root}: another lio-jax ablate is at work there; wait for it, or choose another folder."
            )
        for entry in (root / "tasks").iterdir():
            if entry.name.startswith("."):
                with folder_lock(entry) as left:
                    if left:
                        shutil.rmtree(entry, ignore_errors=True)
        yield Store(root)


_OURS = {"tasks", "spec.yaml"}


def _names(folder: Path) -> set[str]:
    return {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()


_NO_MORE = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


@contextmanager
def _disk_errors() -> Iterator[None]:
    try:
        yield
    except LioJaxError as error:
        if getattr(error.__cause__, "errno", None) in _NO_MORE:
            raise DiskError(str(error)) from error
        raise
