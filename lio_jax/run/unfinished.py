"""The mark of a run that has not come to its end: what a killed or interrupted run leaves in its folder.

While a run goes on, its folder holds ``unfinished.json`` (this mark), ``config.yaml`` (the run's settings),
``trajectory.tum`` (the poses so far) and the hidden folder of the journal (:mod:`lio_jax.run.journal`). The
mark and the journal are removed when the run has come to its end.
"""

import json
import shutil
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from lio_jax.core.errors import UsageError
from lio_jax.core.files import atomic_path
from lio_jax.data.sequence import Sequence
from lio_jax.settings.settings import Settings, load_settings

MARK = "unfinished.json"
JOURNAL = ".journal"
"""Hidden folder within the run folder."""
CONFIG, TRAJECTORY = "config.yaml", "trajectory.tum"
"""Files of a run that an unfinished one has already."""


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")


@dataclass(frozen=True)
class Unfinished:
    """What ``unfinished.json`` says of a run."""

    data: str
    """Path of the recording."""
    start: int
    """First scan."""
    count: int | None
    """Number of scans that were asked for; None: to the end."""
    scans: int = 0
    """Number of scans that a resumed run keeps: those before the last checkpoint."""
    since: str = field(default_factory=_now)
    """Date and time at which the run began, ISO 8601."""
    resume: str = "repeat the command of this run with --resume to go on"
    """What to type."""

    def write(self, folder: Path) -> None:
        """Write the mark into a run folder, complete or not at all."""
        with atomic_path(folder / MARK) as aside:
            aside.write_text(json.dumps(asdict(self), indent=2) + "\n")


def read_unfinished(folder: Path) -> Unfinished | None:
    """Return the mark in a run folder; None where there is none.

    Raises:
        UsageError: the mark is damaged.
    """
    path = folder / MARK
    try:
        return Unfinished(**json.loads(path.read_text()))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"{path}: cannot be read ({error}); add --overwrite to start anew.") from None


def finished_scans(folder: Path) -> int | None:
    """Return the number of scans of the finished run in a folder; None where there is none."""
    if (folder / MARK).exists():
        return None
    try:
        return int(json.loads((folder / "metrics.json").read_text())["scans"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def mark_unfinished(
    folder: Path, sequence: Sequence, settings: Settings, start: int, count: int | None
) -> Unfinished:
    """Return the mark of the run in a folder, and write it and the run's settings where there is none.

    Args:
        folder: of the run.
        sequence: the recording.
        settings: of the run, resolved.
        start: first scan.
        count: number of scans; None: to the end.

    Raises:
        UsageError: the folder's unfinished run is another one; the sentence says which setting differs.
    """
    mark = Unfinished(str(Path(sequence.info.path).resolve()), start, count)
    begun = read_unfinished(folder)
    if begun is not None:
        if difference := _difference(folder, begun, mark, settings):
            raise UsageError(
                f"{folder}: holds an unfinished run with other settings: {difference}; give the same ones "
                "with --resume, or --overwrite to start anew."
            )
        return begun
    with atomic_path(folder / CONFIG) as aside:
        aside.write_text(settings.to_yaml())
    mark.write(folder)
    return mark


def _difference(folder: Path, begun: Unfinished, mark: Unfinished, settings: Settings) -> str:
    """Return in words the first thing in which a run differs from the one begun, or ""."""
    for name, option in (("data", "DATA"), ("start", "--start"), ("count", "--scans")):
        before, now = getattr(begun, name), getattr(mark, name)
        if before != now:
            return _changed(option, before, now)
    kept = _by_path(load_settings(folder / CONFIG).as_dict())
    for path, now in _by_path(settings.as_dict()).items():
        if kept.get(path) != now:
            return _changed(path, kept.get(path), now)
    return ""


def _changed(name: str, before: Any, now: Any) -> str:
    return f"{name} was {before} and is now {now}"


def _by_path(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested values by their path, such as params.map.voxel_size."""
    leaves: dict[str, Any] = {}
    for name, value in tree.items():
        leaves |= _by_path(value, f"{prefix}{name}.") if isinstance(value, dict) else {prefix + name: value}
    return leaves


def remove_mark(folder: Path) -> None:
    """Remove the mark and the journal, and nothing else."""
    # the mark first: a folder without it is a finished run's, whatever hidden files are left
    (folder / MARK).unlink(missing_ok=True)
    remove_journal(folder)


def remove_journal(folder: Path) -> None:
    """Remove the journal's hidden folder."""
    if not (folder / JOURNAL).is_symlink():
        shutil.rmtree(folder / JOURNAL, ignore_errors=True)
