"""Decompression of the chunks of a bag, up to a largest size.

rosbags decompresses whatever a chunk holds: some kilobytes can be gigabytes of zeros. It offers no limit, so
its tables of decompressors get functions here that stop at one.
"""

import os
from collections.abc import Callable
from io import BufferedIOBase
from types import SimpleNamespace
from typing import BinaryIO, Protocol

MOST_BYTES = 1 << 29
"""Largest chunk or message, bytes when decompressed: tens of times the largest cloud."""
_MOST_RATIO = 100
"""Largest size of a compressed bag file when decompressed, relative to its own, above :data:`MOST_BYTES`."""


class _Decompressor(Protocol):
    @property
    def eof(self) -> bool: ...

    @property
    def unused_data(self) -> bytes: ...

    def decompress(self, data: bytes, max_length: int, /) -> bytes: ...


def limited(make: Callable[[], _Decompressor], data: bytes) -> bytes:
    """Return the decompressed bytes of one or several frames.

    Args:
        make: function that makes a decompressor for one frame.
        data: the compressed bytes.

    Raises:
        ValueError: they decompress to more than :data:`MOST_BYTES`.
        EOFError: the last frame is cut off.
    """
    parts: list[bytes] = []
    left = MOST_BYTES
    while True:
        frame = make()
        try:
            part = frame.decompress(data, left + 1)
        except Exception:
            if parts:
                # bytes after the last frame, which are ignored by the library's own functions, too
                break
            raise
        if len(part) > left:
            raise ValueError(f"compressed data that would take more than {MOST_BYTES} bytes")
        if not frame.eof:
            raise EOFError("compressed data that is cut off")
        parts.append(part)
        left -= len(part)
        data = frame.unused_data or b""
        if not data:
            break
    return b"".join(parts)


def limit_rosbags() -> None:
    """Let rosbags decompress by :func:`limited`, in this process and from now on."""
    from bz2 import BZ2Decompressor

    from lz4.frame import LZ4FrameDecompressor
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap

    zstd = storage_mcap.zstd
    by_name: dict[str, Callable[..., bytes]] = {
        "bz2": lambda data, *_: limited(BZ2Decompressor, data),
        "lz4": lambda data, *_: limited(LZ4FrameDecompressor, data),
        "zstd": lambda data, *_: limited(zstd.ZstdDecompressor, data),
    }
    for table in (ros1.decompressors, storage_mcap.DECOMPRESSORS):
        table.update({name: function for name, function in by_name.items() if name in table})
    vars(ros2)["zstd"] = SimpleNamespace(
        decompress=by_name["zstd"], open=lambda file, mode: _LimitedFile(file, zstd.open(file, mode))
    )


class _LimitedFile:
    """A compressed file opened for reading, which stops at a limit."""

    def __init__(self, file: BinaryIO, opened: BufferedIOBase) -> None:
        self._opened = opened
        self._left = max(MOST_BYTES, _MOST_RATIO * os.fstat(file.fileno()).st_size)

    def read(self, size: int = -1) -> bytes:
        data = self._opened.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise ValueError("compressed data that would take far more than a recording")
        return data

    def __enter__(self) -> "_LimitedFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._opened.close()
