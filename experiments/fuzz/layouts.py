"""Where the numbers lie in a binary file that decide how the rest of it is read."""

import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple


class Number(NamedTuple):
    """A whole number in a file."""

    offset: int
    size: int
    """Bytes: 1, 2, 4 or 8."""
    big_endian: bool = False


class _Record(NamedTuple):
    start: int
    operation: int
    body: int
    """Offset of the length of the record's data."""
    stop: int


_CHUNK, _MESSAGE = 5, 2


def ros1_records(data: bytes) -> Iterator[Number]:
    """Yield the lengths of a ROS 1 bag's records and of their header fields, and the fields' first bytes."""
    for record in _ros1_walk(data, len(b"#ROSBAG V2.0\n"), len(data)):
        yield from (Number(record.start, 4), Number(record.body, 4))
        for field, value, size in _fields(data, record.start + 4, record.body):
            yield Number(field, 4)
            yield from (Number(value, width) for width in (1, 4, 8) if width <= size)


def ros1_messages(data: bytes) -> Iterator[Number]:
    """Yield the numbers that head each message of a ROS 1 bag that is not compressed, and a cloud's fields.

    Behind the header (sequence number, stamp, frame) come a cloud's height, width and number of fields, a
    Livox message's timebase and number of points, or the numbers of an inertial sample or a fix.
    """
    for record in _ros1_walk(data, len(b"#ROSBAG V2.0\n"), len(data)):
        if record.operation == _MESSAGE and record.stop - record.body > 24:
            start = record.body + 4
            (frame,) = struct.unpack_from("<I", data, start + 12)
            yield from (Number(start + 4 * number, 4) for number in range(4))
            head = start + 16 + frame
            yield from (Number(head + 4 * number, 4) for number in range(7))
            yield from (Number(head + 8 * number, 8) for number in range(24))
    for name in (b"x", b"y", b"z", b"intensity", b"ring", b"time", b"t"):
        for field in _places(data, struct.pack("<I", len(name)) + name):
            behind = field + 4 + len(name)
            yield from (Number(field, 4), Number(field + 4, 1), Number(behind, 4), Number(behind + 4, 1))
            yield Number(behind + 5, 4)
            # behind the last field: order of bytes, steps of point and row, length of the data
            yield from (Number(behind + 9, 1), *(Number(behind + 10 + 4 * number, 4) for number in range(3)))


def _ros1_walk(data: bytes, start: int, stop: int) -> Iterator[_Record]:
    """Yield the records of a bag, and those within its chunks."""
    while start + 8 <= stop:
        body = start + 4 + struct.unpack_from("<I", data, start)[0]
        if body + 4 > stop:
            return
        end = body + 4 + struct.unpack_from("<I", data, body)[0]
        operations = (data[value] for _, value, size in _fields(data, start + 4, body) if size == 1)
        record = _Record(start, next(operations, 0), body, end)
        yield record
        if record.operation == _CHUNK:
            yield from _ros1_walk(data, body + 4, min(end, stop))
        start = end


def _fields(data: bytes, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
    """Yield where a header's fields and their values begin, and the values' sizes."""
    while start + 4 < stop:
        (size,) = struct.unpack_from("<I", data, start)
        value = data.find(b"=", start) + 1
        yield start, value, start + 4 + size - value
        start += 4 + size


def _places(data: bytes, wanted: bytes) -> Iterator[int]:
    at = data.find(wanted)
    while at >= 0:
        yield at
        at = data.find(wanted, at + 1)


_MCAP_HEAD = 8
_MCAP_CHUNK = 6


def mcap_records(data: bytes) -> Iterator[Number]:
    """Yield the kinds and lengths of an mcap's records, and the numbers with which each begins."""
    yield from _mcap_records(data, _MCAP_HEAD, len(data) - _MCAP_HEAD)


def _mcap_records(data: bytes, start: int, stop: int) -> Iterator[Number]:
    while start + 9 <= stop:
        (length,) = struct.unpack_from("<Q", data, start + 1)
        yield from (Number(start, 1), Number(start + 1, 8))
        body = start + 9
        yield from (Number(body + place, 4) for place in range(0, min(length, 48) - 3, 2))
        yield from (Number(body + place, 8) for place in range(0, min(length, 48) - 7, 4))
        if data[start] == _MCAP_CHUNK and length > 40:
            (name,) = struct.unpack_from("<I", data, body + 28)
            yield from _mcap_records(data, body + 32 + name + 8, min(body + length, stop))
        start = body + length


def sqlite_pages(data: bytes) -> Iterator[Number]:
    """Yield the numbers of an SQLite file's header, and of each page's header, cells and first bytes."""
    yield from (Number(place, 2, True) for place in (16, 18, 20, 22))
    yield from (Number(place, 4, True) for place in range(24, 100, 4))
    size = int.from_bytes(data[16:18], "big") or 4096
    size = 65536 if size == 1 else size
    for page in range(0, len(data), size):
        head = page + (100 if page == 0 else 0)
        yield from (Number(head, 1), *(Number(head + place, 2, True) for place in (1, 3, 5)))
        yield from (Number(head + 8 + 2 * cell, 2, True) for cell in range(8))
        yield from (Number(head, 4, True), Number(head + 8, 4, True))
        begins = int.from_bytes(data[head + 5 : head + 7], "big")
        yield from (Number(page + begins + place, 1) for place in range(12))


def las_header(data: bytes) -> Iterator[Number]:
    """Yield the numbers of a LAS file's header, and of its records of variable length."""
    yield from (Number(place, size) for place, size in ((6, 2), (24, 1), (25, 1), (94, 2), (96, 4), (100, 4)))
    # format and size of a point, numbers of points, then scales and offsets
    yield from (Number(104, 1), Number(105, 2), Number(107, 4))
    yield from (Number(place, 8) for place in range(131, 179, 8))
    start, _, records = struct.unpack_from("<HII", data, 94)
    if data[25] >= 4:
        yield from (Number(235, 8), Number(243, 4), Number(247, 8))
    for _ in range(records):
        yield from (Number(start + 18, 2), Number(start + 20, 2))
        body = start + 54
        # type and options of each extra dimension
        start = body + int.from_bytes(data[start + 20 : start + 22], "little")
        yield from (Number(place, 1) for entry in range(body, start, 192) for place in (entry + 2, entry + 3))


def pcap_records(data: bytes) -> Iterator[Number]:
    """Yield the numbers of a capture's header, and those with which its records begin.

    Behind a record's time and lengths lie the headers of Ethernet, IP and UDP, and the begin of the data.
    """
    yield from (Number(place, size) for place, size in ((0, 4), (4, 2), (6, 2), (16, 4), (20, 4)))
    start = 24
    while start + 16 <= len(data):
        yield from (Number(start + place, 4) for place in range(0, 16, 4))
        head = start + 16
        yield from (Number(head + 12 + place, 2, True) for place in range(0, 42, 2))
        yield from (Number(head + 42 + place, size) for place in (0, 2, 8) for size in (2, 4, 8))
        start = head + int.from_bytes(data[start + 8 : start + 12], "little")
        # the end of the data: the time, the return and the model of a Velodyne
        yield from (Number(start - place, size) for place, size in ((6, 4), (2, 1), (1, 1)))


NUMBERS: dict[str, Callable[[bytes], Iterator[Number]]] = {
    "ros1": ros1_records,
    "messages": ros1_messages,
    "mcap": mcap_records,
    "sqlite": sqlite_pages,
    "las": las_header,
    "pcap": pcap_records,
}
"""Finders of numbers, by the name of a layout."""
