"""Read the UDP datagrams of a packet capture one by one, in the classic pcap format.

Format: libpcap, "pcap-savefile"; link types: https://www.tcpdump.org/linktypes.html.
"""

import struct
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

from lio_jax.core.errors import LioJaxError

SUFFIXES = (".pcap", ".pcapng", ".cap")
"""Endings of files that are read as packet captures."""
LOOKED_AT = 5000
"""Number of datagrams from which the sensor of a capture is recognised."""

_TICK_NS = {0xA1B2C3D4: 1000, 0xA1B23C4D: 1}
"""Unit of the fraction of a second by the first number of the file, ns."""
_PCAPNG = b"\x0a\x0d\x0d\x0a"
_HEADER, _RECORD = 24, 16
"""Size of the header of the file and of each record, bytes."""
_LARGEST = 1 << 18
"""Size above which a record can only be damaged, bytes: libpcap's largest."""
_BUFFER = 1 << 20

_IP_AT = {0: 4, 12: 0, 14: 0, 101: 0, 108: 4, 228: 0}
"""Place of the IP header in a record by its link type, where all records hold IP: loopback and raw IP."""
_TYPE_AT = {1: 12, 113: 14, 276: 0}
"""Place of the number of the protocol by the link type: Ethernet, and Linux's "any" device (two versions)."""
_AFTER_TYPE = {1: 2, 113: 2, 276: 20}
"""Number of bytes from that place to the IP header."""
_VLAN = (b"\x81\x00", b"\x88\xa8")
_IPV4 = b"\x08\x00"
_UDP = 17


class Datagram(NamedTuple):
    """A UDP datagram, or its first fragment."""

    place: int
    """Place of its record in the file, bytes."""
    received_ns: int
    """Time at which the computer received it, ns."""
    source: bytes
    """IPv4 address of the sender, 4 bytes."""
    port: int
    """UDP port to which it was sent."""
    length: int
    """Number of bytes of data that the sender states."""
    data: bytes
    """Data that the record holds: fewer bytes where it is a fragment or was cut off."""


def datagrams(path: Path, warn: Callable[[str], None], place: int = 0) -> Iterator[Datagram]:
    """Yield the UDP datagrams over IPv4 in recorded order, without holding more than one of them.

    A file that ends within a record, or is damaged, gives what lies before that, with one warning.

    Args:
        path: path of the capture.
        warn: function that takes each sentence.
        place: place of the record to begin with, bytes; 0: the first.

    Raises:
        LioJaxError: the file cannot be read, is no pcap file, or is one of a link without IP.
    """
    try:
        with path.open("rb", buffering=_BUFFER) as file:
            yield from _datagrams(file, path, warn, place)
    except OSError as error:
        raise LioJaxError(
            f"{path}: cannot be read ({error.strerror}); check the file and the disk."
        ) from None


def first_datagrams(path: Path) -> list[Datagram]:
    """Return the datagrams from which the sensor of a capture is recognised.

    Raises:
        LioJaxError: as :func:`datagrams`.
    """
    return list(islice(datagrams(path, lambda sentence: None), LOOKED_AT))


def unknown_capture(path: Path, advice: str = "") -> LioJaxError:
    """Return the error of a capture that holds no packets of a sensor that is known.

    Args:
        path: path of the capture.
        advice: what else may be wrong, a part of a sentence that follows a semicolon.
    """
    seen = first_datagrams(path)
    if not seen:
        return LioJaxError(
            f"{path}: holds no UDP packets over IPv4; record the packets that the lidar sends, for example "
            "with tcpdump or Wireshark."
        )
    (port, length), count = Counter((one.port, one.length) for one in seen).most_common(1)[0]
    cut = [one for one in seen if (one.port, one.length) == (port, length) and len(one.data) < length]
    if len(cut) == count and max(len(one.data) for one in cut) < _SHORTEST_FRAGMENT:
        return LioJaxError(
            f"{path}: its packets were cut to {max(len(one.data) for one in cut)} of {length} bytes when "
            "they were recorded; record them whole (tcpdump -s 0)."
        )
    return LioJaxError(
        f"{path}: most of its UDP packets hold {length} bytes and go to port {port}: they are not those of "
        f"a Velodyne or of an Ouster with its metadata{advice}; if another lidar sent them, let its driver "
        "write a ROS bag of them, and give that."
    )


