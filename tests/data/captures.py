"""Packet captures byte by byte: the classic pcap format, and the data packets of Velodyne lidars.

Sources: libpcap, "pcap-savefile"; Velodyne, "VLP-16 User Manual" (63-9243), sections 9.2 to 9.4; Velodyne,
"HDL-32E User's Manual" (63-9113), appendix E.
"""

import struct
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lio_jax.data.sequence import LidarScan
from lio_jax.sim.lidar import SpinningLidar

HOUR_NS = 3_600_000_000_000
START_NS = 1_700_000_000_000_000_000
HALF = np.array([5.0, 4.0, 1.5])
"""Distances of the walls of a box from the sensor, m."""
CYCLES = 1800
"""Firings of each laser in a turn of 0.0995 s: the azimuth's step of 0.2 deg is exact."""
ETHERNET, RAW_IP, COOKED = 1, 101, 113
DUAL = 0x39
"""Mode of a sensor that sends the last and the strongest return of each firing."""


class Sent(NamedTuple):
    """A datagram that a capture records."""

    received_ns: int
    port: int
    data: bytes
    source: str = "192.168.1.201"


def write_pcap(
    path: Path,
    sent: Iterable[Sent],
    *,
    link: int = ETHERNET,
    order: str = "<",
    nanoseconds: bool = False,
    vlan: bool = False,
    mtu: int = 1500,
    kept: int = 65535,
) -> Path:
    """Write datagrams as records of a capture, in fragments where they are longer than ``mtu``."""
    with path.open("wb") as file:
        magic = 0xA1B23C4D if nanoseconds else 0xA1B2C3D4
        file.write(struct.pack(order + "IHHiIII", magic, 2, 4, 0, 0, kept, link))
        for number, one in enumerate(sent):
            seconds, rest = divmod(one.received_ns, 1_000_000_000)
            for frame in _frames(one, number, link, vlan, mtu):
                part = frame[:kept]
                fraction = rest if nanoseconds else rest // 1000
                file.write(struct.pack(order + "IIII", seconds, fraction, len(part), len(frame)) + part)
    return path


def _frames(one: Sent, number: int, link: int, vlan: bool, mtu: int) -> list[bytes]:
    content = struct.pack(">HHHH", one.port, one.port, 8 + len(one.data), 0) + one.data
    size = (mtu - 20) // 8 * 8
    addresses = bytes(map(int, one.source.split("."))) + bytes([192, 168, 1, 77])
    head = {ETHERNET: bytes(12) + b"\x08\x00", RAW_IP: b"", COOKED: bytes(14) + b"\x08\x00"}[link]
    if vlan:
        head = bytes(12) + b"\x81\x00\x00\x05\x08\x00"
    frames = []
    for at in range(0, len(content), size):
        part = content[at : at + size]
        more = 0x2000 * (at + size < len(content))
        header = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(part), number & 0xFFFF, more | at // 8, 64, 17, 0)
        frames.append(head + header + addresses + part)
    return frames


@dataclass(frozen=True)
class Model:
    """What a model's manual states."""

    code: int
    """Last byte of a packet."""
    elevation: NDArray[np.float64]
    """Elevation of each laser in firing order, deg."""
    height: NDArray[np.float64]
    """Height of each laser's origin above the sensor's origin, m."""
    cycle_ns: int
    """Time from one firing of a laser to its next, ns."""
    delay_ns: int
    """Time from one laser to the next, ns."""

    @property
    def lasers(self) -> int:
        return len(self.elevation)

    @property
    def cycles(self) -> int:
        """Number of firings of each laser in a packet."""
        return 12 * 32 // self.lasers

    @property
    def ring(self) -> NDArray[np.int64]:
        """Number of each laser by elevation, from the lowest."""
        return np.argsort(np.argsort(self.elevation))


VLP16 = Model(
    0x22,
    np.array([-15.0, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]),
    np.array([11.2, -0.7, 9.7, -2.2, 8.1, -3.7, 6.6, -5.1, 5.1, -6.6, 3.7, -8.1, 2.2, -9.7, 0.7, -11.2])
    * 1e-3,
    55_296,
    2_304,
)
HDL32E = Model(
    0x21,
    ((np.stack([np.arange(16), np.arange(16) + 16], axis=1).ravel() * 4 - 92) / 3).round(2),
    np.zeros(32),
    46_080,
    1_152,
)


