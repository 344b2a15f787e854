"""Read packet captures of Velodyne lidars by the library velodyne-decoder (extra ``pcap``).

Packets: Velodyne, "VLP-16 User Manual" (63-9243), section 9. Every model sends 12 blocks of 100 bytes, each
with a flag and an azimuth, and then the time since the top of the hour.
"""

from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lio_jax.core.errors import LioJaxError, one_line
from lio_jax.data.config import DataConfig
from lio_jax.data.pcap_file import SUFFIXES, Datagram, datagrams, first_datagrams, unknown_capture
from lio_jax.data.sequence import LidarScan, Reader, SequenceBase, SequenceInfo, scans_from
from lio_jax.data.time_order import Stamped, in_time_order

_SIZE = 1206
_FLAGS = (b"\xff\xee", b"\xff\xdd")
_FIRST_AZIMUTH, _LAST_AZIMUTH, _TIME = 2, 1102, 1200
"""Places of the azimuths of the first and of the last block (0.01 deg) and of the time (us)."""
_TURN = 36000
_WRAP = 4500
"""Step back in azimuth with which a new turn begins, 0.01 deg; lost or exchanged packets step less."""
_PACKET_NS = 1_400_000
"""Longest time that a packet covers, ns."""
_LONGEST_NS = 300_000_000
"""Longest turn, ns: the slowest rate is 5 Hz. A head that stands still never ends a turn."""
_HOUR_US = 3_600_000_000
_SYNCHRONISED_NS = 1_000_000_000
"""Largest difference of the clocks of the sensor and of the computer, ns, if both keep the time of day."""
_LATENCIES = 500
"""Number of packets whose shortest delay ties the sensor's clock to the computer's."""
_FARTHEST = 1000.0
"""Longest range that is decoded, m: longer than any model measures."""
_STRONGEST = 1
"""Bit of the strongest return; a sensor with two returns sends the last one, too."""
_FACTORY_LOOKED_AT = 20
_FIRINGS = 12 * 32
"""Number of firings that a packet holds."""


class _Turn(NamedTuple):
    """A turn of the head: successive packets of one sensor."""

    place: int
    """Place of its first packet in the file, bytes."""
    packets: int
    start_ns: int
    """Time of the first firing by the sensor's clock, ns."""
    end_ns: int
    """Time at which the last packet ends, ns."""
    first_azimuth: int
    last_azimuth: int