_SHORTEST_FRAGMENT = 500
"""Number of bytes of data that the first fragment of a datagram holds at least."""


def _datagrams(file: BinaryIO, path: Path, warn: Callable[[str], None], place: int) -> Iterator[Datagram]:
    order, tick_ns, link = _file_header(file, path)
    record = struct.Struct(order + "IIII")
    if place:
        file.seek(place)
    else:
        place = _HEADER
    while header := file.read(_RECORD):
        if len(header) < _RECORD:
            warn(_truncated(path, place))
            return
        seconds, fraction, kept, _ = record.unpack(header)
        if kept > _LARGEST:
            warn(f"{path}: damaged at byte {place} (a packet of {kept} bytes): what is before that is used.")
            return
        frame = file.read(kept)
        if len(frame) < kept:
            warn(_truncated(path, place))
            return
        at = _ip_header(frame, link)
        if at is not None and (found := _udp(frame, at)) is not None:
            yield Datagram(place, seconds * 1_000_000_000 + fraction * tick_ns, *found)
        place += _RECORD + kept


def _truncated(path: Path, place: int) -> str:
    return f"{path}: truncated within the packet at byte {place}: its whole packets are used."


def _file_header(file: BinaryIO, path: Path) -> tuple[str, int, int]:
    """Return the byte order, the unit of the fractions of seconds (ns) and the link type."""
    header = file.read(_HEADER)
    if header.startswith(_PCAPNG):
        raise LioJaxError(
            f"{path}: is a pcapng file, which is not read; convert it with Wireshark's "
            f"'editcap -F pcap {path.name} {path.stem}.classic.pcap', and give that file."
        )
    for order in "<>":
        if len(header) == _HEADER and (number := struct.unpack(order + "I", header[:4])[0]) in _TICK_NS:
            link = struct.unpack(order + "I", header[20:])[0] & 0xFFFF
            if link not in _IP_AT and link not in _TYPE_AT:
                raise LioJaxError(
                    f"{path}: was recorded on a link of type {link}, which is not read; record the packets "
                    "on an Ethernet interface."
                )
            return order, _TICK_NS[number], link
    raise LioJaxError(
        f"{path}: does not begin as a packet capture does; give a file that tcpdump or Wireshark wrote, in "
        "the pcap format."
    )


def _ip_header(frame: bytes, link: int) -> int | None:
    """Return the place of the IPv4 header in a record; None where it holds something else."""
    if link in _IP_AT:
        return _IP_AT[link]
    at = _TYPE_AT[link]
    while frame[at : at + 2] in _VLAN:
        at += 4
    return at + _AFTER_TYPE[link] if frame[at : at + 2] == _IPV4 else None


def _udp(frame: bytes, at: int) -> tuple[bytes, int, int, bytes] | None:
    """Return sender, port, length and data of a datagram or of its first fragment, None for all else."""
    if len(frame) < at + 20 or frame[at] >> 4 != 4 or frame[at + 9] != _UDP:
        return None
    if (frame[at + 6] & 0x1F) << 8 | frame[at + 7]:
        return None  # a later fragment
    udp = at + 4 * (frame[at] & 0x0F)
    if len(frame) < udp + 8:
        return None
    port, length = int.from_bytes(frame[udp + 2 : udp + 4]), int.from_bytes(frame[udp + 4 : udp + 6]) - 8
    # Ethernet pads short frames
    return frame[at + 12 : at + 16], port, length, frame[udp + 8 : udp + 8 + max(length, 0)]
