"""The journal of a run, from which a run that was killed goes on.

What a run leaves is a function of the stream of its scans' results, and that stream is a function of the
recording and of the outputs of the recipe's steps. Only these outputs and the recipe's state are therefore
stored:

- the **journal** holds for every scan the navigation state and the output of its step, one record behind the
  other. A thread writes each record as soon as the step is done, so that a killed process loses none that is
  written;
- a **checkpoint** holds the recipe's state after one of these scans. It is written every ten seconds and
  replaces the one before. The journal reaches the disk before it, so that it also holds after a power loss.

A resumed run reads the recording from its first scan on. Up to the checkpoint it takes each step's output
from the journal instead of computing it: scans are decoded and padded again, and failures, the map, the logs,
the back end and a user's own sinks are built again by the code that built them first. Hence nothing of them
has to be stored, and nothing of them can differ. From the checkpoint on, steps are computed again. On the
same machine with the same versions, the results are equal to the bit.
"""

import os
import queue
import threading
import time
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError
from lio_jax.core.files import atomic_path, remove_leftovers
from lio_jax.data.sequence import Sequence
from lio_jax.data.trajectory import Trajectory, pose_matrices, tum_lines
from lio_jax.run.record import Record, read_record
from lio_jax.run.unfinished import (
    CONFIG,
    JOURNAL,
    TRAJECTORY,
    Unfinished,
    mark_unfinished,
    read_unfinished,
    remove_journal,
    remove_mark,
)
from lio_jax.settings.settings import Settings

CHECKPOINT_EVERY_S = 10.0
"""Time between two checkpoints, s: a killed run computes at most that much again."""
POSES_AT_ONCE = 10
"""Number of poses that are appended to trajectory.tum at once, which takes a fifth of the time."""
_WAITING = 32
"""Number of results that may wait for the disk; beyond that the run waits."""
_RESULTS, _CHECKPOINT = "results", "checkpoint"


class Structured(Protocol):
    """Compiled steps that know the structure of what they return."""

    def structures(self, before: Any, scan: Any, imu: Any) -> tuple[Any, Any]:
        """Return state and output after a first scan, each leaf with its shape and dtype alone."""
        ...


class Fed(Protocol):
    """One scan as a step takes it; see :class:`lio_jax.run.scan_inputs.ScanInput`."""

    @property
    def end_ns(self) -> int:
        """The scan's end, ns."""
        ...

    @property
    def pad_ms(self) -> float:
        """Time of its padding, ms."""
        ...


_Fed = TypeVar("_Fed", bound=Any)