def packets(
    model: Model,
    ranges: NDArray[np.float64],
    azimuth: NDArray[np.float64],
    start_ns: int,
    *,
    mode: int = 0x37,
    reflectivity: int = 60,
) -> list[tuple[int, bytes]]:
    """Return the packets of successive firings, each with the sensor's time of its first firing, ns.

    Args:
        ranges: (cycles, lasers) m, a whole number of packets; 0: no return. In the mode ``DUAL`` blocks come
            in pairs: the last return of the cycles of a block, and then their strongest return.
        azimuth: (cycles,) azimuth of the first laser of each cycle, clockwise, deg.
        start_ns: the sensor's time of the first firing, ns.
    """
    per_block = 32 // model.lasers
    written = []
    for first in range(0, len(ranges), model.cycles):
        data = b""
        for block in range(first, first + model.cycles, per_block):
            data += struct.pack("<2sH", b"\xff\xee", round(azimuth[block] * 100) % 36000)
            for distance in ranges[block : block + per_block].ravel():
                data += struct.pack("<HB", round(distance / 0.002), reflectivity)
        time_ns = start_ns + first * model.cycle_ns // (2 if mode == DUAL else 1)
        written.append((time_ns, data + struct.pack("<IBB", time_ns % HOUR_NS // 1000, mode, model.code)))
    return written


def received(
    written: Iterable[tuple[int, bytes]], ahead_ns: int = 0, latency_ns: int = 2_000_000
) -> list[Sent]:
    """Return packets as a computer receives them whose clock is ahead of the sensor's."""
    return [Sent(time_ns + ahead_ns + latency_ns, 2368, data) for time_ns, data in written]


def box_ranges(model: Model, azimuth: NDArray[np.float64], half: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances from each laser to the walls of a box around the sensor, (cycles, lasers) m.

    Args:
        azimuth: (cycles,) azimuth of the first laser of each cycle, deg.
        half: (3,) distances of the walls from the sensor's origin, m.
    """
    step = (azimuth[1] - azimuth[0]) % 360
    turned = step * model.delay_ns / model.cycle_ns * np.arange(model.lasers)
    angle = np.radians(azimuth[:, None] + turned)
    level = np.radians(model.elevation)
    ways = np.stack(
        [np.cos(level) * np.cos(angle), -np.cos(level) * np.sin(angle), np.sin(level) + 0 * angle], axis=-1
    )
    origin = np.stack([0 * model.height, 0 * model.height, model.height], axis=-1)
    with np.errstate(divide="ignore"):
        return ((np.copysign(half, ways) - origin) / ways).min(axis=-1)


def turning(model: Model, turns: float, begin_deg: float = 0.0, cycles: int = CYCLES) -> NDArray[np.float64]:
    """Return the azimuths of the cycles in so many turns, deg, in whole packets."""
    number = round(turns * cycles) // model.cycles * model.cycles
    return (begin_deg + 360 / cycles * np.arange(number)) % 360


def box(
    model: Model = VLP16, turns: float = 3.0, begin_deg: float = 0.0, start_ns: int = START_NS, **options: int
) -> list[tuple[int, bytes]]:
    """Return the packets of a sensor that stands in the box."""
    azimuth = turning(model, turns, begin_deg)
    return packets(model, box_ranges(model, azimuth, HALF), azimuth, start_ns, **options)


def same_timing(lidar: SpinningLidar, model: Model, columns: int) -> SpinningLidar:
    """Return a simulated sensor that fires exactly as the model does, ``columns`` times a turn."""
    return replace(lidar, columns=columns, period_ns=columns * model.cycle_ns)


def simulated_packets(
    model: Model, lidar: SpinningLidar, scans: Iterable[LidarScan], epoch_ns: int = 0
) -> list[tuple[int, bytes]]:
    """Return the packets of simulated scans that follow each other, from the simulated sensor's origin."""
    columns = lidar.columns
    firing = np.argsort(model.ring)
    grids = []
    starts = []
    for scan in scans:
        grid = np.zeros((columns, model.lasers))
        laser = firing[scan.ring]
        column = np.rint((scan.time.astype(np.float64) * 1e9 - laser * model.delay_ns) / model.cycle_ns)
        grid[column.astype(int), laser] = np.linalg.norm(scan.points.astype(np.float64), axis=1)
        grids.append(grid)
        starts.append(scan.stamp_ns)
    # a simulated sweep starts straight behind and turns clockwise
    azimuth = np.tile(180 + 360 / columns * np.arange(columns), len(grids)) % 360
    return packets(model, np.concatenate(grids), azimuth, starts[0] + epoch_ns)
