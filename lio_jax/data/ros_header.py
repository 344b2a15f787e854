"""The std_msgs/Header at the front of a serialised ROS message, read without decoding the rest."""

import struct
from typing import NamedTuple


class RosHeader(NamedTuple):
    """Stamp of a message, and where its body starts."""

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