class Journal:
    """Stores the steps of a run as they are done, and gives back those of a killed one."""

    def __init__(self, folder: Path, mark: Unfinished) -> None:
        """Open the journal in a run folder or begin one; steps behind the last checkpoint are dropped.

        Args:
            folder: of the run, held by this process.
            mark: of the run; it is written again at each checkpoint.
        """
        self._folder, self._mark = folder, mark
        self.error: Exception | None = None
        """What ended the journal early, for example a full disk; the run itself goes on without it."""
        self.problem = ""
        """Why nothing of an unfinished run can be kept."""
        self._checkpoint = self._read_checkpoint()
        self.scans = 0 if self._checkpoint is None else int(self._checkpoint.values["scans"])
        """Number of scans whose steps are stored."""
        self._size = 0 if self._checkpoint is None else int(self._checkpoint.values["bytes"])
        if self._mark.scans != self.scans:
            self._mark = replace(self._mark, scans=self.scans)
            self._mark.write(folder)
        if self._checkpoint is None:
            remove_journal(folder)
        (folder / JOURNAL).mkdir(exist_ok=True)
        remove_leftovers(self._path(_CHECKPOINT))
        # unbuffered: what is written outlives the process
        self._file = self._path(_RESULTS).open("ab", buffering=0)
        self._file.truncate(self._size)
        self._poses = (folder / TRAJECTORY).open("wb", buffering=0)
        self._unwritten: list[tuple[int, NDArray[Any]]] = []
        self.state: Any = None
        """The recipe's state after the stored steps, once they were replayed; None where there are none."""
        self.count = 0
        """Number of scans so far."""
        self._last_s = time.monotonic()
        self._pending = False
        self._waiting: queue.Queue[Callable[[], None] | None] = queue.Queue(_WAITING)
        # a daemon: a disk that hangs must not keep the process from its end
        self._thread = threading.Thread(target=self._work, name="journal", daemon=True)
        self._thread.start()

    def replayed(self, step: Structured, inputs: Iterator[_Fed]) -> Generator[tuple[_Fed, Any, Any, float]]:
        """Yield each stored step: its scan, navigation state, output (numpy leaves) and time, ms.

        Args:
            step: of the run's recipe.
            inputs: the run's scans from the first one on; those of the stored steps are taken.

        Raises:
            LioJaxError: the journal is damaged, or the recording or the recipe is not that of the journal.
        """
        if self._checkpoint is None:
            return
        structures: tuple[Any, Any] | None = None
        with self._path(_RESULTS).open("rb") as file:
            for number in range(self.scans):
                kept = self._read_step(file)
                fed = next(inputs, None)
                if fed is None or fed.end_ns != kept.values["end_ns"]:
                    raise LioJaxError(
                        f"{self._mark.data}: scan {self._mark.start + number} is not the one that the "
                        f"unfinished run in {self._folder} has read; add --overwrite to start anew."
                    )
                if structures is None:
                    structures = step.structures(fed.before, fed.scan, fed.imu)
                state, output = structures
                leaves = len(jax.tree.leaves(state.nav))
                # copies: whoever keeps the navigation state must not keep the whole record by it
                nav = self._filled(state.nav, [np.array(array) for array in kept.arrays[:leaves]], False)
                self._append_pose(fed.end_ns, nav)
                self.count += 1
                output = self._filled(output, kept.arrays[leaves:], False)
                yield replace(fed, pad_ms=kept.values["pad_ms"]), nav, output, kept.values["step_ms"]
        assert structures is not None
        # copies: the device must own what the next step consumes
        self._write_poses()
        self.state = self._filled(structures[0], [jnp.array(leaf) for leaf in self._checkpoint.arrays], True)
        self._checkpoint = None
        self._last_s = time.monotonic()

    def add(self, fed: Fed, nav: Any, output: Any, step_ms: float, state: Any | None) -> None:
        """Store a step; this waits only where the disk is slower than the run.

        Args:
            fed: the scan.
            nav: navigation state after it, numpy leaves.
            output: the recipe's output.
            step_ms: time of the step.
            state: the recipe's state after the scan, not consumed yet; None where no run can go on from it.
        """
        if self.error is not None:
            return
        values = {"end_ns": int(fed.end_ns), "pad_ms": float(fed.pad_ms), "step_ms": float(step_ms)}
        self.count += 1
        self._waiting.put(lambda: self._write_step(values, nav, output))
        due = time.monotonic() - self._last_s >= CHECKPOINT_EVERY_S
        # one at a time: on a slow disk their copies would fill the memory
        if state is not None and due and not self._pending:
            self._pending = True
            scans, leaves = self.count, [np.array(leaf) for leaf in jax.tree.leaves(state)]
            self._waiting.put(lambda: self._write_checkpoint(scans, leaves))
            self._last_s = time.monotonic()

    def warnings(self) -> list[str]:
        """Return a sentence if the journal ended early."""
        if self.error is None:
            return []
        kind = type(self.error).__name__
        return [f"the journal ended early ({kind}: {self.error}); --resume would have started the run anew."]

    def close(self) -> None:
        """Write what waits and release the files; a journal without a checkpoint is of no use and removed."""
        if self._thread.is_alive():
            self._waiting.put(None)
            self._thread.join()
        self._file.close()
        self._poses.close()
        if self._mark.scans == 0:
            remove_journal(self._folder)

    def remove(self) -> None:
        """Close the journal and remove it and the mark: the run has come to its end, or has not begun."""
        self.close()
        remove_mark(self._folder)

    def _path(self, name: str) -> Path:
        return self._folder / JOURNAL / name

    def _read_checkpoint(self) -> Record | None:
        """Return the last checkpoint; None where there is none that the journal covers."""
        try:
            with self._path(_CHECKPOINT).open("rb") as file:
                found = read_record(file)
            if self._path(_RESULTS).stat().st_size >= found.values["bytes"]:
                return found
            self.problem = "its journal is shorter than its checkpoint says"
        except FileNotFoundError:
            self.problem = "it has no checkpoint yet"
        except (OSError, ValueError) as error:
            self.problem = f"its checkpoint cannot be used: {error}"
        return None

    def _read_step(self, file: BinaryIO) -> Record:
        try:
            return read_record(file)
        except (OSError, ValueError) as error:
            raise LioJaxError(
                f"{self._path(_RESULTS)}: cannot be used ({error}); add --overwrite to start anew."
            ) from None

    def _filled(self, structure: Any, arrays: list[Any], exact: bool) -> Any:
        """Return a tree of the arrays, in the structure of another tree.

        Args:
            structure: tree whose leaves have a shape and a dtype.
            arrays: one for each leaf.
            exact: whether shapes must agree; those of outputs follow the padded size of a scan.
        """
        leaves, tree = jax.tree.flatten(structure)
        fits = len(leaves) == len(arrays) and all(
            leaf.dtype == array.dtype and (leaf.shape == array.shape or not exact)
            for leaf, array in zip(leaves, arrays, strict=True)
        )
        if not fits:
            raise LioJaxError(
                f"{self._folder}: its unfinished run was left by another version of the program or of the "
                "recipe; add --overwrite to start anew."
            )
        return jax.tree.unflatten(tree, arrays)

    def _work(self) -> None:
        while (job := self._waiting.get()) is not None:
            if self.error is None:
                try:
                    job()
                except Exception as error:
                    self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        """Stop storing, and leave the room on the disk to the run's results."""
        self.error = error
        self._mark = replace(self._mark, scans=0)
        remove_journal(self._folder)
        with suppress(OSError):
            self._mark.write(self._folder)

    def _write_step(self, values: dict[str, Any], nav: Any, output: Any) -> None:
        arrays = [np.asarray(leaf) for leaf in jax.tree.leaves((nav, output))]
        self._size += _written(self._file, Record(values, arrays).as_bytes())
        self._append_pose(values["end_ns"], nav)

    def _append_pose(self, end_ns: int, nav: Any) -> None:
        self._unwritten.append((end_ns, np.asarray(nav.T_world_imu.wxyz_xyz)))
        if len(self._unwritten) >= POSES_AT_ONCE:
            self._write_poses()

    def _write_poses(self) -> None:
        """Append the poses that wait to trajectory.tum; whole lines, so that it can be read at any time."""
        if self._unwritten:
            stamps, rows = zip(*self._unwritten, strict=True)
            wxyz_xyz = np.stack(rows)
            poses = pose_matrices(wxyz_xyz[:, 4:], wxyz_xyz[:, [1, 2, 3, 0]])
            _written(self._poses, tum_lines(Trajectory(np.array(stamps, np.int64), poses)).encode())
            self._unwritten.clear()

    def _write_checkpoint(self, scans: int, leaves: list[NDArray[Any]]) -> None:
        self._write_poses()
        # the journal must be on the disk before the checkpoint that relies on it
        os.fsync(self._file.fileno())
        with atomic_path(self._path(_CHECKPOINT)) as aside, aside.open("wb") as file:
            file.write(Record({"scans": scans, "bytes": self._size}, leaves).as_bytes())
            file.flush()
            os.fsync(file.fileno())
        folder = os.open(self._folder / JOURNAL, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
        self._mark = replace(self._mark, scans=scans)
        self._mark.write(self._folder)
        self._pending = False


@contextmanager
def opened_journal(
    folder: Path,
    sequence: Sequence,
    settings: Settings,
    start: int = 0,
    count: int | None = None,
    notify: Callable[[str], None] | None = None,
) -> Iterator[Journal]:
    """Open the journal of a run for the block, and mark the folder as that of an unfinished run.

    Whoever uses it removes the journal (:meth:`Journal.remove`) when the run has come to its end. A run that
    has read no scan leaves neither mark nor journal.

    Args:
        folder: of the run; it exists. An unfinished run in it is gone on with.
        sequence: the recording.
        settings: of the run, resolved.
        start: first scan.
        count: number of scans; None: to the end.
        notify: takes a sentence that says where an unfinished run goes on.

    Raises:
        UsageError: the folder's unfinished run has other settings; the sentence says which one differs.
    """
    begun = read_unfinished(folder) is not None
    journal = Journal(folder, mark_unfinished(folder, sequence, settings, start, count))
    if begun and notify is not None:
        notify(
            f"note: the unfinished run goes on after its first {journal.scans} scans."
            if journal.scans
            else f"note: nothing of the unfinished run can be kept ({journal.problem}); it starts anew."
        )
    try:
        yield journal
    finally:
        journal.close()
        if not journal.count and not begun:
            journal.remove()
            for name in (CONFIG, TRAJECTORY):
                (folder / name).unlink(missing_ok=True)


def _written(file: Any, data: bytes) -> int:
    """Write all bytes to an unbuffered file, which may take a part at a time; return their number."""
    rest = memoryview(data)
    while rest:
        rest = rest[file.write(rest) :]
    return len(data)
