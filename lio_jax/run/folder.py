"""The run folder: refuse to overwrite by accident, write every file whole."""

import json
from pathlib import Path
from typing import Any

from lio_jax.core.errors import UsageError
from lio_jax.core.files import atomic_path

RUN_FILES = (
    "trajectory.tum",
    "trajectory_kitti.txt",
    "states.npz",
    "map.pcd",
    "keyframes.g2o",
    "metrics.json",
    "config.yaml",
    "recording.rrd",
    "trajectory.png",
    "timings.png",
)
"""What a run may write."""


def prepare_folder(path: Path, overwrite: bool) -> None:
    """Make an empty run folder.

    With ``overwrite`` the files of an earlier run are removed and nothing else.

    Raises:
        UsageError: something is there already and ``overwrite`` is not set, or the folder cannot be made.
    """
    if path.is_file():
        raise UsageError(f"{path}: is a file; give a folder for the run's results.")
    if path.is_dir() and any(path.iterdir()) and not overwrite:
        raise UsageError(f"{path}: exists and is not empty; choose another folder or add --overwrite.")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: the folder cannot be made ({error.strerror}).") from None
    for name in RUN_FILES:
        (path / name).unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file whole or not at all."""
    with atomic_path(path) as aside:
        aside.write_text(text)


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write JSON (no NaN, no infinity) whole or not at all."""
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")
