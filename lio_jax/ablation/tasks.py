"""The runs of an ablation, each with a key: a hash of everything that its result depends on."""

import hashlib
import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from lio_jax.ablation.sources import Source, key_of
from lio_jax.ablation.spec import Spec
from lio_jax.ablation.variants import Variant
from lio_jax.recipes import source_hash
from lio_jax.settings.settings import Settings

_FORMAT = 1
"""Version of the files that a task leaves; another number runs everything again."""
_CODE = (
    *("core", "imu", "lidar", "mapping", "pose_graph", "registration", "estimation", "loops"),
    *("recipes", "data", "sim", "settings", "run", "evaluation"),
)
"""Packages of the code that a run's result depends on."""


@dataclass(frozen=True)
class Task:
    """One run: a recording with one set of settings."""

    source: Source
    variant: Variant = field(hash=False)
    keep: str
    batch: int | None
    """Number of parameter sets in one program; the result does not depend on it."""
    key: str
    """Hash of the recording's identity, the settings, the kept files and the code."""
    source_key: str

    @property
    def settings(self) -> Settings:
        """Return the settings before the recording adds its own."""
        return self.variant.settings

    def describe(self) -> str:
        """Return a line that describes the task to the user."""
        seed = "" if self.source.seed is None else f" seed {self.source.seed}"
        return f"{self.source.name}{seed}, {self.variant.name}"


def tasks_of(spec: Spec) -> list[Task]:
    """Return every recording with every variant, recording by recording."""
    tasks = []
    for source in spec.sources:
        source_key = key_of(source)
        for variant in spec.variants:
            identity = [
                _FORMAT,
                source_key,
                spec.keep,
                variant.settings.as_dict(),
                sorted(variant.settings.given),
                code_version(),
                source_hash(variant.settings.recipe),
            ]
            key = hashlib.sha256(json.dumps(identity, sort_keys=True).encode()).hexdigest()[:20]
            tasks.append(Task(source, variant, spec.keep, spec.batch, key, source_key))
    return tasks


@cache
def code_version() -> str:
    """Return a hash of the code that results depend on, and of JAX's version."""
    package = Path(__file__).parents[1]
    digest = hashlib.sha256(f"jax {version('jax')} jaxlib {version('jaxlib')}".encode())
    for name in _CODE:
        for file in sorted((package / name).rglob("*.py")):
            digest.update(str(file.relative_to(package)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:20]


def pieces(tasks: Iterable[Task], workers: int) -> list[tuple[Task, ...]]:
    """Group the tasks that one worker does in order.

    Tasks with the same recording and static config share compiled programs and decoded scans. A group is
    split only if other workers would have nothing to do.
    """
    groups: dict[Any, list[Task]] = {}
    tasks = list(tasks)
    for task in tasks:
        groups.setdefault((task.source_key, task.settings.recipe, task.settings.config), []).append(task)
    longest = -(-len(tasks) // max(workers, 1))
    return [
        tuple(group[start : start + longest])
        for group in groups.values()
        for start in range(0, len(group), longest)
    ]
