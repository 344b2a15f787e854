"""Open ROS 1 and ROS 2 bags through rosbags, and say in one sentence why one cannot be read."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lio_jax.core.errors import LioJaxError
from lio_jax.data.static_transforms import register_type

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_MAGIC = {".bag": b"#ROSBAG V", ".mcap": b"\x89MCAP0\r\n", ".db3": b"SQLite format 3\x00"}


def bag_paths(path: Path) -> tuple[Path, ...]:
    """Return what rosbags has to open: a bag file, a ROS 2 folder, or all split files of one recording.

    Raises:
        LioJaxError: there is no bag at ``path``, or one that was never finished.
    """
    if not path.exists():
        raise LioJaxError(
            f"{path}: no such file or folder; give a ROS bag (.bag, .mcap, .db3 or a bag folder)."
        )
    if path.is_dir():
        if (path / "metadata.yaml").exists():
            return (path,)
        for suffix in _MAGIC:
            if files := sorted(file for file in path.glob(f"*{suffix}") if file.is_file()):
                _check_magic(files)
                return tuple(files)
        if active := sorted(path.glob("*.bag.active")):
            raise LioJaxError(_unfinished(active[0], "it is still marked active"))
        raise LioJaxError(
            f"{path}: holds neither metadata.yaml nor .bag, .mcap or .db3 files, so it is no ROS bag."
        )
    if path.name == "metadata.yaml":
        return (path.parent,)
    if path.suffix == ".active":
        raise LioJaxError(_unfinished(path, "it is still marked active"))
    if path.suffix not in _MAGIC:
        raise LioJaxError(
            f"{path}: not a ROS bag; one ends in .bag, .mcap or .db3, or is a folder with metadata.yaml."
        )
    _check_magic([path])
    return (path,)


@contextmanager
def open_bag(paths: Sequence[Path]) -> Iterator["AnyReader"]:
    """Open the files of one recording as a rosbags AnyReader and close them at the end of the block.

    Raises:
        LioJaxError: a file is damaged, unfinished or of a kind that rosbags cannot read.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    typestore = get_typestore(Stores.ROS2_HUMBLE)
    register_type(typestore)
    try:
        reader = AnyReader(list(paths), default_typestore=typestore)
        reader.open()
    # Damaged files make the index and codec libraries raise whatever they stumble over.
    except Exception as error:
        raise LioJaxError(_why_unreadable(paths, error)) from error
    try:
        yield reader
    finally:
        reader.close()


def until_damage(messages: Iterator[Any], report: Callable[[str], None]) -> Iterator[Any]:
    """Yield messages; where the bag turns out to be damaged, report the reason and end."""
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        # As on opening: rosbags, sqlite, lz4 and zstd each raise their own kinds on damaged data.
        except Exception as error:
            report(_reason(error))
            return
        yield message


def _check_magic(files: Sequence[Path]) -> None:
    for file in files:
        magic = _MAGIC[file.suffix]
        try:
            with file.open("rb") as stream:
                head = stream.read(len(magic))
        except OSError as error:
            raise LioJaxError(
                f"{file}: cannot be read ({error.strerror}); check the file and its permissions."
            ) from None
        if not head:
            raise LioJaxError(f"{file}: is empty (0 bytes); record or copy the bag again.")
        if head != magic:
            raise LioJaxError(
                f"{file}: not a ROS bag, although its name ends in {file.suffix}; check where it came from."
            )


def _why_unreadable(paths: Sequence[Path], error: Exception) -> str:
    """Find the file at fault by opening each one alone."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    for path in paths:
        try:
            with Reader1(path) if path.suffix == ".bag" else Reader2(path):
                pass
        except Exception as alone:
            reason = _reason(alone)
            if "not supported" in reason or "nsupported" in reason:
                return (
                    f"{path}: this kind of bag cannot be read ({reason}); convert it with 'rosbags-convert'."
                )
            if "missing" in reason and "files" in reason:
                return f"{path}: the bag folder is incomplete ({reason}); copy the missing files into it."
            return _unfinished(path, reason)
    return f"{paths[0]}: its message definitions cannot be understood ({_reason(error)}); remove that topic."


def _unfinished(path: Path, reason: str) -> str:
    if path.suffix in (".bag", ".active"):
        remedy = f"run 'rosbag reindex {path.name}'"
    elif path.suffix == ".mcap":
        remedy = f"run 'mcap recover {path.name}' or 'ros2 bag reindex' on its folder"
    else:
        remedy = f"run 'ros2 bag reindex {path.name if path.is_dir() else path.parent.name}'"
    return (
        f"{path}: the bag was not closed properly or is truncated ({reason}); {remedy}, or record it again."
    )


def _reason(error: Exception) -> str:
    text = " ".join(str(error).split()).rstrip(".")
    return text or f"unexpected {type(error).__name__}"
