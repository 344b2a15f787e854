"""One row per run, in Parquet: the resolved settings and every number of metrics.json."""

import dataclasses
import json
import platform
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lio_jax.ablation.spec import numbers_in
from lio_jax.ablation.store import Store
from lio_jax.ablation.tasks import Task, code_version
from lio_jax.core.files import atomic_path
from lio_jax.run.folder import processor, usable_cores, write_json
from lio_jax.settings.settings import Settings

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