class VelodynePcap(SequenceBase):
    """A capture of one Velodyne, whose scans are turns from straight ahead to straight ahead.

    The position packets are not read: fixes, and the inertial samples of an HDL-32E.
    """

    def __init__(self, path: Path, config: DataConfig) -> None:
        """Find the turns in one pass over the packets; decode the first of them.

        Args:
            path: path of the capture.
            config: not used, because the packets state everything.

        Raises:
            LioJaxError: the library is not installed, the model is not known, or no whole packet is there.
        """
        super().__init__()
        self._path = path
        self._library = _library(path)
        first = next(filter(_is_velodyne, first_datagrams(path)), None)
        if first is None:
            raise unknown_capture(path)
        self._sender = (first.source, first.port)
        self._turns, self._offset_ns, clock = self._indexed(first)
        self._options = self._recognised()
        decoder = self._decoder()
        try:
            self._decode(decoder, 0)
        except RuntimeError as error:
            raise LioJaxError(
                f"{path}: the packets of this Velodyne cannot be decoded ({one_line(str(error))}); let its "
                "driver write a ROS bag of them, and give that."
            ) from None
        self.info = SequenceInfo(
            name=path.stem,
            format="velodyne_pcap",
            path=str(path),
            scan_count=len(self._turns),
            sensor=f"Velodyne {decoder.model_id.name}",
            notes=(f"packets of a Velodyne {decoder.model_id.name}, cut straight ahead", clock),
        )

    def scans(self, start: int = 0, count: int | None = None) -> Iterator[LidarScan]:
        """Yield scans ``start`` to ``start + count``; one with a wrong stamp is left out with a warning."""
        yield from in_time_order(self._scans(start, count), self._log.add)

    def _scans(self, start: int, count: int | None) -> Iterator[Stamped[LidarScan]]:
        decoder = self._decoder()
        for number in range(len(self._turns))[scans_from(start, count)]:
            name = f"{self._path.name}: scan {number}"
            try:
                scan = self._decode(decoder, number)
            except RuntimeError as error:
                self._log.add(f"{name} cannot be decoded and was skipped: {error}.")
                continue
            yield Stamped(scan.stamp_ns, name, scan)

    def _packets(self, place: int = 0) -> Iterator[Datagram]:
        """Yield the packets of the sensor."""
        for packet in datagrams(self._path, self._log.add, place):
            if _is_velodyne(packet) and (packet.source, packet.port) == self._sender:
                yield packet

    def _indexed(self, first: Datagram) -> tuple[list[_Turn], int, str]:
        """Return all turns, what is added to the sensor's time (ns), and a note on that."""
        lag_ns = _nearest_ns(first, 0)[1]
        turns: list[_Turn] = []
        delays: list[int] = []
        others: set[tuple[bytes, int]] = set()
        latest_ns = latest_azimuth = 0
        for packet in datagrams(self._path, self._log.add):
            if not _is_velodyne(packet):
                continue
            if (packet.source, packet.port) != self._sender:
                others.add((packet.source, packet.port))
                continue
            stamp_ns, delay_ns = _nearest_ns(packet, lag_ns)
            if len(delays) < _LATENCIES:
                delays.append(delay_ns)
            begin, end = _azimuth(packet, _FIRST_AZIMUTH), _azimuth(packet, _LAST_AZIMUTH)
            turned = begin - end > _WRAP or latest_azimuth - begin > _WRAP
            if not turns or turned or stamp_ns - turns[-1].start_ns > _LONGEST_NS:
                turns.append(_Turn(packet.place, 1, stamp_ns, stamp_ns + _PACKET_NS, begin, end))
            else:
                step_ns = min(max(stamp_ns - latest_ns, 0), _PACKET_NS)
                turns[-1] = turns[-1]._replace(
                    packets=turns[-1].packets + 1, end_ns=stamp_ns + step_ns, last_azimuth=end
                )
            latest_ns, latest_azimuth = stamp_ns, end
        if others:
            self._log.add(
                f"{self._path}: holds the packets of {len(others) + 1} Velodynes; only those of "
                f"{'.'.join(map(str, self._sender[0]))} to port {self._sender[1]} are read."
            )
        if abs(lag_ns) < _SYNCHRONISED_NS:
            return _whole(turns), 0, "stamps: the sensor's clock, which keeps the time of day"
        note = "stamps: the sensor's clock, set by the computer's, because it does not keep the time of day"
        return _whole(turns), min(delays), note

    def _recognised(self) -> dict[str, Any]:
        """Return the decoder's options: what an HDL-64E states of itself, spread over many packets.

        Raises:
            LioJaxError: the packets of an HDL-64E do not hold its calibration.
        """
        known: dict[str, Any] = {
            "min_range": 0.0,
            "max_range": _FARTHEST,
            "timestamp_first_packet": True,
        }
        factory = [packet.data[-2:] for packet in islice(self._packets(), _FACTORY_LOOKED_AT)]
        # the return mode and the model, which are constant; an HDL-64E sends its state there
        if len(set(factory)) < 2:
            return known
        try:
            model, calibration = self._library.hdl64e.detect_hdl64e(str(self._path))
        # the library fails in many ways on packets that lack a part
        except Exception as error:
            raise LioJaxError(
                f"{self._path}: its packets are those of an HDL-64E, but do not hold its calibration "
                f"({one_line(str(error))}); record it for 10 s at least."
            ) from None
        return known | {"model": model, "calibration": calibration}

    def _decoder(self) -> Any:
        return self._library.ScanDecoder(self._library.Config(**self._options))

    def _decode(self, decoder: Any, number: int) -> LidarScan:
        turn = self._turns[number]
        packets = self._library.PacketVector()
        first_us = None
        for packet in islice(self._packets(turn.place), turn.packets):
            since_us = _microseconds(packet)
            first_us = since_us if first_us is None else first_us
            hour = 2 if first_us - since_us > _HOUR_US // 2 else 1
            # in small hours, so that the differences of times are exact
            packets.append(self._library.VelodynePacket(hour * 3600.0 + since_us * 1e-6, packet.data))
        _, points = decoder.decode(packets, True)
        found = len(points)
        strongest = points["return_type"] & _STRONGEST > 0
        if strongest.any() and not strongest.all():
            points = points[strongest]
        following = self._turns[number + 1].start_ns if number + 1 < len(self._turns) else turn.end_ns
        duration = (min(following, turn.end_ns) if following > turn.start_ns else turn.end_ns) - turn.start_ns
        return LidarScan(
            stamp_ns=turn.start_ns + self._offset_ns,
            points=np.stack([points["x"], points["y"], points["z"]], axis=1),
            time=np.clip(points["time"], 0.0, np.float32(duration * 1e-9)),
            ring=points["ring"].astype(np.int32),
            intensity=points["intensity"].copy(),
            duration=duration * 1e-9,
            dropped=turn.packets * _FIRINGS - found,
        )


def _is_velodyne(packet: Datagram) -> bool:
    return len(packet.data) == _SIZE and packet.data[:2] in _FLAGS


def _azimuth(packet: Datagram, place: int) -> int:
    return int.from_bytes(packet.data[place : place + 2], "little")


def _microseconds(packet: Datagram) -> int:
    return int.from_bytes(packet.data[_TIME : _TIME + 4], "little")


def _nearest_ns(packet: Datagram, lag_ns: int) -> tuple[int, int]:
    """Return a packet's time, in the hour that the computer's clock states, and the delay of receipt, ns.

    Args:
        packet: a packet of the sensor.
        lag_ns: time by which the computer's clock is ahead of the sensor's, ns.
    """
    since_ns, hour_ns = 1000 * _microseconds(packet), 1000 * _HOUR_US
    stamp_ns = since_ns + round((packet.received_ns - lag_ns - since_ns) / hour_ns) * hour_ns
    return stamp_ns, packet.received_ns - stamp_ns


def _whole(turns: list[_Turn]) -> list[_Turn]:
    """Leave out the first and the last turn where the recording holds less than half of them."""
    from_begin = len(turns) > 1 and turns[0].first_azimuth > _TURN // 2
    to_end = len(turns) - from_begin > 1 and turns[-1].last_azimuth < _TURN // 2
    return turns[from_begin : len(turns) - to_end]


def _library(path: Path) -> Any:
    try:
        import velodyne_decoder
    except ImportError:
        raise LioJaxError(
            f"{path}: captures of a Velodyne are decoded by velodyne-decoder, which is not installed; "
            "install it with pip install 'lio-jax[pcap]'."
        ) from None
    return velodyne_decoder


def _is_capture(path: Path) -> bool:
    if path.suffix.lower() not in SUFFIXES or not path.is_file():
        return False
    try:
        return any(map(_is_velodyne, first_datagrams(path)))
    except LioJaxError:
        return False


READER = Reader(
    "velodyne_pcap",
    "a packet capture of a Velodyne (.pcap)",
    _is_capture,
    VelodynePcap,
    reads=frozenset(),
    has_parts=False,
)
