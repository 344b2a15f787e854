"""Make files and folders appear under their name complete, or not at all."""

import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from lio_jax.core.errors import LioJaxError, UsageError
from lio_jax.core.files import aside_of, folder_lock, remove_leftovers

_KINDS = {"meta.yaml": "native recording", "metadata.yaml": "ROS 2 bag", "times.txt": "KITTI sequence"}


def check_free(path: Path, overwrite: bool, marker: str = "") -> None:
    """Refuse a path that exists already.

    Args:
        path: file or folder to be written.
        overwrite: whether a recording that is there may be replaced.
        marker: file that a folder must hold to be replaced; "": a file is to be written.

    Raises:
        UsageError: ``path`` exists and may not be replaced.
    """
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise UsageError(f"{path}: exists already; choose another path or allow overwriting (--overwrite).")
    if not marker:
        if path.is_dir():
            raise UsageError(f"{path}: is a folder, so no file is written there; choose another path.")
    elif not (path / marker).is_file():
        raise UsageError(f"{path}: is not a {_KINDS[marker]}, so it is not overwritten; choose another path.")


@contextmanager
def written_whole(path: Path, overwrite: bool = False, marker: str = "") -> Iterator[Path]:
    """Yield a path in a hidden folder next to ``path``; move the result into place if the block ends well.

    If the block ends early (an error, Ctrl-C, a full disk), neither ``path`` nor the hidden folder remains.
    The folder of a killed process is removed by the next process that writes ``path``.

    Args:
        path: the file or folder to write.
        overwrite, marker: as for :func:`check_free`.

    Raises:
        UsageError: ``path`` exists and may not be replaced.
        LioJaxError: the disk is full or cannot be written.
    """
    check_free(path, overwrite, marker)
    hidden = aside_of(path)
    try:
        with named_disk_errors(path, hidden), ExitStack() as held:
            hidden.mkdir(parents=True)
            # the lock shows the next writer that this process lives
            held.enter_context(folder_lock(hidden))
            remove_leftovers(path)
            yield hidden / path.name
            _put_in_place(hidden / path.name, path, hidden / "replaced")
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


@contextmanager
def named_disk_errors(path: Path, written: Path | None = None) -> Iterator[None]:
    """Turn the system's errors on writing ``path`` into one sentence.

    Args:
        path: the name of the output in the sentence.
        written: path that is written meanwhile; None: ``path``. Errors on other files are raised unchanged.

    Raises:
        LioJaxError: the block met an error of the file system.
    """
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        # an error in write(), for example on a full disk, names no file
        named = getattr(error, "filename", None)
        if named is not None and not str(named).startswith(str(written or path)):
            raise
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise LioJaxError(
            f"{path}: cannot be written ({reason}), nothing was left there; "
            "check its permissions and the free space."
        ) from error


def _put_in_place(made: Path, path: Path, old: Path) -> None:
    """Rename ``made`` to ``path``; a folder that exists there is first moved to ``old``."""
    if not path.is_dir():
        os.replace(made, path)
        return
    os.replace(path, old)
    try:
        os.replace(made, path)
    except BaseException:
        os.replace(old, path)
        raise
