"""The recordings of an ablation: opened or simulated, and read once for several runs."""

import hashlib
import json
import os
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.data.config import DataConfig
from lio_jax.data.detect import open_sequence
from lio_jax.data.kitti import pose_files
from lio_jax.data.sequence import GpsData, ImuData, LidarScan, Sequence, SequenceInfo
from lio_jax.data.trajectory import Trajectory


@dataclass(frozen=True)
class Recorded:
    """A recording on disk. The estimator is deterministic, so no seed changes its result."""

    name: str
    path: str
    truth_file: str = ""
    """File with the true trajectory; "": the recording's own truth."""
    start: int = 0
    """Index of the first scan."""
    scans: int | None = None
    """Number of scans; None: to the end."""

    @property
    def seed(self) -> int | None:
        """None: nothing in the recording is random."""
        return None

    def identity(self) -> dict[str, Any]:
        """Return the properties that the result depends on: each file's name, size and time of change."""
        path = Path(self.path)
        files = sorted(entry for entry in path.rglob("*") if entry.is_file()) if path.is_dir() else [path]
        truths = [Path(self.truth_file)] if self.truth_file else pose_files(path)
        digest = hashlib.sha256()
        for file in [*files, *truths]:
            if file.exists():
                name = file.relative_to(path) if path in file.parents else file.name
                status = file.stat()
                digest.update(f"{name} {status.st_size} {status.st_mtime_ns}\n".encode())
        return {
            "files": digest.hexdigest(),
            "exists": path.exists(),
            "start": self.start,
            "scans": self.scans,
        }

    def open(self, config: DataConfig) -> Sequence:
        """Open the recording.

        Raises:
            LioJaxError: the recording is missing or broken.
        """
        return open_sequence(Path(self.path), config)

    def truth(self, sequence: Sequence) -> Trajectory | None:
        """Return the true T_world_imu; None where it is not known."""
        if not self.truth_file:
            return sequence.truth()
        from lio_jax.evaluation.load import load_trajectory

        loaded = load_trajectory(Path(self.truth_file))
        if not loaded.stamped:
            raise LioJaxError(f"{self.truth_file}: has no time stamps; give a TUM file as truth.")
        return loaded.trajectory


@dataclass(frozen=True)
class Simulated:
    """A drive through a simulated world."""

    name: str
    """Name of the recording without the seed."""
    sim: str
    """Name of the world."""
    seed: int = 0
    """Seed of world, motion and noise."""
    sensor: str = "generic32"
    duration: float = 10.0
    """Length of the recording, s."""
    beams: int | None = None
    columns: int | None = None
    imu: bool = True
    """Whether the recording has inertial samples."""
    moving_start: bool = False
    start: int = 0
    scans: int | None = None

    def identity(self) -> dict[str, Any]:
        """Return the properties that the result depends on."""
        return {key: value for key, value in asdict(self).items() if key != "name"}

    def open(self, config: DataConfig) -> Sequence:
        """Build the world."""
        from lio_jax.sim.imu import ImuModel
        from lio_jax.sim.sequence import SimulatedSequence

        return SimulatedSequence(
            self.sim,
            self.sensor,
            self.duration,
            self.seed,
            beams=self.beams,
            columns=self.columns,
            imu=ImuModel() if self.imu else None,
            moving_start=self.moving_start,
        )

    def truth(self, sequence: Sequence) -> Trajectory | None:
        """Return the true T_world_imu."""
        return sequence.truth()


Source = Recorded | Simulated

RECORDED_KEYS: dict[str, Any] = {"path": str, "name": str, "truth": str, "start": int, "scans": int}
SIMULATED_KEYS: dict[str, Any] = {
    "sim": str,
    "name": str,
    "sensor": str,
    "duration": float,
    "beams": int,
    "columns": int,
    "imu": bool,
    "moving_start": bool,
    "start": int,
    "scans": int,
}
"""Keys of an entry of ``sequences`` with ``sim``, and their types."""


def key_of(source: Source) -> str:
    """Return a hash of a recording's identity and name."""
    return hashlib.sha256(json.dumps([source.name, source.identity()]).encode()).hexdigest()[:16]


