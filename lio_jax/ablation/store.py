"""The folder of an ablation: one subfolder a task, results as parquet and a manifest, written once."""

import dataclasses
import errno
import json
import platform
import shutil
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lio_jax.ablation.spec import numbers_in
from lio_jax.ablation.tasks import Task, code_version
from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import atomic_path, folder_lock
from lio_jax.data.whole_output import named_disk_errors, written_whole
from lio_jax.run.folder import processor, usable_cores, write_json
from lio_jax.settings.settings import Settings


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
        with _disk_errors(), named_disk_errors(path):
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


if TYPE_CHECKING:
    import pyarrow as pa

ROW, MANIFEST = "result.parquet", "manifest.json"


def write_result(
    folder: Path, task: Task, settings: Settings, metrics: Mapping[str, Any], batch: int
) -> None:
    """Write a run's row and manifest.

    Args:
        folder: folder of the run.
        task: the requested run.
        settings: settings after the recording has added its own.
        metrics: contents of metrics.json, including errors against truth.
        batch: number of parameter sets that ran in one program.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    named = {
        "key": task.key,
        "sequence": task.source.name,
        "seed": task.source.seed,
        "variant": task.variant.name,
        "overrides": json.dumps(task.variant.overrides),
        "recipe": settings.recipe,
    }
    row = named | _flat_settings(settings) | numbers_in(metrics)
    types = {"seed": pa.int64()}
    columns = {name: pa.array([value], types.get(name)) for name, value in row.items()}
    with atomic_path(folder / ROW) as aside:
        pq.write_table(pa.table(columns), aside)
    write_json(folder / MANIFEST, _manifest(task, settings, metrics, batch))


def gathered(store: Store, tasks: Iterable[Task], columns: Iterable[str]) -> "pa.Table":
    """Return columns of all finished tasks, in the order of ``tasks``; values that a run lacks are null.

    Only these columns are read. The names come from the tasks themselves, because another specification may
    name the same run differently.
    """
    import pyarrow as pa
    import pyarrow.dataset as ds
    import pyarrow.parquet as pq

    tasks = list(tasks)
    done = set(store.done(task.key for task in tasks))
    finished = [task for task in tasks if task.key in done]
    files = [str(store.folder(task.key) / ROW) for task in finished]
    wanted = list(dict.fromkeys(columns))
    names: dict[str, Any] = {
        "key": [task.key for task in finished],
        "sequence": [task.source.name for task in finished],
        "seed": pa.array([task.source.seed for task in finished], pa.int64()),
        "variant": [task.variant.name for task in finished],
    }
    table = pa.table(names)
    if not files:
        return table
    schema = pa.unify_schemas([pq.read_schema(file) for file in files])
    read = ds.dataset(files, schema=schema, format="parquet").to_table(
        columns=["key", *(name for name in wanted if name in schema.names and name not in names)]
    )
    place = {key: index for index, key in enumerate(read["key"].to_pylist())}
    read = read.take([place[task.key] for task in finished])
    for name in wanted:
        if name not in names:
            column = read[name] if name in read.column_names else pa.nulls(len(finished), pa.float64())
            table = table.append_column(name, column)
    return table


def _flat_settings(settings: Settings) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for group in dataclasses.fields(settings.config):
        for leaf, value in dataclasses.asdict(getattr(settings.config, group.name)).items():
            flat[f"config.{group.name}.{leaf}"] = list(value) if isinstance(value, tuple) else value
    for section, leaves in settings.values.items():
        for leaf, value in leaves.items():
            flat[f"params.{section}.{leaf}"] = (
                [*map(float, value)] if isinstance(value, list) else float(value)
            )
    return flat


def _manifest(task: Task, settings: Settings, metrics: Mapping[str, Any], batch: int) -> dict[str, Any]:
    import jax

    devices = jax.devices()
    return {
        "key": task.key,
        "sequence": {"name": task.source.name, "seed": task.source.seed} | task.source.identity(),
        "variant": task.variant.name,
        "overrides": task.variant.overrides,
        "given": sorted(settings.given),
        "code": code_version(),
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in ("lio-jax", "jax", "jaxlib", "numpy")},
        },
        "hardware": {
            "machine": platform.machine(),
            "processor": processor(),
            "cores": usable_cores(),
            "devices": [device.device_kind for device in devices],
        },
        "timings": {name: metrics.get(name) for name in ("compile_s", "wall_s", "scan_ms")},
        "batch": batch,
    }
