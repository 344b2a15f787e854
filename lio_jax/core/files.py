"""Read text, YAML and .npz files safely; write files atomically: under a temporary name, then renamed."""

import fcntl
import os
import re
import secrets
import shutil
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from lio_jax.core.errors import LioJaxError

_TOKEN_BYTES = 4
_DAMAGES = (
    KeyError,
    EOFError,
    MemoryError,
    RuntimeError,
    struct.error,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What a damaged .npz file may raise in addition to ValueError."""
_MOST_NODES = 100_000
"""Largest number of values in a YAML text, with aliases written out: a few lines can stand for billions."""
_MOST_CHARACTERS = 1_000_000
"""Longest YAML text: a longer one takes a minute or more to read."""
_MOST_DIGITS = 1_000
"""Longest number in a YAML text: the time to read one grows with the square of its length."""
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
_UNPACKED_BYTES, _UNPACKED_RATIO = 1 << 28, 100
"""Arrays may fill so many bytes, or so many times the size of their .npz file, whichever is more: a file of
megabytes can unpack to all the memory there is."""


def read_text(path: Path, remedy: str, error: type[LioJaxError] = LioJaxError) -> str:
    """Return the text of a file in UTF-8, without the byte order mark that some editors put before it.

    Args:
        path: path of the file.
        remedy: what to do if it is no text, the end of a sentence without its point.
        error: class of the error.

    Raises:
        OSError: the file can't be opened or read.
        LioJaxError: the file is not in UTF-8; it is of the class ``error``.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise error(f"{path}: is not a text file; {remedy}.") from None


def parse_yaml(text: str) -> Any:
    """Return the value that a YAML text holds.

    Raises:
        ValueError: it is not YAML, is too long, or its aliases stand for too many values; the message is one
            line.
    """
    if len(text) > _MOST_CHARACTERS:
        raise ValueError(f"it is longer than {_MOST_CHARACTERS} characters")
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        # counted before values are made: a merge key (<<) copies what its aliases stand for
        if _checked_size(node, {}) > _MOST_NODES:
            raise ValueError("it holds too many values")
        return None if node is None else loader.construct_document(node)
    except RecursionError:
        raise ValueError("it is nested too deeply, or within itself") from None
    except yaml.YAMLError as error:
        raise ValueError(" ".join(str(error).split())) from None
    # yaml reads tagged values such as !!timestamp 9 by functions that raise exceptions of many kinds
    except Exception as error:
        raise ValueError(f"a value cannot be read: {' '.join(str(error).split())}") from None


class _Loader(yaml.SafeLoader):
    """Stops in the middle of a text that holds too many values."""

    _composed = 0

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        self._composed += 1
        if self._composed > _MOST_NODES:
            raise ValueError("it holds too many values")
        return super().compose_node(parent, index)


def _checked_size(node: yaml.Node | None, known: dict[int, int]) -> int:
    """Return the number of values in a tree, counting what an alias repeats each time.

    Raises:
        ValueError: a number has too many digits.
    """
    if node is None:
        return 0
    if id(node) not in known:
        if node.tag in _NUMBERS and len(node.value) > _MOST_DIGITS:
            raise ValueError(f"a number of {len(node.value)} characters")
        children: list[yaml.Node] = []
        if isinstance(node, yaml.MappingNode):
            children = [one for pair in node.value for one in pair]
        elif isinstance(node, yaml.SequenceNode):
            children = node.value
        known[id(node)] = 1 + sum(_checked_size(child, known) for child in children)
    return known[id(node)]


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
                _check_unpacked(file.zip, path.stat().st_size)
                return {name: file[name] for name in file.files}
        except _DAMAGES as error:
            raise ValueError(str(error) or "it is damaged") from None


def _check_unpacked(archive: zipfile.ZipFile, size: int) -> None:
    """Refuse an archive of ``size`` bytes whose arrays would fill far more memory than that.

    Raises:
        ValueError: it is such an archive.
    """
    # zipfile reads no more of a member than its entry states
    unpacked = sum(entry.file_size for entry in archive.infolist())
    if unpacked > max(_UNPACKED_BYTES, _UNPACKED_RATIO * size):
        raise ValueError(f"its {size} bytes would unpack to {unpacked}, as no recording does")


def array_of(
    arrays: dict[str, NDArray[Any]], name: str, shape: tuple[int | None, ...], kinds: str = "fiu"
) -> NDArray[Any]:
    """Return one array of a file if it is of the form that its reader expects.

    Args:
        arrays: all arrays of the file.
        name: name of the wanted one.
        shape: wanted size along each axis; None: any size.
        kinds: accepted kinds of number, as in ``dtype.kind``.

    Raises:
        ValueError: it is missing, or has another shape or another type.
    """
    if name not in arrays:
        raise ValueError(f"it lacks {name}")
    array = arrays[name]
    fits = len(array.shape) == len(shape) and all(
        wanted in (None, size) for wanted, size in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in kinds:
        numbers = "whole numbers" if kinds == "iu" else "numbers"
        sizes = ", ".join("n" if size is None else str(size) for size in shape)
        raise ValueError(f"{name} is an array {array.shape} of {array.dtype}, not ({sizes}) of {numbers}")
    return array


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary path in the folder of ``path``; rename it to ``path`` if the block raises nothing.

    The temporary path keeps the suffix, because some writers choose their format by it. It is removed if the
    block raises.

    Raises:
        OSError: the block met an error of the file system; if that named no file, as on a full disk, it names
            ``path``.
    """
    aside = aside_of(path)
    try:
        yield aside
        os.replace(aside, path)
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(aside), aside):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error
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
