"""Healthy packet captures for the campaign: of a Velodyne, and of an Ouster with its metadata and its IMU."""

import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from lio_jax.core.errors import LioJaxError
from lio_jax.data.ouster_pcap import INSTALL

_PERIOD_NS = 100_000_000
_TURNS, _PACKETS = 4, 10


def write_captures(root: Path, start_ns: int) -> None:
    """Write ``velodyne/a.pcap`` and ``ouster/a.pcap`` with ``ouster/a.json`` below a folder.

    Args:
        root: folder that does not exist yet.
        start_ns: time of the first packet, ns.

    Raises:
        LioJaxError: the library of Ouster captures is not installed.
    """
    core = _ouster_core()
    for name in ("velodyne", "ouster"):
        (root / name).mkdir(parents=True)
    _write(root / "velodyne" / "a.pcap", _velodyne(start_ns))
    described = json.loads(core.SensorInfo.from_default(core.LidarMode._512x10).to_json_string())
    described["config_params"] |= {"udp_port_lidar": 7502, "udp_port_imu": 7503}
    (root / "ouster" / "a.json").write_text(json.dumps(described))
    _write(root / "ouster" / "a.pcap", _ouster(core, json.dumps(described), start_ns))


def _velodyne(start_ns: int) -> Iterable[tuple[int, int, bytes]]:
    """Yield time, port and data of the packets of a VLP-16 that turns by 36 deg in a packet."""
    for number in range(_TURNS * _PACKETS):
        stamp_ns = start_ns + number * _PERIOD_NS // _PACKETS
        data = b""
        for block in range(12):
            azimuth = (12 * number + block) * 300 % 36000
            data += struct.pack("<HH", 0xEEFF, azimuth) + struct.pack("<HB", 2500, 60) * 32
        yield stamp_ns, 2368, data + struct.pack("<IBB", stamp_ns // 1000 % 3_600_000_000, 0x37, 0x22)


def _ouster_core() -> Any:
    try:
        from ouster.sdk import core
    except ImportError:
        raise LioJaxError(
            "the campaign writes captures of an Ouster by ouster-sdk 1.0 or newer, which is not installed; "
            f"install it with {INSTALL}."
        ) from None
    return core


def _ouster(core: Any, described: str, start_ns: int) -> Iterable[tuple[int, int, bytes]]:
    """Yield the packets of two frames, and a sample of the IMU with each."""
    info = core.SensorInfo(described)
    for number in range(2):
        frame = core.LidarFrame(info)
        frame.frame_id = number + 1
        frame.field("RANGE")[:] = 5000
        frame.status[:] = 1
        frame.measurement_id[:] = np.arange(info.w)
        frame.timestamp[:] = start_ns + number * _PERIOD_NS + np.arange(info.w) * _PERIOD_NS // info.w
        for packet in core.frame_to_packets(frame, core.PacketFormat(info), info.init_id, info.sn):
            stamp_ns = int(frame.timestamp[0])
            yield stamp_ns, 7502, packet.buf.tobytes()
            stamps = (stamp_ns, stamp_ns, stamp_ns)
            yield stamp_ns, 7503, struct.pack("<QQQ6f", *stamps, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0)


def _write(path: Path, packets: Iterable[tuple[int, int, bytes]]) -> None:
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for stamp_ns, port, data in packets:
            udp = struct.pack(">HHHH", port, port, 8 + len(data), 0) + data
            ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + bytes([10, 0, 0, 1] * 2)
            frame = bytes(12) + b"\x08\x00" + ip + udp
            seconds, rest = divmod(stamp_ns, 1_000_000_000)
            file.write(struct.pack("<IIII", seconds, rest // 1000, len(frame), len(frame)) + frame)
