"""Read .npz files safely; write files atomically: under a temporary name in the same folder, then renamed."""

import fcntl
import os
import re
import secrets
import shutil
import struct
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_TOKEN_BYTES = 4
_DAMAGES = (KeyError, EOFError, MemoryError, RuntimeError, struct.error, zipfile.BadZipFile, zlib.error)
"""What a damaged .npz file may raise in addition to ValueError."""


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return all arrays of an .npz file by name; objects are never unpickled.

    Raises:
        OSError: the file can't be opened or read.
        ValueError: the file is damaged, or it is not an .npz file.
    """
    # opened here, because numpy leaves a damaged file open
    with path.open("rb") as opened:
        try:
            file = np.load(opened, allow_pickle=False)
            if isinstance(file, np.ndarray):
                raise ValueError("it holds one array and is no .npz archive")
            with file:
                return {name: file[name] for name in file.files}
        except _DAMAGES as error:
            raise ValueError(str(error) or type(error).__name__) from None


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of ``path``; rename it to ``path`` if the block raises nothing.

    The temporary path keeps the suffix, because some writers choose their format by it. It is removed if the
    block raises.
    """
    aside = aside_of(path)
    try:
        yield aside
        os.replace(aside, path)
    finally:
        aside.unlink(missing_ok=True)


def aside_of(path: Path) -> Path:
    """Return a hidden, unique name in the folder of ``path``."""
    return path.with_name(f".{path.stem}.{secrets.token_hex(_TOKEN_BYTES)}{path.suffix}")


def remove_leftovers(path: Path) -> None:
    """Remove the files and folders that interrupted writers of ``path`` left behind.

    They have a name of :func:`aside_of`. Folders whose lock is held are kept. Files have no lock, so the
    caller must know that no other process writes ``path``.
    """
    name = re.compile(rf"\.{re.escape(path.stem)}\.[0-9a-f]{{{2 * _TOKEN_BYTES}}}{re.escape(path.suffix)}")
    for entry in path.parent.iterdir():
        if name.fullmatch(entry.name):
            if entry.is_dir() and not entry.is_symlink():
                with folder_lock(entry) as free:
                    if free:
                        shutil.rmtree(entry, ignore_errors=True)
            else:
                entry.unlink(missing_ok=True)


@contextmanager
def folder_lock(folder: Path) -> Iterator[bool]:
    """Hold the folder's lock during the block; yield whether it was free.

    The system releases the lock when the process ends, also when it is killed. Where the file system supports
    no locks, the folder counts as free.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            free = True
        except BlockingIOError:
            free = False
        except OSError:
            free = True
        yield free
    finally:
        os.close(descriptor)
