"""Files and folders of a recording appear under their name complete, or not at all."""

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
    """Refuse a path that is taken.

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
    """Yield a path in a hidden folder beside ``path``; move what was made there into place if all went well.

    Whatever ends the block early (an error, Ctrl-C, a full disk) leaves neither ``path`` nor that folder; the
    folder of a killed process is removed by the next one that writes ``path``.

    Args:
        path: of the file or folder.
        overwrite, marker: as for :func:`check_free`.

    Raises:
        UsageError: ``path`` exists and may not be replaced.
        LioJaxError: the disk takes no more.
    """
    check_free(path, overwrite, marker)
    hidden = aside_of(path)
    try:
        with disk_errors_said(path, hidden), ExitStack() as held:
            hidden.mkdir(parents=True)
            # tells the next writer that this one lives
            held.enter_context(folder_lock(hidden))
            remove_leftovers(path)
            yield hidden / path.name
            _put_in_place(hidden / path.name, path, hidden / "replaced")
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


@contextmanager
def disk_errors_said(path: Path, written: Path | None = None) -> Iterator[None]:
    """Turn what the system says about writing ``path`` into one sentence.

    Args:
        path: how the sentence calls what is written.
        written: where it is written for now; None: at ``path``. Errors about other files pass as they are.

    Raises:
        LioJaxError: the block met an error of the file system.
    """
    try:
        yield
    except (OSError, sqlite3.Error) as error:
        # a full disk is met in write(), which names no file
        named = getattr(error, "filename", None)
        if named is not None and not str(named).startswith(str(written or path)):
            raise
        reason = getattr(error, "strerror", None) or " ".join(str(error).split()) or type(error).__name__
        raise LioJaxError(
            f"{path}: cannot be written ({reason}), nothing was left there; "
            "check its permissions and the free space."
        ) from error


def _put_in_place(made: Path, path: Path, old: Path) -> None:
    """Rename ``made`` to ``path``; a folder cannot be renamed onto, so one that is there moves to ``old``."""
    if not path.is_dir():
        os.replace(made, path)
        return
    os.replace(path, old)
    try:
        os.replace(made, path)
    except BaseException:
        os.replace(old, path)
        raise
