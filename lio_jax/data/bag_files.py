"""The files and topics of a bag, and the parts of a ROS message that all readers share."""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from lio_jax.core.errors import LioJaxError
from lio_jax.data.decompression import limit_rosbags
from lio_jax.data.static_transforms import register_type

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader


class RosHeader(NamedTuple):
    """Stamp of a message, and the place where its body starts."""

    stamp_ns: int
    body: int
    """Offset of the first byte after the header (not yet aligned)."""
    order: str
    """Byte order of the message, "<" or ">"."""


def read_header(raw: bytes, ros2: bool) -> RosHeader:
    """Read the header of a raw message: ROS 1 serialisation, or ROS 2 CDR with its 4-byte encapsulation.

    Raises:
        ValueError: the message is shorter than its header.
    """
    try:
        # ROS 1 counts messages in a uint32 where CDR has its encapsulation: the stamp lies at byte 4 in both.
        order = ">" if ros2 and not raw[1] & 1 else "<"
        seconds, nanoseconds, length = struct.unpack_from(f"{order}{'i' if ros2 else 'I'}II", raw, 4)
    except (struct.error, IndexError):
        raise ValueError(f"a message of {len(raw)} bytes holds no header") from None
    return RosHeader(seconds * 1_000_000_000 + nanoseconds, 16 + length, order)


def read_frame(raw: bytes, ros2: bool) -> str:
    """Return the frame that the header of a raw message names.

    Raises:
        ValueError: the message is shorter than its header.
    """
    # CDR ends strings with a zero byte
    return raw[16 : read_header(raw, ros2).body].rstrip(b"\0").decode(errors="replace")


def cdr_aligned(offset: int, size: int) -> int:
    """Return the first offset at or after ``offset`` where CDR places a value of ``size`` bytes."""
    return 4 + -(-(offset - 4) // size) * size


@dataclass(frozen=True)
class Topic:
    """One topic of a bag with one message type."""

    name: str
    type: str
    count: int
    """Number of messages."""


@dataclass(frozen=True)
class BagContents:
    """What a bag's index states, without decoding any scan."""

    topics: tuple[Topic, ...]
    lidar: Topic
    """The topic whose clouds are read."""
    imu: Topic | None
    point_fields: tuple[str, ...]
    """Name and type of each field of a point, taken from the first cloud."""
    size_bytes: int
    """Total size of the bag's files, bytes."""
    start_ns: int
    """When the first message was received, ns."""
    end_ns: int
    """When the last message was received, ns."""


def bag_topics(connections: Iterable[Any]) -> tuple[Topic, ...]:
    """Sum a bag's connections by topic and type, sorted by name."""
    counts: dict[tuple[str, str], int] = {}
    for connection in connections:
        key = (connection.topic, connection.msgtype)
        counts[key] = counts.get(key, 0) + connection.msgcount
    return tuple(Topic(*key, count) for key, count in sorted(counts.items()))


def listed(topics: Iterable[Topic]) -> str:
    """Write topics with type and number of messages, separated by commas."""
    return ", ".join(f"{topic.name} ({topic.type}, {topic.count})" for topic in topics)


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
    """Open the files of one recording as a rosbags AnyReader, and close them at the end of the block.

    Raises:
        LioJaxError: a file is damaged, unfinished or of a kind that rosbags cannot read.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    typestore = get_typestore(Stores.ROS2_HUMBLE)
    register_type(typestore)
    limit_rosbags()
    try:
        reader = AnyReader(list(paths), default_typestore=typestore)
        reader.open()
    # On damaged files the index and codec libraries raise many kinds of exceptions.
    except Exception as error:
        raise LioJaxError(_why_unreadable(paths, error)) from error
    try:
        # a damaged table of a database may hold anything in place of text
        if not all(isinstance(one.topic, str) and isinstance(one.msgtype, str) for one in reader.connections):
            raise LioJaxError(_unfinished(paths[0], "its list of topics is damaged"))
        yield reader
    finally:
        reader.close()


def until_damage(messages: Iterator[Any], report: Callable[[str], None]) -> Iterator[Any]:
    """Yield messages; if the bag turns out to be damaged, report the reason and stop."""
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        # As on opening: rosbags, sqlite, lz4 and zstd raise exceptions of different kinds on damaged data.
        except Exception as error:
            report(why(error))
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
    """Return a sentence that names the file at fault, which is found by opening each file alone."""
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

    for path in paths:
        try:
            with Reader1(path) if path.suffix == ".bag" else Reader2(path):
                pass
        except Exception as alone:
            reason = why(alone)
            if "not supported" in reason or "nsupported" in reason:
                return (
                    f"{path}: this kind of bag cannot be read ({reason}); convert it with 'rosbags-convert'."
                )
            if "missing" in reason and "files" in reason:
                return f"{path}: the bag folder is incomplete ({reason}); copy the missing files into it."
            return _unfinished(path, reason)
    return f"{paths[0]}: its message definitions cannot be understood ({why(error)}); remove that topic."


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


_LONGEST_REASON = 200


def why(error: Exception) -> str:
    """Return in a few words why rosbags or a library below it gave up; it ends without a point."""
    if isinstance(error, MemoryError | OverflowError):
        return "a damaged length asks for more memory than there is"
    text = " ".join(str(error).split()).rstrip(".")
    # a missing key's message is the bare key
    if not text or isinstance(error, KeyError | AssertionError):
        return "its records contradict each other"
    return text if len(text) <= _LONGEST_REASON else f"{text[:_LONGEST_REASON]} ..."
