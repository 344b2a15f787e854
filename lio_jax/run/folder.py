"""A run's folder: its files, how it is held and written, and the environment that it records."""

import json
import os
import platform
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import jax

from lio_jax.core.errors import UsageError
from lio_jax.core.files import atomic_path, folder_lock, remove_leftovers
from lio_jax.run.keyframes import remove_keyframes
from lio_jax.run.map_file import SPOOL_SUFFIX, TILES_PREFIX
from lio_jax.run.scan_clouds import remove_clouds
from lio_jax.run.unfinished import CONFIG, MARK, TRAJECTORY, read_unfinished, remove_journal, remove_mark

_LIBRARIES = ("lio-jax", "jax", "jaxlib", "numpy", "scipy")


def environment() -> dict[str, str]:
    """Return versions, processor and devices by name, for comparisons of times and for repetitions."""
    devices = sorted({f"{device.platform}: {device.device_kind}" for device in jax.devices()})
    return {
        **{name: _version(name) for name in _LIBRARIES},
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": processor(),
        "cores": str(usable_cores()),
        "devices": ", ".join(devices),
        "double precision": "on" if jax.config.read("jax_enable_x64") else "off",
    }


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def usable_cores() -> int:
    """Return the number of cores that the process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def processor() -> str:
    """Return the processor's name."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or "unknown"


RUN_FILES = (
    "trajectory.tum",
    "trajectory_kitti.txt",
    "odometry.tum",
    "online.tum",
    "loops.json",
    "georeference.json",
    "imu_rate.tum",
    "states.npz",
    "scans.npz",
    "truth.tum",
    "map.pcd",
    "keyframes.g2o",
    "metrics.json",
    "config.yaml",
    "recording.rrd",
    "trajectory.png",
    "timings.png",
    "report.html",
)
"""Files that a run may write, besides its keyframes and clouds."""

_SPOOL = f"map{SPOOL_SUFFIX}"


@contextmanager
def run_folder(path: Path, overwrite: bool, resume: bool = False) -> Iterator[None]:
    """Hold an empty run folder during the block; a folder made for it that stays empty is removed again.

    With ``overwrite`` the files of an earlier run are removed, and nothing else. The hidden files of a killed
    run are removed in every case, except for its journal.

    Args:
        path: of the folder.
        overwrite: whether an earlier run may be replaced.
        resume: whether the folder may hold an unfinished run; what that needs to go on stays.

    Raises:
        UsageError: the folder is not empty and neither option allows that, another run is writing there, or
            the folder cannot be made.
    """
    if path.is_file():
        raise UsageError(f"{path}: is a file; give a folder for the run's results.")
    made = not path.exists()
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{path}: the folder cannot be made ({error.strerror}).") from None
    try:
        with folder_lock(path) as free:
            if not free:
                raise UsageError(f"{path}: another run is writing there; choose another folder.")
            _make_empty(path, overwrite, resume)
            yield
    finally:
        if made:
            with suppress(OSError):  # the folder holds results
                path.rmdir()


def _make_empty(path: Path, overwrite: bool, resume: bool) -> None:
    for name in (*RUN_FILES, _SPOOL, MARK):
        remove_leftovers(path / name)
    for tiles in path.glob(f"{TILES_PREFIX}*"):
        shutil.rmtree(tiles, ignore_errors=True)
    remove_keyframes(path, unfinished_only=True)
    remove_clouds(path, unfinished_only=True)
    begun = None if overwrite else read_unfinished(path)
    if begun is not None and not resume:
        raise UsageError(
            f"{path}: holds an unfinished run of {begun.scans} scans; add --resume to go on or --overwrite "
            "to start anew."
        )
    if begun is None:
        remove_journal(path)
        if any(path.iterdir()) and not overwrite:
            raise UsageError(f"{path}: exists and is not empty; choose another folder or add --overwrite.")
        remove_mark(path)
    for name in RUN_FILES:
        if begun is None or name not in (CONFIG, TRAJECTORY):
            (path / name).unlink(missing_ok=True)
    remove_keyframes(path)
    # an unfinished run writes them again: its last file may hold only a part of its scans
    remove_clouds(path)


def write_text(path: Path, text: str) -> None:
    """Write a text file, complete or not at all."""
    with atomic_path(path) as aside:
        aside.write_text(text)


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write JSON without NaN and infinity, complete or not at all."""
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")