def recorded(entry: dict[str, Any], folder: Path, place: str) -> list[Recorded]:
    """Return the recordings of an entry with ``path``.

    ``~`` and ``$VARIABLES`` are replaced. As in a shell, ``{00..10}`` or ``{a,b}`` stands for several words.
    A truth file belongs to a single path, or there are as many truth files as paths.

    Args:
        entry: checked entry with the keys of RECORDED_KEYS.
        folder: folder in which relative paths start.
        place: file and key in messages.
    """
    paths = [_located(path, folder, place) for path in braces(entry["path"])]
    truths = [_located(path, folder, place) for path in braces(entry.get("truth") or "") if path]
    if truths and len(truths) != len(paths):
        raise UsageError(f"{place}: truth names {len(truths)} files for {len(paths)} recordings.")
    common = {key: entry[key] for key in ("start", "scans") if key in entry}
    sources = []
    for number, path in enumerate(paths):
        name = Path(path).name if len(paths) > 1 or "name" not in entry else entry["name"]
        if len(paths) > 1 and "name" in entry:
            name = f"{entry['name']}_{name}"
        sources.append(Recorded(name, path, truths[number] if truths else "", **common))
    return sources


def simulated(entry: dict[str, Any], seeds: tuple[int, ...], place: str) -> list[Simulated]:
    """Return an entry with ``sim`` once for each seed; ``entry`` is checked, with keys of SIMULATED_KEYS."""
    from lio_jax.sim.sensors import SENSORS
    from lio_jax.sim.sequence import WORLDS

    drive = Simulated(**{"name": entry["sim"], **entry})
    for kind, name, known in (("world", drive.sim, WORLDS), ("sensor", drive.sensor, SENSORS)):
        if name not in known:
            raise UsageError(
                f"{place}: {kind} '{name}' is unknown; choose one of: {', '.join(sorted(known))}."
            )
    return [replace(drive, seed=seed) for seed in seeds]


def braces(text: str) -> list[str]:
    """Return the words for which ``a{00..02}`` or ``a{x,y}`` stands, as in a shell."""
    found = re.search(r"\{([^{}]*(?:\.\.|,)[^{}]*)\}", text)
    if not found:
        return [text]
    inner = found.group(1)
    if bounds := re.fullmatch(r"(\d+)\.\.(\d+)", inner):
        width = len(bounds.group(1))
        words = [f"{n:0{width}d}" for n in range(int(bounds.group(1)), int(bounds.group(2)) + 1)]
    else:
        words = inner.split(",")
    before, after = text[: found.start()], text[found.end() :]
    return [whole for word in words for whole in braces(before + word + after)]


def _located(path: str, folder: Path, place: str) -> str:
    expanded = os.path.expandvars(os.path.expanduser(path))
    if unset := re.search(r"\$\{?(\w+)", expanded):
        raise UsageError(
            f"{place}: the environment variable {unset.group(1)} is not set; "
            f"set it, for example export {unset.group(1)}=/data/kitti."
        )
    # workers may have another working directory
    return os.path.abspath(folder / expanded)


KEPT_BYTES = 1 << 30
"""Most bytes that are kept; a larger recording is decoded again each time."""


class KeptSequence:
    """Replay another sequence; scans that were read before come from memory."""

    def __init__(self, sequence: Sequence, most_bytes: int = KEPT_BYTES) -> None:
        self._sequence = sequence
        self._room = most_bytes
        self._kept: dict[tuple[int, int | None], list[LidarScan]] = {}

    @property
    def info(self) -> SequenceInfo:
        """Return what is known without decoding scans."""
        return self._sequence.info

    @property
    def warnings_so_far(self) -> tuple[str, ...]:
        """Return one sentence for each problem met so far."""
        return self._sequence.warnings_so_far

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans ``start`` to ``start + count``."""
        part = (start, count)
        if part in self._kept:
            yield from self._kept[part]
            return
        read: list[LidarScan] = []
        size = 0
        for scan in self._sequence.scans(start, count):
            size += _bytes(scan)
            if size <= self._room:
                read.append(scan)
            else:
                read.clear()
            yield scan
        if size <= self._room:
            self._room -= size
            self._kept[part] = read

    def imu(self) -> ImuData | None:
        """Return all inertial samples, or None where there are none."""
        return self._sequence.imu()

    def gps(self) -> GpsData | None:
        """Return all GPS fixes, or None where there are none."""
        return self._sequence.gps()

    def truth(self) -> Trajectory | None:
        """Return the ground-truth T_world_imu, or None where there is none."""
        return self._sequence.truth()


def _bytes(scan: LidarScan) -> int:
    arrays: list[np.ndarray] = [scan.points, scan.time, scan.ring, scan.intensity]
    return sum(array.nbytes for array in arrays)
