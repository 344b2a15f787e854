"""Choose the reader of a recording by the layout of its path."""

from dataclasses import fields
from pathlib import Path

from lio_jax.core.errors import LioJaxError
from lio_jax.data import (
    clouds,
    evalio_sequences,
    kitti,
    kitti_raw,
    native,
    ouster_pcap,
    rosbag,
    velodyne_pcap,
)
from lio_jax.data.config import DataConfig
from lio_jax.data.sequence import Reader, Sequence, entries

READERS = (
    kitti.READER,
    kitti_raw.READER,
    native.READER,
    rosbag.READER,
    velodyne_pcap.READER,
    ouster_pcap.READER,
    clouds.READER,
)
"""Readers of files; the first one that recognises a path opens it. A new format is a module and an entry."""
BY_NAME = evalio_sequences.READER
"""The reader of sequences that are no path."""

_BY_THE_RUN = {"prefetch"}
"""Fields that a run reads itself, whatever the format."""
_SEARCH_DEPTH = 3
_NAMED_AT_MOST = 12


def open_sequence(path: Path | str, config: DataConfig | None = None) -> Sequence:
    """Open the recording at ``path`` with the reader that fits its layout.

    Args:
        path: a KITTI odometry sequence folder, a KITTI raw drive folder, a ROS 1 or ROS 2 bag, a native
            folder, a packet capture, or a folder of clouds; or ``evalio:DATASET/SEQUENCE``, a sequence that
            evalio knows.
        config: how the recording is read; None: the defaults, which recognise everything from the data.

    Raises:
        LioJaxError: nothing is there, the layout is not known, or the reader finds it broken.
    """
    path = Path(path)
    config = DataConfig() if config is None else config
    if BY_NAME.recognises(path):
        return BY_NAME.open(path, config)
    if not path.exists():
        raise LioJaxError(f"{path}: no such file or folder; check the path.")
    reader = _reader_of(path)
    if reader is None:
        raise LioJaxError(_unknown(path))
    return reader.open(path, config)


def without_effect(format_name: str, config: DataConfig) -> list[str]:
    """Return the fields of ``config`` that differ from their defaults and that a format's reader never reads.

    Args:
        format_name: ``SequenceInfo.format``; the result is empty for one that no reader has.
        config: how the recording is read.
    """
    reads = next((reader.reads for reader in (*READERS, BY_NAME) if reader.name == format_name), None)
    if reads is None:
        return []
    unread = [field for field in fields(config) if field.name not in reads | _BY_THE_RUN]
    return [field.name for field in unread if getattr(config, field.name) != field.default]


def _reader_of(path: Path) -> Reader | None:
    """Return the reader that takes ``path``, None where no reader does."""
    return next((reader for reader in READERS if reader.recognises(path)), None)


def _looked_for() -> str:
    return ", ".join(reader.called for reader in READERS)


def _unknown(path: Path) -> str:
    for parent in path.resolve().parents[:2]:
        reader = _reader_of(parent)
        if reader is not None and reader.has_parts:
            return f"{path}: is a part of a recording; give the recording's folder, {parent}."
    if path.is_file():
        return f"{path}: not a recording that can be read; looked for {_looked_for()}."
    if not entries(path):
        return f"{path}: the folder is empty; give {_looked_for()}."
    if inside := _recordings_inside(path, _SEARCH_DEPTH):
        names = ", ".join(str(found.relative_to(path)) for found in inside[:_NAMED_AT_MOST])
        more = f" and {len(inside) - _NAMED_AT_MOST} more" if len(inside) > _NAMED_AT_MOST else ""
        return f"{path}: is not a recording itself; give one of those inside it: {names}{more}."
    return f"{path}: the layout is not known; looked for {_looked_for()}."


def _recordings_inside(folder: Path, depth: int) -> list[Path]:
    found: list[Path] = []
    for entry in entries(folder):
        if _reader_of(entry) is not None:
            found.append(entry)
        elif depth > 1 and entry.is_dir():
            found.extend(_recordings_inside(entry, depth - 1))
    return found
